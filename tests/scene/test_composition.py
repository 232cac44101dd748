# SPDX-License-Identifier: MIT
import logging

import numpy as np
import pytest
import trimesh

from sononerf.errors import SettingsError
from sononerf.geometry.poses import rotation_from_euler
from sononerf.scene.material import INSECT, LEAF, RIGID
from sononerf.scene.scene import Part, Scene, compose


def box(size=(0.02, 0.04, 0.06), **named):
    return Scene(trimesh.creation.box(size), **named)


def two_sided():
    return box(material=(LEAF, RIGID), part=np.repeat([1, 0], 6))


def test_a_part_is_scaled_then_turned_then_moved():
    quarter = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # x to y
    mesh = compose([Part(box(), (1.0, 2.0, 3.0), quarter, 2.0)]).mesh
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(mesh.extents, [0.08, 0.04, 0.12])
    first = box().mesh.vertices[0]
    np.testing.assert_allclose(mesh.vertices[0], 2 * first[[1, 0, 2]] * [-1, 1, 1] + [1, 2, 3])


def test_triangles_follow_one_another_and_what_is_not_placed_keeps_every_bit():
    first, second = box(), Scene(trimesh.creation.icosphere(subdivisions=2, radius=0.01))
    whole = compose([Part(first), Part(second, (0.5, 0.0, 0.0))])
    np.testing.assert_array_equal(whole.mesh.vertices[:8], first.mesh.vertices)
    np.testing.assert_array_equal(whole.mesh.faces[:12], first.mesh.faces)
    assert len(whole.mesh.faces) == 12 + len(second.mesh.faces)
    assert whole.mesh.volume == pytest.approx(first.mesh.volume + second.mesh.volume)
    assert (whole.material, whole.part, whole.background) == (RIGID, None, None)


def test_materials_that_are_alike_share_a_number():
    far = (1.0, 0.0, 0.0)
    whole = compose([Part(two_sided()), Part(box(material=LEAF), far), Part(box(), (2.0, 0, 0))])
    assert set(whole.materials) == {LEAF, RIGID}
    of = np.array([whole.materials[number] for number in whole.part])
    assert [*of] == [RIGID] * 6 + [LEAF] * 6 + [LEAF] * 12 + [RIGID] * 12
    one = compose([Part(box(material=LEAF)), Part(box(material=LEAF), far)])
    assert (one.material, one.part) == (LEAF, None)
    # Of three materials of a plugin's scene, those that no triangle is of do not stay.
    spare = box(material=(LEAF, INSECT, RIGID), part=np.full(12, 2))
    assert compose([Part(spare)]).material == RIGID


def test_a_material_of_a_part_lies_over_its_own():
    whole = compose([Part(two_sided(), material=INSECT), Part(box(), (1.0, 0.0, 0.0))])
    assert whole.materials == (INSECT, RIGID)
    np.testing.assert_array_equal(whole.part, np.repeat([0, 1], 12))


def test_background_is_marked_and_carried_on():
    mixed = box(background=np.arange(12) < 4)
    whole = compose([Part(mixed), Part(box(), (1, 0, 0)), Part(mixed, (2, 0, 0), background=True)])
    expected = [True] * 4 + [False] * 8 + [False] * 12 + [True] * 12
    np.testing.assert_array_equal(whole.background, expected)


TURN = rotation_from_euler(0.3, 0.2, 0.1)


@pytest.mark.parametrize(
    ("placing", "match"),
    [
        ({"rotation": 1.01 * TURN}, r"parts\.1\.rotation: found a matrix that is not orthonormal"),
        ({"rotation": np.ones((3, 3))}, "not orthonormal"),
        ({"rotation": TURN * [1, -1, 1]}, r"parts\.1\.rotation: found a reflection"),
        ({"rotation": np.eye(4)}, r"parts\.1\.rotation: found no 3 by 3"),
        ({"rotation": np.full((3, 3), np.nan)}, "found no 3 by 3 finite"),
        ({"scale": 0.0}, r"parts\.1\.scale: found 0; must lie above 0, at most 1000"),
        ({"scale": 1000.1}, "found 1000.1"),
        ({"scale": np.nan}, "found nan"),
        ({"position": (0.0, np.inf, 0.0)}, r"parts\.1\.position: found no three finite"),
        ({"position": (0.0, 0.0)}, r"parts\.1\.position"),
    ],
)
def test_what_is_no_placing_is_refused_in_one_line(placing, match):
    with pytest.raises(SettingsError, match=match) as error:
        compose([Part(box()), Part(box(), **placing)])
    assert "\n" not in str(error.value)


def test_bounds_themselves_pass():
    assert compose([Part(box(), scale=1000.0)]).mesh.extents[0] == pytest.approx(20.0)
    assert compose([Part(box(), rotation=TURN.round(7))]).mesh.volume == pytest.approx(4.8e-5)


def test_nothing_and_nothing_but_background_are_refused():
    with pytest.raises(SettingsError, match="parts: found none"):
        compose([])
    with pytest.raises(SettingsError, match="parts: all are background"):
        compose([Part(box(), background=True)])


def test_parts_that_cut_through_one_another_are_named_in_one_line(caplog):
    parts = [
        Part(box(), name="leaf"),
        Part(box(), (0.5, 0.0, 0.0)),
        Part(box(), (0.01, 0.01, 0.01)),
        Part(box(), (0.51, 0.01, 0.01), name="stone"),
    ]
    compose(parts)
    (said,) = caplog.messages
    assert "one another: 0 (leaf) and 2, 1 and 3 (stone); the union" in said
    assert said.endswith("what lies inside another body is never heard")
    assert caplog.records[0].name == "sononerf"
    assert caplog.records[0].levelno == logging.WARNING


def test_crossing_that_is_meant_and_parts_apart_are_passed_over(caplog):
    compose([Part(box()), Part(box(), (0.01, 0.01, 0.01))], may_cross=True)
    compose([Part(box()), Part(box(), (0.021, 0.0, 0.0))])
    assert not caplog.records
