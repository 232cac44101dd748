# SPDX-License-Identifier: MIT
"""The duck is one smooth closed body that faces forward."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.scene import load_scene


def test_a_duck_is_one_closed_smooth_body_as_long_as_asked_for():
    mesh = load_scene("duck", {"length": 0.08}).mesh
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.extents[0] == pytest.approx(0.08)
    assert np.degrees(mesh.face_adjacency_angles).max() < 40.0


def test_a_duck_looks_forward_with_its_beak_in_the_middle():
    vertices = np.asarray(load_scene("duck").mesh.vertices)
    foremost = vertices[vertices[:, 0].argmax()]
    assert foremost[2] > 0.0
    assert abs(foremost[1]) < 0.004
    assert vertices[:, 1].min() == pytest.approx(-vertices[:, 1].max(), abs=1e-4)


@pytest.mark.parametrize("length", [0.05, 0.114, 0.12])
def test_triangles_are_fine_at_any_length(length):
    edges = load_scene("duck", {"length": length}).mesh.edges_unique_length
    assert edges.max() < 2.0 / 3.0 * 3.4e-3
