# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(("points", "depth"), [(5, 0.45), (3, 0.0), (12, 0.8)])
def test_a_star_is_closed_and_as_large_as_it_should_be(points, depth):
    mesh = load_scene("star", {"points": points, "depth": depth}).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    # Triangles between the middle, a point and a notch.
    area = 2 * points * 0.5 * 0.04 * 0.04 * (1 - depth) * np.sin(np.pi / points)
    assert mesh.volume == pytest.approx(0.06 * area)
    assert mesh.extents[2] == pytest.approx(0.06)


def test_sizes_have_bounds():
    with pytest.raises(SettingsError, match=r"scene\.options\.points"):
        load_scene("star", {"points": 2})
