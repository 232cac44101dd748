# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.solid import Solid, sample_surface

UA_RADIUS = 1 / 35
# Centres of the scene's 19 spheres, in radii, all with x = 0.
UA = [
    *[(-6.19, 6.25), (-6.19, 4.21), (-6.19, 2.11), (-5.64, 0.22), (-3.77, 0), (-1.75, 0.32)],
    *[(-1.49, 2.40), (-1.41, 4.42), (-1.38, 6.51), (1.50, 0), (2.04, 1.93), (2.64, 3.78)],
    *[(3.09, 5.75), (4.14, 7.54), (5.12, 5.74), (5.70, 3.83), (6.30, 1.91), (6.93, -0.01)],
    (4.16, 1.89),
]


def sphere(radius, centre=(0, 0, 0), subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def lens(distance):
    """Volume and one cap's area that two unit spheres share."""
    volume = np.pi * (4 + distance) * (2 - distance) ** 2 / 12
    return volume, 2 * np.pi * (1 - distance / 2)


@pytest.fixture(scope="module")
def overlapping():
    return trimesh.util.concatenate([sphere(1), sphere(1, (1.2, 0, 0))])


def test_samples_lie_on_the_outer_surface_evenly(overlapping):
    points, normals = Solid(overlapping).samples(20_000, 3)
    centres = np.array([[0, 0, 0], [1.2, 0, 0]])
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    assert distance.min() > 0.99
    assert np.abs(distance - 1).min(axis=1).max() < 3e-3
    # By symmetry half lie on each; three standard deviations are 0.011.
    assert np.mean(points[:, 0] < 0.6) == pytest.approx(0.5, abs=0.011)
    owner = centres[distance.argmin(axis=1)]
    assert (np.einsum("ni,ni->n", normals, points - owner) > 0.98).all()
    # Area-uniform: on a sphere all heights are equally frequent.
    left = points[points[:, 0] < 0.6]
    heights = np.histogram(left[:, 0], bins=8, range=(-1, 0.6))[0] / len(left)
    np.testing.assert_allclose(heights, 1 / 8, atol=0.012)


def test_samples_are_drawn_once_per_count_and_seed(overlapping):
    solid = Solid(overlapping)
    assert solid.samples(50, 0)[0] is solid.samples(50, 0)[0]
    assert len(solid.samples(60, 0)[0]) == 60
    assert (solid.samples(50, 1)[0] != solid.samples(50, 0)[0]).any()
    np.testing.assert_array_equal(solid.samples(50, 0)[0], Solid(overlapping).samples(50, 0)[0])


def test_the_outer_surface_has_no_inner_walls(overlapping):
    solid = Solid(overlapping)
    assert solid.surface.area == pytest.approx(2 * (4 * np.pi - lens(1.2)[1]), rel=3e-3)
    # The seam is nearest to the middle of the lens, not the caps at 0.4.
    assert solid.nearest.distance(np.array([[0.6, 0.0, 0.0]]))[0] == pytest.approx(0.8, abs=0.003)


def test_a_body_inside_another_and_a_cavity_are_no_outer_surface():
    cavity = sphere(0.4)
    cavity.invert()
    nested = trimesh.util.concatenate([sphere(1), sphere(0.5, (0.1, 0, 0)), cavity])
    solid = Solid(nested)
    assert solid.surface.area == pytest.approx(sphere(1).area)
    assert solid.components == 1


def test_a_cavity_between_bodies_is_no_outer_surface():
    slabs = [(3, 3, 1, 0, 0, -1), (3, 3, 1, 0, 0, 1), (1, 3, 3, -1, 0, 0), (1, 3, 3, 1, 0, 0)]
    slabs += [(3, 1, 3, 0, -1, 0), (3, 1, 3, 0, 1, 0)]
    boxes = [trimesh.creation.box(slab[:3]) for slab in slabs]
    for box, slab in zip(boxes, slabs, strict=True):
        box.apply_translation(slab[3:])
    mesh = trimesh.util.concatenate(boxes)
    assert Solid(mesh).surface.area == pytest.approx(6 * 9)
    assert Solid(mesh, fill_cavities=False).volume == pytest.approx(26)


def test_a_cavity_belongs_to_the_body_around_it():
    cavity, ball = sphere(0.6), sphere(0.2)
    cavity.invert()
    mesh = trimesh.util.concatenate([sphere(1), cavity, ball])
    solid = Solid(mesh, fill_cavities=False)
    places = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.8, 0, 0], [1.2, 0, 0]])
    np.testing.assert_array_equal(solid.contains(places), [True, False, True, False])
    assert solid.volume == pytest.approx(sphere(1).volume * (1 - 0.6**3 + 0.2**3), rel=1e-6)
    assert Solid(mesh).volume == pytest.approx(sphere(1).volume)


def test_volume_of_the_union_and_of_what_is_shared(overlapping):
    union, one, apart = Solid(overlapping), Solid(sphere(1)), Solid(sphere(1, (9, 0, 0)))
    # The tessellated sphere itself has 0.2 % less volume.
    assert union.volume == pytest.approx(8 / 3 * np.pi - lens(1.2)[0], rel=4e-3)
    assert union.shared_volume(one) == pytest.approx(one.volume, rel=1e-6)
    assert union.shared_volume(apart) == 0


def test_a_body_inside_out_is_turned():
    mesh = sphere(1)
    mesh.invert()
    solid = Solid(mesh)
    assert solid.closed
    assert solid.volume == pytest.approx(sphere(1).volume)


@pytest.mark.parametrize(
    ("centres", "parts"),
    [
        ([(0, 0, 0), (1.9, 0, 0)], 1),
        ([(0, 0, 0), (2.1, 0, 0)], 2),
        ([(0, 0, 0), (1.9, 0, 0), (3.8, 0, 0), (10, 0, 0)], 2),
    ],
)
def test_overlapping_bodies_are_one_part(centres, parts):
    mesh = trimesh.util.concatenate([sphere(1, centre, 3) for centre in centres])
    assert Solid(mesh).components == parts


def test_crumbs_are_not_counted():
    mesh = trimesh.util.concatenate([sphere(1, subdivisions=2), sphere(0.09, (5, 0, 0), 2)])
    assert Solid(mesh).components == 1


def test_ua_has_fifteen_parts():
    centres = UA_RADIUS * np.array([(0, y, z) for y, z in UA])
    mesh = trimesh.util.concatenate([sphere(UA_RADIUS, centre, 3) for centre in centres])
    assert Solid(mesh).components == 15


def test_a_sheet_is_open_and_hidden_inside_a_body():
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    solid = Solid(sheet)
    assert not solid.closed
    assert solid.components == 1
    around = Solid(trimesh.util.concatenate([sheet, sphere(3)]))
    assert around.surface.area == pytest.approx(sphere(3).area)


def test_what_is_no_mesh_is_refused():
    with pytest.raises(NumericalError, match="empty"):
        Solid(trimesh.Trimesh())
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="not finite"):
        Solid(broken)
    point = trimesh.Trimesh([[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="no triangle with an area"):
        Solid(point)
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="no area"):
        sample_surface(line, 10, 0)
