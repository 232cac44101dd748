# SPDX-License-Identifier: MIT
"""A turned box, and the same with rounded edges and wavy faces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.remesh import remesh

SIDES = (0.06, 0.04, 0.03)
EDGE = 1.5e-3


@pytest.fixture(scope="session")
def turned_box():
    found = trimesh.creation.box(SIDES)
    turn = trimesh.transformations.euler_matrix(0.3, 0.8, 1.9)
    return found.apply_transform(turn)


@pytest.fixture(scope="session")
def worn(turned_box):
    """The box with rounded edges, and waves of half a millimetre on its faces."""
    found = remesh(turned_box.subdivide_to_size(2e-3), EDGE, 1.5e-3)
    places = np.asarray(found.vertices)
    wave = 4e-4 * np.sin(places @ np.array([250.0, 120.0, 90.0]))
    moved = places + wave[:, None] * np.asarray(found.vertex_normals)
    return trimesh.Trimesh(moved, found.faces, process=False)
