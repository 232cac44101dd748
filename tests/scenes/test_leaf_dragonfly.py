# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import MATERIALS, load_scene

LEAF = {"seed": 3, "curl": 40.0, "bend": 50.0, "length": 0.16, "yaw": 25.0, "roll": 10.0}


@pytest.mark.slow
def test_the_leaf_is_the_same_with_and_without_prey(caplog):
    alone = load_scene("leaf", LEAF)
    both = load_scene("leaf_dragonfly", {**LEAF, "along": 0.01, "heading": 30.0})
    count = len(alone.mesh.vertices)
    np.testing.assert_array_equal(both.mesh.vertices[:count], alone.mesh.vertices)
    np.testing.assert_array_equal(both.mesh.faces[: len(alone.mesh.faces)], alone.mesh.faces)
    # The prey comes after, of a material of its own; its feet on the leaf are no fault.
    prey = both.part == 1
    np.testing.assert_array_equal(np.flatnonzero(~prey), np.arange(len(alone.mesh.faces)))
    assert both.materials == (MATERIALS["leaf"], MATERIALS["insect"])
    assert both.mesh.faces[prey].min() == count
    assert surface_faults(both.mesh) == []
    assert not caplog.records


@pytest.mark.slow
@pytest.mark.thorough
def test_materials_are_options_and_one_alone_is_one():
    scene = load_scene("leaf_dragonfly", {"material": "rigid", "dragonfly": "leaf"})
    assert scene.materials == (MATERIALS["rigid"], MATERIALS["leaf"])
    scene = load_scene("leaf_dragonfly", {"material": "rigid", "dragonfly": "rigid"})
    assert scene.material == MATERIALS["rigid"]


def prey(**options):
    mesh = load_scene("leaf_dragonfly", options).mesh
    count = len(load_scene("leaf").mesh.vertices)
    return np.asarray(mesh.vertices)[count:]


@pytest.mark.slow
@pytest.mark.thorough
def test_it_is_turned_with_the_leaf():
    np.testing.assert_allclose(
        prey(yaw=90.0), prey() @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), atol=2e-9
    )


@pytest.mark.slow
@pytest.mark.thorough
def test_a_placement_seed_draws_where_it_sits():
    first, again, other = prey(placement_seed=1), prey(placement_seed=1), prey(placement_seed=2)
    np.testing.assert_array_equal(first, again)
    assert np.linalg.norm(first.mean(axis=0) - other.mean(axis=0)) > 5e-3
    # What is set beside it does not count.
    np.testing.assert_array_equal(prey(placement_seed=1, along=0.02, heading=40.0), first)


def test_what_would_overhang_is_refused():
    with pytest.raises(SettingsError, match=r"along: found 0\.06, .* reach past the leaf's edge"):
        load_scene("leaf_dragonfly", {"along": 0.06, "across": 0.03, "heading": 90.0})
    with pytest.raises(SettingsError, match=r"body_length: found 0\.08; there is no room"):
        load_scene(
            "leaf_dragonfly",
            {"length": 0.05, "width": 0.03, "body_length": 0.08, "placement_seed": 0},
        )


@pytest.mark.parametrize("options", [{"along": 0.07}, {"across": -0.04}, {"body_length": 0.09}])
def test_options_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("leaf_dragonfly", options)
