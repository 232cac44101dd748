# SPDX-License-Identifier: MIT
"""Contract of all scenes, and what only some of them promise."""

from __future__ import annotations

from functools import cache
from math import pi, sin

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from sononerf_scenes.bodies import EDGE

from sononerf.errors import InputError, SettingsError
from sononerf.evaluation.metrics import Solid
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.material import MATERIALS
from sononerf.scene.scene import list_scenes, load_scene, surfaces_cross
from sononerf.settings import loading
from sononerf.testing import check_scene

NEEDY = ("composed", "mesh")  # scenes that need an option
NAMES = [plugin.name for plugin in list_scenes() if plugin.name not in NEEDY]
LIGHT = {"clutter": {"density": 0.2}}  # it takes seconds with all of its stones and leaves
FLAT = ("box", "plate", "star", "clutter")  # flat faces need no fine triangles


@cache
def load(name, **options):
    return load_scene(name, options)


def options_of(name):
    return {row["name"] for row in loading.describe_options(loading.load(loading.SCENES, name))}


@pytest.mark.parametrize("name", NAMES)
def test_each_scene_is_sound_and_the_same_each_time(name):
    scene = check_scene(name, **LIGHT.get(name, {}))
    mesh = scene.mesh
    assert 0.02 < mesh.extents.max() < 0.5
    if name not in FLAT:
        assert mesh.edges_unique_length.max() <= 1.6 * EDGE
    if "material" in options_of(name):
        assert load(name, material="insect").materials[0] == MATERIALS["insect"]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if "yaw" in options_of(name)])
def test_each_scene_is_turned_as_a_head_is(name):
    """Pitch takes what is up to where x points, and then yaw takes x to y."""
    lengths = load(name).mesh.extents
    turned = load(name, yaw=90.0, pitch=90.0).mesh
    np.testing.assert_allclose(turned.extents, lengths[[1, 2, 0]], atol=1e-7)
    with pytest.raises(SettingsError, match=r"scene\.options\.yaw"):
        load(name, yaw=1000.0)


@pytest.mark.parametrize("name", [name for name in NAMES if "seed" in options_of(name)])
def test_another_seed_is_another_scene(name):
    given = {"target": "sphere", **LIGHT["clutter"]} if name == "clutter" else {}
    first, other = (load(name, seed=seed, **given).mesh.vertices for seed in (3, 4))
    assert first.shape != other.shape or (first != other).any()
    with pytest.raises(SettingsError, match=r"scene\.options\.seed"):
        load(name, seed=-1, **given)


@pytest.mark.parametrize(
    ("name", "options", "bodies", "euler", "extents", "volume"),
    [
        ("sphere", {"radius": 0.02}, 1, 2, [0.04] * 3, 4 / 3 * pi * 0.02**3),
        ("box", {"size": [0.1, 0.06, 0.02]}, 1, 2, [0.1, 0.06, 0.02], 1.2e-4),
        ("plate", {"sides": [0.08, 0.12]}, 1, 2, [0.001, 0.08, 0.12], 9.6e-6),
        ("capsule", {}, 1, 2, [0.03, 0.03, 0.09], pi * 0.015**2 * 0.08),
        ("torus", {}, 1, 0, [0.106, 0.106, 0.026], 2 * pi**2 * 0.04 * 0.013**2),
        ("torus", {"major_radius": 0.02, "minor_radius": 0.019}, 1, 0, None, 2 * pi**2 * 7.22e-6),
        ("rings", {}, 2, 0, [0.119, 0.084, 0.084], 4 * pi**2 * 0.035 * 0.007**2),
        ("cone", {}, 1, 2, [0.08, 0.08, 0.09], pi * 0.04**2 * 0.03),
        ("cone", {"radius": 0.01, "height": 0.12}, 1, 2, [0.02, 0.02, 0.12], pi * 0.01**2 * 0.04),
        ("beaker", {}, 1, 2, [0.08, 0.08, 0.09], pi * (0.04**2 * 0.09 - 0.036**2 * 0.086)),
        ("tower", {}, 1, 2, [0.09] * 3, 0.03 * (0.03**2 + 0.06**2 + 0.09**2)),
        ("star", {}, 1, 2, None, 0.06 * 5 * 0.04**2 * 0.55 * sin(pi / 5)),
        ("star", {"points": 3, "depth": 0.0}, 1, 2, None, 0.06 * 3 * 0.04**2 * sin(pi / 3)),
        ("stool", {}, 1, 2, [0.1, 0.1, 0.066], pi * (0.05**2 * 0.006 + 3 * 0.003**2 * 0.06)),
        ("stool", {"legs": 12, "seat_radius": 0.02}, 1, 2, [0.04, 0.04, 0.066], None),
        ("helix", {}, 1, 2, None, pi * 0.003**2 * 4 * np.hypot(2 * pi * 0.03, 0.025)),
        ("blob", {"seed": 2}, 1, 2, None, 4 / 3 * pi * 0.045**3),
        ("cluster", {"count": 8, "spread": 0.09}, 8, 16, None, None),
        ("three_spheres", {}, 3, 6, [0.03, 0.03 + 0.06435, 0.03 + 0.0492], 4 * pi * 0.015**3),
        ("ua", {"radius": 0.01}, 19, 38, [0.02, 0.1512, 0.0955], None),
        ("letters", {"text": "b 8"}, 5, None, None, None),
        ("letters", {"text": "I", "height": 0.2, "stroke": 0.1}, 1, 2, [0.04, 0.04, 0.2], None),
        ("leaf", {"curl": -120.0, "bend": 90.0, "undulation": 2e-3}, 1, 2, None, None),
        ("leaf", {"length": 0.05, "width": 0.05, "thickness": 1e-3}, 1, 2, None, None),
        ("leaf_dragonfly", {}, 24, 32, None, None),
        ("duck", {"length": 0.08}, 1, 2, None, None),
        ("rabbit", {"height": 0.06}, 9, 18, None, None),
        ("clutter", {"target": "sphere", "density": 0.3}, 21, None, None, None),
        ("procedural", {"seed": 2}, 1, 0, None, None),
        ("procedural", {"seed": 13}, 3, 6, None, None),
    ],
)
def test_scenes_have_their_parts_sizes_and_volumes(name, options, bodies, euler, extents, volume):
    mesh = load_scene(name, options).mesh
    assert surface_faults(mesh) == []
    assert mesh.body_count == bodies
    if euler is not None:
        assert mesh.euler_number == euler
    if extents is not None:
        np.testing.assert_allclose(mesh.extents, extents, rtol=5e-3)
    if volume is not None:
        assert mesh.volume == pytest.approx(volume, rel=0.04)


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("box", {"size": [0.1, 0.1]}, "size"),
        ("box", {"size": [0.1, 0.1, 0.0]}, "size"),
        ("plate", {"thickness": 0.0}, "thickness"),
        ("capsule", {"length": 0.0}, "length"),
        ("cone", {"height": -1.0}, "height"),
        ("torus", {"minor_radius": 0.04}, r"minor_radius: found 0\.04; must lie below .*0\.04"),
        ("rings", {"minor_radius": 0.02}, r"minor_radius: found 0\.02; .* half .* 0\.0175$"),
        ("beaker", {"wall": 0.04}, r"wall: found 0\.04; must lie below radius, 0\.04"),
        ("beaker", {"wall": 0.03, "height": 0.02}, r"wall: found 0\.03; must lie below height"),
        ("tower", {"steps": 9}, "steps"),
        ("star", {"points": 2}, "points"),
        ("blob", {"roughness": 0.5}, "roughness"),
        ("stool", {"leg_radius": 0.012}, r"leg_radius: found 0\.012; must not exceed 0\.0114"),
        ("stool", {"legs": 12, "leg_radius": 0.0095}, r"leg_radius: .* else the legs would touch"),
        ("helix", {"pitch_length": 0.006}, r"wire_radius: .* else neighbouring turns"),
        ("helix", {"radius": 0.003}, r"wire_radius: .* else the wire would fill"),
        ("cluster", {"count": 50, "spread": 0.03}, r"spread: .* do not fit|.*do not fit"),
        ("cluster", {"radius_min": 0.03}, r"radius_min: found 0\.03; must not exceed .*0\.02"),
        ("letters", {"text": "A-B"}, r"text: no letter '-'.*allowed are A to Z, 0 to 9 and spaces"),
        ("letters", {"text": "  "}, "text: nothing but"),
        ("leaf", {"curl": 121.0}, "curl"),
        ("leaf", {"length": 0.09}, r"width: found 0\.1; must not exceed length, 0\.09"),
        (
            "leaf_dragonfly",
            {"along": 0.06, "across": 0.03, "heading": 90.0},
            r"along: found 0\.06, .* reach past the leaf's edge",
        ),
        (
            "leaf_dragonfly",
            {"length": 0.05, "width": 0.03, "body_length": 0.08, "placement_seed": 0},
            r"body_length: found 0\.08; there is no room",
        ),
        ("clutter", {"target": "bax"}, "target: unknown scene 'bax'"),
        ("clutter", {"target_options": {"sed": 1}}, r"target_options\.sed: unknown key"),
        ("procedural", {"seed": 2**32}, "seed"),
        ("composed", {"parts": []}, "parts"),
    ],
)
def test_what_cannot_be_is_refused_by_its_option(name, options, said):
    with pytest.raises(SettingsError, match=rf"^scene\.options\.{said}|{said}") as caught:
        load_scene(name, options)
    assert "scene.options" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_three_spheres_stand_as_in_the_paper():
    parts = load("three_spheres").mesh.split()
    centres = np.array([part.bounds.mean(axis=0) for part in parts])
    np.testing.assert_allclose(centres.mean(axis=0), 0.0, atol=1e-12)
    # 3.28 and 4.29 radii along z and y.
    np.testing.assert_allclose(np.ptp(centres, axis=0) / 0.015, [0.0, 4.29, 3.28], atol=1e-9)


def test_each_ring_runs_through_the_other():
    one, other = load("rings").mesh.split()
    assert cKDTree(one.vertices).query(other.vertices)[0].min() == pytest.approx(0.021, abs=3e-4)
    for ring, through in ((one, other), (other, one)):
        axis = np.argmin(ring.extents)
        reach = np.delete(through.vertices - ring.bounds.mean(axis=0), axis, axis=1)
        away = np.linalg.norm(reach[np.abs(through.vertices[:, axis]) < 0.002], axis=1)
        # In the ring's plane the other one is met in its hole, and once more outside.
        assert (away < 0.028).any()
        assert (away > 0.042).any()


def test_a_beaker_is_open_on_top_and_hollow():
    solid = Solid(load("beaker").mesh)
    heights = np.array([[0, 0, z] for z in (0.06, 0.0, -0.0405, -0.043)])
    np.testing.assert_array_equal(solid.contains(heights), [False, False, False, True])
    walls = np.array([[x, 0.0, 0.0] for x in (0.038, 0.035, 0.041)])
    np.testing.assert_array_equal(solid.contains(walls), [True, False, False])


@pytest.mark.parametrize("name", ["cluster", "letters", "procedural"])
def test_bodies_that_are_apart_do_not_touch(name):
    parts = load(name, **({"seed": 13} if name == "procedural" else {})).mesh.split()
    trees = [cKDTree(part.vertices) for part in parts]
    if name == "letters":  # strokes of a letter overlap, and are three thicknesses
        assert len({round(part.extents[0], 5) for part in parts}) == 3
        return
    for number, part in enumerate(parts):
        for tree in trees[number + 1 :]:
            assert tree.query(part.vertices)[0].min() > 1e-3


def test_text_is_read_from_ahead():
    mesh = load("letters", text="LI").mesh
    low = np.sort(mesh.vertices[mesh.vertices[:, 2] < -0.03][:, 1])
    # From +x, y is to the right: the L's foot reaches to the right, towards the I.
    assert low[np.argmax(np.diff(low))] > 0.01


def test_a_helix_is_right_handed():
    mesh = load("helix", turns=2.0).mesh
    angle = np.linspace(0.0, 4.0 * pi, 20000)
    line = np.stack([0.03 * np.cos(angle), 0.03 * np.sin(angle), 0.025 * angle / 2 / pi], 1)
    distance = cKDTree(line).query(mesh.vertices + np.array([0.0, 0.0, 0.025]))[0]
    np.testing.assert_allclose(distance, 0.003, atol=3e-5)


def test_a_flat_leaf_has_its_size_and_its_middle_in_the_origin():
    mesh = load("leaf", curl=0.0, bend=0.0, undulation=0.0).mesh
    # Tip at half the length, stalk 20 mm beyond the other half; the midrib stands out.
    np.testing.assert_allclose(mesh.bounds[:, 2], [-0.11, 0.09], atol=1e-8)
    np.testing.assert_allclose(mesh.bounds[:, 1], [-0.05, 0.05], atol=2e-5)
    np.testing.assert_allclose(mesh.bounds[:, 0], [-1.0e-3, 0.6e-3], atol=2e-5)


def test_curl_and_bend_turn_the_edges_as_said():
    curled = load("leaf", curl=60.0, bend=0.0, undulation=0.0).mesh
    radius = 0.1 / np.radians(60.0)
    np.testing.assert_allclose(curled.extents[1], radius, atol=5e-4)  # a chord of 60 degrees
    bent = load("leaf", curl=0.0, bend=60.0, undulation=0.0).mesh
    tip = bent.vertices[bent.vertices[:, 2].argmax()]
    radius = 0.18 / np.radians(60.0)
    np.testing.assert_allclose(tip, [-radius * (1 - np.sqrt(0.75)), 0.0, radius / 2], atol=3e-4)


def test_prey_sits_on_the_same_leaf(caplog):
    leaf = {"seed": 3, "curl": 40.0, "bend": 50.0, "yaw": 25.0}
    alone, both = load("leaf", **leaf), load("leaf_dragonfly", **leaf, along=0.01, heading=30.0)
    count = len(alone.mesh.vertices)
    np.testing.assert_array_equal(both.mesh.vertices[:count], alone.mesh.vertices)
    assert both.materials == (MATERIALS["leaf"], MATERIALS["insect"])
    assert both.mesh.faces[both.part == 1].min() == count
    # Its feet reach the leaf, its body stands some millimetres above.
    prey = trimesh.Trimesh(both.mesh.vertices, both.mesh.faces[both.part == 1]).split()
    tree = cKDTree(alone.mesh.vertices)
    least = sorted(float(tree.query(part.vertices)[0].min()) for part in prey)
    assert least[5] < 1e-3 < 2.5e-3 < least[-5]
    assert not caplog.records
    drawn = [load("leaf_dragonfly", placement_seed=n).mesh.centroid for n in (1, 2)]
    assert np.linalg.norm(drawn[0] - drawn[1]) > 1e-5


def test_clutter_does_not_touch_its_target():
    large = {"target": "box", "target_options": {"size": [0.3, 0.1, 0.4]}, "density": 0.2}
    scene = load_scene("clutter", large)
    target, background = (
        trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces[which])
        for which in (~scene.background, scene.background)
    )
    np.testing.assert_allclose(target.extents, [0.3, 0.1, 0.4])
    assert not surfaces_cross(target, background)
    # Ground and twig give way: below and behind.
    assert background.vertices[background.vertices[:, 2] > -0.2, 0].max() < -0.15
    assert scene.background.sum() > 1000


def test_a_rabbit_has_two_ears_and_a_duck_looks_forward():
    top = load("rabbit").mesh.vertices
    ears = top[top[:, 2] > 0.035]
    assert np.abs(ears[:, 1]).min() > 0.001
    assert (ears[:, 1] > 0).any()
    assert (ears[:, 1] < 0).any()
    duck = load("duck").mesh.vertices
    beak = duck[duck[:, 0].argmax()]
    assert beak[2] > 0.0
    assert abs(beak[1]) < 0.004


BOX = {"scene": "box", "options": {"size": [0.02, 0.04, 0.06]}}


def composed(*parts):
    return load_scene("composed", {"parts": list(parts)})


def test_parts_are_placed_and_not_centred_again(caplog):
    far = {"position": [0.1, 0.2, 0.3], "yaw": 90.0, "scale": 0.5, "background": True}
    scene = composed({**BOX, "material": "leaf"}, {**BOX, **far})
    both = scene.mesh.vertices[:8], scene.mesh.vertices[8:]
    np.testing.assert_allclose(np.ptp(both[0], axis=0), [0.02, 0.04, 0.06])
    np.testing.assert_allclose(np.ptp(both[1], axis=0), [0.02, 0.01, 0.03])
    np.testing.assert_allclose(both[1].mean(axis=0), [0.1, 0.2, 0.3])
    assert scene.materials == (MATERIALS["leaf"], MATERIALS["rigid"])
    np.testing.assert_array_equal(scene.background, np.arange(24) >= 12)
    turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    by_matrix, by_angle = composed({**BOX, "rotation": turn}), composed({**BOX, "yaw": 90.0})
    np.testing.assert_allclose(by_matrix.mesh.vertices, by_angle.mesh.vertices, atol=1e-12)
    inner = {"scene": "composed", "options": {"parts": [{**BOX, "position": [0.1, 0.0, 0.0]}]}}
    nested = composed({**inner, "scale": 2.0, "position": [0.0, 0.0, 1.0]})
    np.testing.assert_allclose(nested.mesh.bounds.mean(axis=0), [0.2, 0.0, 1.0])
    assert not caplog.messages
    composed(BOX, {"scene": "sphere", "position": [0.015, 0.0, 0.0]})
    assert "0 (box) and 1 (sphere)" in caplog.messages[0]


def nested(**part):
    return {"scene": "composed", "options": {"parts": [BOX, {**BOX, **part}]}}


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ({"scene": "bax"}, "1.scene: unknown scene 'bax'"),
        ({"options": {"sise": 1}}, "1.options.sise: unknown"),
        ({"scene": "mesh", "options": {"path": "a.stl"}}, "1.scene: a.stl: cannot be read"),
        ({"scene": "letters", "options": {"text": "?"}}, "1.options.text: no letter"),
        (nested(options={"size": 1}), "1.options.parts.1.options.size"),
        ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "1.rotation: found a matrix that is not"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "1.rotation: found a reflection"),
        ({"scale": 0}, "1.scale: found 0"),
        ({"scal": 1}, "1.scal: unknown key; did you mean scale"),
        ({"position": [0, 0]}, "1.position"),
        ({"material": "wood"}, "1.material: found 'wood'"),
        ({"rotation": np.eye(3).tolist(), "yaw": 0}, "1: rotation and yaw, pitch, roll are both"),
    ],
)
def test_a_fault_of_a_part_is_told_with_its_place(part, said):
    with pytest.raises((SettingsError, InputError)) as error:
        composed(BOX, {**BOX, **part})
    assert str(error.value).startswith(f"scene.options.parts.{said}")
    assert "\n" not in str(error.value)


def test_background_alone_is_refused():
    with pytest.raises(SettingsError, match=r"scene\.options\.parts: all are background"):
        composed({**BOX, "background": True})
