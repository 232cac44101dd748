# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import MATERIALS, load_scene

FLAT = {"curl": 0.0, "bend": 0.0, "undulation": 0.0}
CORNERS = [
    {},
    {"curl": -120.0, "bend": 90.0, "undulation": 2e-3, "seed": 5},
    {"curl": 120.0, "bend": -90.0, "length": 0.05, "width": 0.05, "thickness": 1e-3},
]


@pytest.mark.parametrize("options", CORNERS)
def test_a_leaf_is_one_closed_fine_sheet(options):
    mesh = load_scene("leaf", options).mesh
    assert surface_faults(mesh) == []
    assert mesh.euler_number == 2
    assert mesh.body_count == 1
    assert mesh.edges_unique_length.max() <= EDGE
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 0.15  # before the first range


def test_a_flat_leaf_has_its_size_and_its_middle_in_the_origin():
    scene = load_scene("leaf", FLAT)
    mesh = scene.mesh
    # Tip at half the length, stalk 20 mm beyond the other half; the blade is widest at 40 %.
    np.testing.assert_allclose(mesh.bounds[:, 2], [-0.11, 0.09], atol=1e-8)
    np.testing.assert_allclose(mesh.bounds[:, 1], [-0.05, 0.05], atol=2e-5)
    # Half the sheet's 0.4 mm, and the midrib: 0.8 mm below and half as much above.
    np.testing.assert_allclose(mesh.bounds[:, 0], [-1.0e-3, 0.6e-3], atol=2e-5)
    # Volume without ribs: the thickness times the area, a beta function of the two powers.
    from scipy.special import beta

    greatest = 0.4**0.6 * 0.6**0.9
    area = 0.18 * 0.1 * beta(1.6, 1.9) / greatest + 0.02 * 2.4e-3
    assert 1.02 < mesh.volume / (area * 4e-4) < 1.5
    assert scene.material == MATERIALS["leaf"]


def test_curl_and_bend_turn_the_edges_as_said():
    curled = load_scene("leaf", {**FLAT, "curl": 60.0}).mesh
    radius = 0.1 / np.radians(60.0)
    np.testing.assert_allclose(curled.extents[1], radius, atol=5e-4)  # a chord of 60 degrees
    assert curled.bounds[1, 0] == pytest.approx(radius * (1 - np.sqrt(0.75)), abs=5e-4)
    bent = load_scene("leaf", {**FLAT, "bend": 60.0}).mesh
    tip = bent.vertices[bent.vertices[:, 2].argmax()]
    radius = 0.18 / np.radians(60.0)
    np.testing.assert_allclose(tip, [-radius * (1 - np.sqrt(0.75)), 0.0, radius / 2], atol=3e-4)


def test_the_upper_side_faces_x_and_is_turned_about_the_middle():
    upright = load_scene("leaf").mesh
    turned = load_scene("leaf", {"yaw": 90.0}).mesh
    np.testing.assert_allclose(
        turned.vertices, upright.vertices @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), atol=2e-9
    )
    # The midrib's flatter ridge is ahead, and the hollow of the curl.
    assert upright.vertices[np.abs(upright.vertices[:, 1]) > 0.04, 0].min() > 0.0


def test_the_seed_draws_waves_and_veins():
    first, again, other = (load_scene("leaf", {"seed": seed}).mesh for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert np.abs(first.bounds - other.bounds).max() > 1e-4


@pytest.mark.parametrize(
    "options",
    [{"curl": 121.0}, {"bend": 91.0}, {"thickness": 0.0}, {"undulation": 0.1}, {"width": 0.2}],
)
def test_options_have_bounds(options):
    with pytest.raises(SettingsError, match=rf"scene\.options\.{next(iter(options))}"):
        load_scene("leaf", options)


def test_a_leaf_wider_than_long_is_refused():
    with pytest.raises(SettingsError, match=r"width: found 0\.1; must not exceed length, 0\.09"):
        load_scene("leaf", {"length": 0.09})
