# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE
from sononerf_scenes.cluster import GAP
from sononerf_scenes.procedural import KINDS

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.material import MATERIALS
from sononerf.scene.scene import load_scene


def shape(seed):
    return load_scene("procedural", {"seed": seed}).mesh


@pytest.mark.parametrize("seed", range(15))
def test_a_shape_is_sound_fine_and_of_a_hand_s_size(seed):
    mesh = shape(seed)
    assert surface_faults(mesh) == []
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-8)
    assert 0.06 <= mesh.extents.max() <= 0.2
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 0.14  # before the first range, 15 cm
    if KINDS[seed % 5] == "box":
        assert len(mesh.faces) == 12
    else:
        assert mesh.edges_unique_length.max() <= 1.15 * EDGE


def test_each_seed_is_a_shape_of_its_own():
    np.testing.assert_array_equal(shape(4).vertices, shape(4).vertices)
    volumes = [shape(seed).volume for seed in range(10)]
    assert len(set(np.round(volumes, 9))) == 10


def test_kinds_take_turns():
    # A torus alone has a hole; capsules come one, two and three at a time.
    assert [shape(seed).euler_number for seed in (2, 7)] == [0, 0]
    assert [shape(seed).body_count for seed in (3, 8, 13, 18)] == [1, 2, 3, 1]
    assert all(3 <= shape(seed).body_count <= 7 for seed in (0, 5))


def test_capsules_do_not_touch():
    parts = shape(13).split()
    for index, part in enumerate(parts):
        for other in parts[index + 1 :]:
            # Vertices lie on the bodies, and no two faces come closer than a sagitta below them.
            nearest = min(
                np.linalg.norm(other.vertices - vertex, axis=1).min()
                for vertex in part.vertices[::7]
            )
            assert nearest >= GAP - 1e-4


@pytest.mark.parametrize("seed", range(5))
def test_the_material_is_an_option_of_every_kind(seed):
    scene = load_scene("procedural", {"seed": seed, "material": "leaf"})
    assert scene.material == MATERIALS["leaf"]


@pytest.mark.parametrize("seed", [-1, 1.5, 2**32])
def test_other_seeds_are_refused(seed):
    with pytest.raises(SettingsError, match=r"scene\.options\.seed"):
        load_scene("procedural", {"seed": seed})
