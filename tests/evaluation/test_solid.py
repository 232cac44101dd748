# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.solid import (
    count_parts,
    outer_surface,
    sample_outer_surface,
    signed_distance,
    solid_from_mesh,
)

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


def test_signed_distance_is_exact_and_negative_inside():
    box = trimesh.creation.box((2, 2, 2))
    points = np.array([[0, 0, 0], [0.9, 0, 0], [3, 0, 0], [2, 2, 1]], dtype=float)
    np.testing.assert_allclose(signed_distance(points, box), [-1, -0.1, 2, np.sqrt(2)], atol=1e-6)
    assert signed_distance(np.zeros((0, 3)), box).shape == (0,)


def test_samples_lie_on_the_outer_surface_evenly(overlapping):
    points, normals = sample_outer_surface(overlapping, 20_000, seed=3)
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
    again, _ = sample_outer_surface(overlapping, 20_000, seed=3)
    np.testing.assert_array_equal(points, again)


def test_the_outer_surface_has_no_inner_walls(overlapping):
    outer = outer_surface(overlapping)
    expected = 2 * (4 * np.pi - lens(1.2)[1])
    assert outer.area == pytest.approx(expected, rel=0.01)
    inside = np.array([[0.6, 0.0, 0.0]])
    # From the middle of the lens the seam is nearest, not the caps at 0.4.
    assert abs(signed_distance(inside, outer)[0]) == pytest.approx(0.8, abs=0.03)


def test_a_body_inside_another_and_a_hollow_do_not_show():
    hollow = sphere(0.4)
    hollow.invert()
    nested = trimesh.util.concatenate([sphere(1), sphere(0.5, (0.1, 0, 0)), hollow])
    assert outer_surface(nested).area == pytest.approx(sphere(1).area)
    solid = solid_from_mesh(nested, drop_cavities=True)
    assert count_parts(solid) == 1


def test_a_body_turned_inside_out_is_turned_back():
    mesh = sphere(1)
    mesh.invert()
    solid = solid_from_mesh(mesh, drop_cavities=True)
    assert solid.closed
    assert solid.bodies[0].volume > 0


def test_unmerged_corners_are_merged():
    mesh = sphere(1, subdivisions=2)
    soup = trimesh.Trimesh(
        mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False
    )
    assert solid_from_mesh(soup, drop_cavities=True).closed


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
    assert count_parts(solid_from_mesh(mesh, drop_cavities=True)) == parts


def test_bars_that_cross_without_a_corner_inside_are_one_part():
    cross = [trimesh.creation.box((4, 1, 1)), trimesh.creation.box((0.8, 4, 0.8))]
    assert count_parts(solid_from_mesh(trimesh.util.concatenate(cross), drop_cavities=True)) == 1


def test_crumbs_are_not_counted():
    mesh = trimesh.util.concatenate([sphere(1, subdivisions=2), sphere(0.09, (5, 0, 0), 2)])
    assert count_parts(solid_from_mesh(mesh, drop_cavities=True)) == 1


def test_ua_has_fifteen_parts():
    centres = UA_RADIUS * np.array([(0, y, z) for y, z in UA])
    mesh = trimesh.util.concatenate([sphere(UA_RADIUS, centre, 3) for centre in centres])
    assert count_parts(solid_from_mesh(mesh, drop_cavities=True)) == 15


def test_a_sheet_is_open():
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    solid = solid_from_mesh(sheet, drop_cavities=True)
    assert not solid.closed
    assert len(solid.sheets) == 1
    assert count_parts(solid) == 1


def test_what_is_no_mesh_is_refused():
    with pytest.raises(NumericalError, match="empty"):
        outer_surface(trimesh.Trimesh())
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="not finite"):
        outer_surface(broken)
    point = trimesh.Trimesh([[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="no triangle with an area"):
        outer_surface(point)
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="no area"):
        sample_outer_surface(line, 10)


def parts_by_all_pairs(solid):
    """Parts of balls by what is known of them: they meet where their centres are near enough."""
    centres = np.array([part.vertices.mean(axis=0) for part in solid.parts])
    radii = np.sqrt([part.area / (4 * np.pi) for part in solid.parts])
    group = np.arange(len(centres))
    for i in range(len(centres)):
        for j in range(i):
            if np.linalg.norm(centres[i] - centres[j]) < radii[i] + radii[j]:
                group[group == group[j]] = group[i]
    areas = np.bincount(group, weights=radii**2)
    return int((areas > 0.01 * areas.max()).sum())


def test_many_balls_of_all_sizes_hang_together_as_they_should():
    generator = np.random.default_rng(0)
    radii = 10 ** generator.uniform(-1, 0, 30)
    balls = [sphere(r, generator.uniform(-2.5, 2.5, 3), 2) for r in radii]
    solid = solid_from_mesh(trimesh.util.concatenate(balls), drop_cavities=True)
    assert count_parts(solid) == parts_by_all_pairs(solid) > 1


def test_groups_that_meet_late_become_one():
    # The largest at one end, the next at the other: the middle joins two groups of two.
    row = [
        sphere(1 - 0.01 * size, (1.9 * place, 0, 0), 3) for place, size in enumerate((0, 3, 2, 1))
    ]
    assert count_parts(solid_from_mesh(trimesh.util.concatenate(row), drop_cavities=True)) == 1


def test_a_crumb_may_bridge_two_parts():
    bodies = [sphere(1, subdivisions=3), sphere(1, (2.1, 0, 0), 3), sphere(0.09, (1.05, 0, 0), 3)]
    assert count_parts(solid_from_mesh(trimesh.util.concatenate(bodies), drop_cavities=True)) == 1
