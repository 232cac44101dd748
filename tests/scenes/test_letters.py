# SPDX-License-Identifier: MIT
import string

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from sononerf_scenes.bodies import EDGE, SIDE, _even
from sononerf_scenes.letters import FONT, SPACING, THINNER

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene

THICKEST = 0.12 / (1.0 - 2 * 0.12)  # radius of a stroke in the font's units


def finely(stroke):
    """Points of a stroke, 0.01 apart at most, and its directions there."""
    points, along = _even(0.1 * np.asarray(stroke), closed=False)
    return 10.0 * points, along


def test_the_font_has_all_capitals_and_digits():
    assert set(FONT) == set(string.ascii_uppercase + string.digits)


@pytest.mark.parametrize("letter", FONT)
def test_a_letter_stands_on_the_line_in_one_piece(letter):
    strokes = [finely(stroke)[0] for stroke in FONT[letter]]
    points = np.concatenate(strokes)
    np.testing.assert_allclose([points[:, 1].min(), points[:, 1].max()], [0.0, 1.0], atol=0.02)
    assert -1e-9 <= points[:, 0].min() <= 0.05
    # Each stroke begins, ends or crosses on another one, as far as they can be reached.
    reached, left = strokes[:1], strokes[1:]
    while left:
        near = [cdist(stroke, np.concatenate(reached)).min() < 0.02 for stroke in left]
        assert any(near)
        reached += [stroke for stroke, is_near in zip(left, near, strict=True) if is_near]
        left = [stroke for stroke, is_near in zip(left, near, strict=True) if not is_near]


@pytest.mark.parametrize("letter", FONT)
def test_no_stroke_bends_so_much_that_its_tube_folds(letter):
    for stroke in FONT[letter]:
        points, along = finely(stroke)
        turn = np.arccos(np.clip((along[1:] * along[:-1]).sum(axis=1), -1.0, 1.0))
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        assert (THICKEST * turn / step).max() < 1.0


def test_text_is_closed_fine_and_about_the_origin():
    mesh = load_scene("letters", {"text": "b 8"}).mesh
    assert surface_faults(mesh) == []
    assert mesh.edges_unique_length.max() <= 1.1 * EDGE
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(mesh.extents[[0, 2]], [0.016, 0.1], rtol=2e-3)
    assert mesh.body_count == len(FONT["B"]) + len(FONT["8"])


def gap(points):
    """Where along y the widest gap between points begins, and how wide it is."""
    across = np.sort(points[:, 1])
    widest = np.argmax(np.diff(across))
    return across[widest], across[widest + 1] - across[widest]


def test_text_is_read_from_ahead():
    mesh = load_scene("letters", {"text": "LI"}).mesh
    # From +x, y is to the right: the L's foot reaches to the right, towards the I.
    start, width = gap(mesh.vertices[mesh.vertices[:, 2] < -0.03])
    assert start > 0.01
    assert width == pytest.approx(SPACING * 0.1, abs=1e-3)
    start, width = gap(mesh.vertices[mesh.vertices[:, 2] > 0.03])
    assert start < -0.01
    assert width > 0.05


def test_a_stroke_is_a_capsule_and_later_ones_are_thinner():
    mesh = load_scene("letters", {"text": "I", "height": 0.2, "stroke": 0.1}).mesh
    exact = np.pi * 0.02**2 * 0.16 + 4.0 / 3.0 * np.pi * 0.02**3
    # Polygons of sides s instead of circles lose (s/r)^2 / 6; half spheres twice that.
    assert 1.0 - (SIDE / 0.02) ** 2 / 3.0 < mesh.volume / exact < 1.0
    parts = load_scene("letters", {"text": "H"}).mesh.split()
    widths = [part.extents[0] / 0.016 for part in parts]
    np.testing.assert_allclose(widths, [1.0, 1.0 - THINNER, 1.0 - 2 * THINNER], rtol=2e-3)
    assert widths[0] > widths[1] + 0.005 > widths[2] + 0.01


@pytest.mark.parametrize(
    ("text", "found"), [("AÄ", "no letter 'Ä'"), ("A-B", "no letter '-'"), ("  ", "nothing but")]
)
def test_an_unknown_letter_is_refused_with_the_known_ones(text, found):
    with pytest.raises(SettingsError) as caught:
        load_scene("letters", {"text": text})
    said = str(caught.value)
    assert said.startswith(f"scene.options.text: {found}")
    assert said.endswith("allowed are A to Z, 0 to 9 and spaces")
    assert "\n" not in said


@pytest.mark.parametrize("options", [{"text": ""}, {"text": "A" * 13}, {"stroke": 0.2}])
def test_options_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("letters", options)
