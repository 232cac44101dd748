# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from scipy.spatial import cKDTree
from sononerf_scenes.bodies import EDGE, SIDE

from sononerf.errors import SettingsError
from sononerf.evaluation.solid import Solid
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(("major", "minor"), [(0.035, 0.007), (0.04, 0.018)])
def test_rings_are_two_tori_that_do_not_touch(major, minor):
    mesh = load_scene("rings", {"major_radius": major, "minor_radius": minor}).mesh
    assert surface_faults(mesh) == []
    assert mesh.edges_unique_length.max() <= EDGE
    assert Solid(mesh).components == 2
    first, second = mesh.split()
    gap = cKDTree(first.vertices).query(second.vertices)[0].min()
    assert gap == pytest.approx(major - 2.0 * minor, abs=0.2 * SIDE)
    ratio = mesh.volume / (4.0 * np.pi**2 * major * minor**2)
    assert 1.0 - (SIDE / minor) ** 2 / 3.0 < ratio < 1.0
    wide, across = 3.0 * major + 2.0 * minor, 2.0 * (major + minor)
    np.testing.assert_allclose(mesh.extents, [wide, across, across], rtol=2e-3)


def test_each_ring_runs_through_the_other():
    one, other = load_scene("rings").mesh.split()
    for ring, through in ((one, other), (other, one)):
        middle = ring.bounds.mean(axis=0)
        axis = np.argmin(ring.extents)
        reach = np.delete(through.vertices - middle, axis, axis=1)
        at_the_plane = np.abs(through.vertices[:, axis] - middle[axis]) < 0.002
        away = np.linalg.norm(reach[at_the_plane], axis=1)
        # In the ring's plane the other one is met in its hole, and once more outside.
        assert (away < 0.035 - 0.007).any()
        assert (away > 0.035 + 0.007).any()


def test_rings_are_turned():
    mesh = load_scene("rings", {"yaw": 90.0}).mesh
    np.testing.assert_allclose(mesh.extents, [0.084, 0.119, 0.084], rtol=2e-3)


def test_rings_too_thick_to_be_linked_are_refused():
    with pytest.raises(SettingsError, match=r"minor_radius: found 0\.02; .* half .* 0\.0175$"):
        load_scene("rings", {"minor_radius": 0.02})
    with pytest.raises(SettingsError, match="minor_radius"):
        load_scene("rings", {"minor_radius": 0.0})
