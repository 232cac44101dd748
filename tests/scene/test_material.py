# SPDX-License-Identifier: MIT
import math

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.scene.material import (
    INSECT,
    LEAF,
    MATERIALS,
    RIGID,
    SONOTRACELAB,
    Material,
    roughened,
)

NAN = float("nan")


def test_materials_have_names():
    assert MATERIALS == {
        "rigid": RIGID, "sonotracelab": SONOTRACELAB, "leaf": LEAF, "insect": INSECT
    }  # fmt: skip


def test_the_default_is_rigid_smooth_and_without_losses():
    assert Material() == RIGID
    assert RIGID.lobe_width is None
    assert (set(RIGID.strength), set(RIGID.reflection)) == ({1.0}, {1.0})
    assert not RIGID.mixed


def test_sonotracelab_has_the_numbers_of_its_leaf_scene():
    """SonoTraceLab's leaf scene: lobes 12 to 4 degrees, 70 where curved, transition 1000, 0.002."""
    np.testing.assert_allclose(np.degrees(SONOTRACELAB.lobe_width), [12, 4])
    np.testing.assert_allclose(np.degrees(SONOTRACELAB.curved_lobe_width), [70, 70])
    assert (SONOTRACELAB.transition_curvature, SONOTRACELAB.transition_slope) == (1000.0, 0.002)
    assert SONOTRACELAB.mixed


@pytest.mark.parametrize(("material", "height"), [(LEAF, 0.2e-3), (INSECT, 0.1e-3)])
def test_rough_surfaces_keep_what_is_in_step(material, height):
    """Pressure exp(-2 (k sigma)^2), the specular part of a rough surface seen from above."""
    wavenumber = 2 * np.pi * np.array(material.frequency) / 343.0
    expected = np.exp(-2 * (wavenumber * height) ** 2)
    np.testing.assert_allclose(material.strength, expected)
    np.testing.assert_allclose(material.reflection, expected)
    assert material.lobe_width is None
    assert (np.diff(material.frequency) > 0).all()
    assert 0.1 < min(material.strength) < max(material.strength) < 1.0


def test_a_rougher_material_keeps_its_lobes_and_weakens_all_strengths():
    found = roughened(SONOTRACELAB, 0.2e-3)
    last = math.exp(-2 * (2 * math.pi * 150e3 / 343.0 * 0.2e-3) ** 2)
    assert found.frequency[0], found.frequency[-1] == (20e3, 150e3)
    for name in ("lobe_width", "curved_lobe_width", "diffraction"):
        assert getattr(found, name)[-1] == pytest.approx(getattr(SONOTRACELAB, name)[-1])
    for name in ("strength", "curved_strength", "reflection"):
        assert getattr(found, name)[-1] == pytest.approx(getattr(SONOTRACELAB, name)[-1] * last)
    assert found.transition_curvature == 1000.0


def test_no_height_is_no_roughness():
    np.testing.assert_array_equal(roughened(RIGID, 0.0).strength, 1.0)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"frequency": (2.0, 1.0)}, r"material frequency is \(2.0, 1.0\), expected ascending"),
        ({"frequency": (1.0, 1.0)}, "ascending"),
        ({"frequency": (0.0, 1.0)}, "ascending"),
        ({"frequency": (NAN, 1.0)}, "ascending"),
        ({"frequency": (1.0, math.inf)}, "ascending"),
        ({"frequency": ()}, "ascending"),
        ({"strength": (1.0, 1.0, 1.0)}, "material strength has 3 values, frequency 2"),
        ({"strength": (1.0, -0.1)}, r"material strength is \[1.0, -0.1\], expected 0 to inf"),
        ({"strength": (1.0, math.inf)}, "strength"),
        ({"strength": (1.0, NAN)}, "strength"),
        ({"reflection": (1.0, 1.1)}, "reflection is .*, expected 0 to 1"),
        ({"reflection": (1.0, -0.1)}, "reflection"),
        ({"lobe_width": (0.0, 0.1)}, "lobe_width is .*, expected 0.0001 to 3.14"),
        ({"lobe_width": (NAN, 0.1)}, "lobe_width"),
        ({"lobe_width": (0.1, 3.2)}, "lobe_width"),
        ({"lobe_width": (0.1, 0.1), "curved_lobe_width": (0.0, 1.0)}, "curved_lobe_width"),
        ({"curved_lobe_width": (1.0, 1.0)}, "curved_lobe_width is set, lobe_width is not"),
        ({"curved_strength": (1.0, -1.0)}, "curved_strength"),
        ({"diffraction": (1.0, 1.0, 1.0)}, "diffraction has 3 values"),
        ({"diffraction": (1.0, NAN)}, "diffraction"),
        ({"transition_curvature": 0.0}, "transition_curvature is 0.0, expected above 0"),
        ({"transition_curvature": NAN}, "transition_curvature"),
        ({"transition_slope": -1.0}, "transition_slope"),
        ({"transition_slope": math.inf}, "transition_slope"),
    ],
)
def test_materials_that_make_no_sense_are_refused_in_one_line(arguments, match):
    with pytest.raises(InputError, match=f"^material .*{match.removeprefix('material ')}") as error:
        Material(**arguments)
    assert "\n" not in str(error.value)


def test_one_node_is_enough():
    assert Material((1e5,), (0.5,), (0.9,), (1.0,), diffraction=None).strength == (0.9,)
    assert Material((1e5,), None, (1.0,), (0.8,), diffraction=(1.0,)).reflection == (0.8,)


def test_one_value_holds_at_all_nodes():
    found = Material((2e4, 5e4, 1e5), lobe_width=(0.2,), strength=(1.0, 0.8, 0.5))
    assert found.lobe_width == (0.2, 0.2, 0.2)
    assert found.reflection == found.diffraction == (1.0, 1.0, 1.0)
    assert Material((5e4,)).strength == (1.0,)
