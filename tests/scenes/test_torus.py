# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE, SIDE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(("major", "minor"), [(0.04, 0.013), (0.06, 0.01), (0.02, 0.019)])
def test_a_torus_is_round_both_ways_and_fine(major, minor):
    mesh = load_scene("torus", {"major_radius": major, "minor_radius": minor}).mesh
    assert surface_faults(mesh) == []
    assert mesh.euler_number == 0
    ring = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]) - major
    # An odd number of sections moves the middle of the bounding box by some micrometres.
    np.testing.assert_allclose(np.hypot(ring, mesh.vertices[:, 2]), minor, atol=1e-5)
    assert mesh.edges_unique_length.max() <= EDGE
    # Polygons of sides s instead of circles lose (s/r)^2 / 6, around the axis much less.
    ratio = mesh.volume / (2.0 * np.pi**2 * major * minor**2)
    assert 1.0 - (SIDE / minor) ** 2 / 3.0 < ratio < 1.0


def test_a_torus_is_turned():
    mesh = load_scene("torus", {"pitch": 90.0}).mesh
    np.testing.assert_allclose(mesh.extents, [0.026, 0.106, 0.106], rtol=1e-3)


def test_radii_that_close_the_hole_are_refused():
    with pytest.raises(SettingsError, match=r"minor_radius: found 0\.04; must lie below .*0\.04"):
        load_scene("torus", {"minor_radius": 0.04})
    with pytest.raises(SettingsError, match="minor_radius"):
        load_scene("torus", {"minor_radius": 0.0})
