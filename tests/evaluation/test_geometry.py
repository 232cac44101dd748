# SPDX-License-Identifier: MIT
"""A surface is laid over its truth, wherever it lies and however large it is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.baseline import voxel_fit
from sononerf.evaluation.metrics import Solid, sample_surface
from sononerf.evaluation.numbers import register
from sononerf.geometry.poses import Poses


@pytest.fixture(scope="module")
def body():
    """Three boxes without any symmetry."""
    parts = [trimesh.creation.box(size) for size in ((0.1, 0.06, 0.04), (0.03,) * 3, (0.01,) * 3)]
    parts[1].apply_translation((0.05, 0.02, 0.03))
    parts[2].apply_translation((-0.04, 0.03, 0.02))
    return trimesh.util.concatenate(parts)


def moved(mesh, scale, seed):
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    other = mesh.copy()
    other.apply_transform(turn)
    other.apply_scale(scale)
    other.apply_translation((0.2, -0.5, 0.1))
    return other


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
@pytest.mark.parametrize(("kind", "scale"), [("rigid", 1.0), ("similarity", 2.5)])
def test_a_moved_body_comes_back(body, kind, scale, seed):
    found = register(moved(body, 1.0 / scale, seed), body, kind)
    assert found.scale == pytest.approx(scale, rel=0.01)
    again = found.of(moved(body, 1.0 / scale, seed))
    assert np.abs(again.vertices - body.vertices).max() < 0.001
    back = found.inverse().of(again)
    assert np.allclose(back.vertices, moved(body, 1.0 / scale, seed).vertices)


def test_no_registration_moves_nothing_and_a_rigid_one_keeps_the_size(body):
    assert np.array_equal(register(moved(body, 2.0, 0), body, "none").matrix, np.eye(4))
    assert register(moved(body, 2.0, 0), body, "rigid").scale == pytest.approx(1.0)


def test_a_mirror_image_stays_one(body):
    mirrored = body.copy()
    mirrored.apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0]))
    motion = register(mirrored, body, "similarity")
    assert np.linalg.det(motion.matrix[:3, :3]) > 0
    assert np.abs(motion.of(mirrored).vertices - body.vertices).max() > 0.005


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


EMITTER = np.array([0.0, 0.0, -0.01])
EARS = np.array([[-0.01, 0.01, 0.005], [-0.01, -0.01, 0.005]])
RANGES = np.linspace(0.2, 0.6, 400)
BOX = [-0.05] * 3, [0.05] * 3, 0.005
# Voxels of that box, far enough apart to be told from one another, and their powers.
SCENE = {(0.01, -0.02, 0.015): 2.0, (-0.03, 0.03, -0.02): 0.5, (0.035, 0.03, 0.0): 1.0}
WIDTH = 0.004
WINDOW_STEP = 0.0002
WINDOW = np.exp(-((WINDOW_STEP * np.arange(-60, 61) / WIDTH) ** 2))


def poses(count=60, seed=0):
    generator = np.random.default_rng(seed)
    positions = generator.normal(size=(count, 3))
    # Near and far, so that spreading tells.
    positions *= generator.uniform(0.3, 0.5, (count, 1)) / np.linalg.norm(
        positions, axis=1, keepdims=True
    )
    return positions, np.linalg.qr(generator.normal(size=(count, 3, 3)))[0]


def echoes(positions, rotations):
    """Energies of the scene's echoes by a slow loop, as magnitudes of three frequencies."""
    for position, rotation in zip(positions, rotations, strict=True):
        energy = np.zeros((2, len(RANGES)))
        for place, power in SCENE.items():
            out = np.linalg.norm(place - (position + rotation @ EMITTER))
            for ear in range(2):
                back = np.linalg.norm(place - (position + rotation @ EARS[ear]))
                shape = np.exp(-(((RANGES - (out + back) / 2) / WIDTH) ** 2))
                energy[ear] += power * shape / (out * back) ** 2
        yield np.sqrt(energy[..., None] * [0.2, 0.5, 0.3])


def run(spectrograms, positions, rotations, ranges=RANGES, window=WINDOW, **options):
    def places(at, turn):
        return at + turn @ EMITTER, at[:, None] + EARS @ turn.swapaxes(1, 2)

    head = SimpleNamespace(
        range=ranges,
        places=places,
        window=np.sqrt(window)[None],
        sampling_rate=343.0 / (2 * WINDOW_STEP),
        speed_of_sound=343.0,
    )
    return voxel_fit(spectrograms, Poses(positions, rotations), head, *BOX, **options)


@pytest.fixture(scope="module")
def fitted():
    positions, rotations = poses()
    return run(echoes(positions, rotations), positions, rotations, passes=20)


def test_a_scene_of_voxels_is_found_with_its_powers(fitted):
    points, power = fitted.points(), fitted.values.ravel()
    for place, expected in SCENE.items():
        near = np.linalg.norm(points - place, axis=1) < 1.5 * BOX[2]
        found = points[near][power[near].argmax()]
        np.testing.assert_allclose(found, place, atol=1e-9)
        # A voxel's depth widens the window by a tenth, and linear slices round it.
        assert power[near].sum() == pytest.approx(expected, rel=0.1)
    assert power.sum() == pytest.approx(sum(SCENE.values()), rel=0.1)


def test_no_power_is_negative_and_every_one_is_finite(fitted):
    assert np.isfinite(fitted.values).all()
    assert (fitted.values >= 0).all()


def test_silence_has_no_power():
    positions, rotations = poses(3)
    assert (run(np.zeros((3, 2, 400, 1)), positions, rotations).values == 0).all()


def test_what_lies_beyond_the_recording_has_no_power():
    positions, rotations = poses(3)
    for beyond in (np.linspace(2.0, 3.0, 500), np.linspace(0.01, 0.1, 500)):
        volume = run(np.ones((3, 2, 500, 1)), positions, rotations, beyond, window=np.ones(61))
        assert (volume.values == 0).all()


def test_wrong_input_is_refused():
    positions, rotations = poses(3)
    good = np.zeros((3, 2, 400, 1))
    with pytest.raises(ValueError, match="one for each of 3 poses"):
        run(good[:2], positions, rotations)
    with pytest.raises(ValueError, match="spectrogram 0"):
        run(good[:, :, 1:], positions, rotations)
    with pytest.raises(NumericalError, match="pose 0"):
        run(np.full_like(good, np.nan), positions, rotations)
