# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh
from sononerf_scenes.bodies import EDGE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.composition import surfaces_cross
from sononerf.scene.scene import MATERIALS, load_scene

SPHERE = {"target": "sphere", "target_options": {"radius": 0.04}}


def halves(scene):
    """Target and background."""
    for which in (~scene.background, scene.background):
        part = trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces[which], process=False)
        part.remove_unreferenced_vertices()
        yield part


SLOW = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=SLOW) for seed in (1, 2, 3))])
def test_nothing_touches_the_target_nor_comes_near_the_poses(seed):
    scene = load_scene("clutter", {"seed": seed, "density": 1.0})
    target, background = halves(scene)
    assert not surfaces_cross(target, background)
    assert np.linalg.norm(background.vertices, axis=1).max() < 0.32
    on_ground = background.vertices[:, 2] < -0.14
    # What is not the ground lies behind the target.
    assert background.vertices[~on_ground, 0].max() <= -0.09 + 1e-9
    assert target.bounds[0, 2] > -0.14
    assert surface_faults(scene.mesh) == []


@pytest.mark.slow
@pytest.mark.thorough
def test_the_target_is_itself_and_comes_first():
    alone = load_scene("leaf_dragonfly", {"seed": 2})
    scene = load_scene("clutter", {"target_options": {"seed": 2}, "density": 0.1})
    count = len(alone.mesh.faces)
    np.testing.assert_array_equal(np.flatnonzero(~scene.background), np.arange(count))
    np.testing.assert_array_equal(
        scene.mesh.vertices[: len(alone.mesh.vertices)], alone.mesh.vertices
    )
    assert set(scene.materials) == {MATERIALS[name] for name in ("leaf", "insect", "rigid")}


def test_ground_and_twig_give_way_to_a_large_target():
    large = {"target": "box", "target_options": {"size": [0.3, 0.1, 0.4]}, "density": 0.2}
    target, background = halves(load_scene("clutter", large))
    np.testing.assert_allclose(target.extents, [0.3, 0.1, 0.4])
    assert not surfaces_cross(target, background)
    stones = background.vertices[background.vertices[:, 2] < -0.2]
    assert stones[:, 2].max() == pytest.approx(-0.21)
    assert background.vertices[background.vertices[:, 2] > -0.2, 0].max() == pytest.approx(-0.16)


def test_density_is_how_much_there_is():
    bare, full = (load_scene("clutter", {**SPHERE, "density": d}) for d in (0.0, 1.0))
    # The target, the ground and the twig; then 50 stones and 10 leaves.
    assert bare.mesh.body_count == 3
    assert full.mesh.body_count == 63
    _, background = halves(full)
    edges = background.edges_unique_length
    stones_and_leaves = background.vertices[background.edges_unique][:, :, 2].max(axis=1) > -0.159
    assert edges[stones_and_leaves].max() <= 1.2 * EDGE


def test_the_seed_draws_stones_and_leaves_and_not_the_target():
    first, again, other = (load_scene("clutter", {**SPHERE, "seed": seed}) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    (target, stones), (same, others) = halves(first), halves(other)
    np.testing.assert_array_equal(target.vertices, same.vertices)
    assert len(stones.vertices) != len(others.vertices)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"target": "bax"}, "scene.options.target: unknown scene 'bax'"),
        ({"target_options": {"sed": 1}}, "scene.options.target_options.sed: unknown key"),
        ({"density": 1.1}, "scene.options.density: found 1.1"),
    ],
)
def test_a_fault_is_told_with_its_place(options, said):
    with pytest.raises(SettingsError) as error:
        load_scene("clutter", options)
    assert str(error.value).startswith(said)
