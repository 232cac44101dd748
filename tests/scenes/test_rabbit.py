# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.evaluation.solid import Solid
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


def test_a_rabbit_is_one_body_with_two_ears():
    mesh = load_scene("rabbit").mesh
    assert surface_faults(mesh) == []
    assert mesh.extents[2] == pytest.approx(0.12, rel=0.01)
    assert Solid(mesh).components == 1
    # A section through the ears has two parts, with nothing between them.
    top = mesh.vertices[mesh.vertices[:, 2] > 0.035]
    assert np.abs(top[:, 1]).min() > 0.001
    assert (top[:, 1] > 0).any()
    assert (top[:, 1] < 0).any()


def test_its_height_is_its_size():
    small, large = (load_scene("rabbit", {"height": h}).mesh for h in (0.06, 0.12))
    np.testing.assert_allclose(2.0 * small.extents, large.extents, rtol=0.02)
