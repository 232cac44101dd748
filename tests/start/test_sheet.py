# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError
from sononerf.geometry.lattice import Lattice
from sononerf.start.evidence import Evidence
from sononerf.start.occupancy import Gathered
from sononerf.start.read_out import fit_sheet

RESOLUTION = 6e-3
THICKNESS = 6e-4
SIZE = np.array([0.05, 0.03])


def height(x, y):
    return 5.0 * x**2 - 8.0 * y**2


def upward(x, y):
    normal = np.stack([-10.0 * x, 16.0 * y, np.ones_like(x)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def gathered(points, normals, scale=1.0):
    """What is known of points, with onsets that leave the convex box around a bent sheet."""
    points = scale * points
    low, high = scale * np.array([-0.05, -0.03, -0.008]), scale * np.array([0.05, 0.03, 0.014])
    lattice = Lattice.over(low, high, scale * 2e-3)
    off = np.abs(lattice.points() - (low + high) / 2) - (high - low) / 2
    bound = (off.max(axis=1) / lattice.spacing).reshape(lattice.shape).astype(np.float32)
    weight = np.ones(len(points))
    evidence = Evidence(points, normals, weight, np.arange(len(points)))
    none = np.zeros((0, 3))
    hull = EchoHull(none, np.zeros((0, 2, 3)), np.zeros((0, 2)), none)
    thin = np.zeros(lattice.shape, np.float32)
    return Gathered(evidence, weight, points, lattice, thin, bound, hull, scale * RESOLUTION)


@pytest.fixture(scope="module")
def bent():
    """Evidence of both sides of a saddle, a fifth of it wrong."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-0.97, 0.97, (300, 2)) * SIZE
    normals = upward(*place.T)
    side = rng.choice([-1.0, 1.0], 300)[:, None]
    points = np.column_stack((place, height(*place.T))) + side * THICKNESS / 2 * normals
    points += 1e-4 * rng.standard_normal(points.shape)
    wrong = rng.choice(300, 60, replace=False)
    points[wrong, 2] = rng.uniform(-0.008, 0.014, 60)
    return points, side * normals


def off(mesh, scale=1.0):
    x, y, z = np.asarray(mesh.vertices).T / scale
    inner = (np.abs(x) < 0.045) & (np.abs(y) < 0.026)
    return np.abs(z - height(x, y))[inner]


def test_a_bent_sheet_is_one_thin_closed_body(bent):
    sheet = fit_sheet(gathered(*bent))
    assert sheet.is_watertight
    assert sheet.volume > 0
    assert len(sheet.split()) == 1
    assert sheet.euler_number == 2
    assert np.quantile(off(sheet), 0.95) < 0.2 * RESOLUTION
    np.testing.assert_allclose(np.ptp(np.asarray(sheet.vertices), axis=0)[:2], 2 * SIZE, rtol=0.06)
    area = 4 * SIZE.prod()
    assert 0.5 * THICKNESS < sheet.volume / area < 0.3 * RESOLUTION


def test_a_sheet_is_found_however_it_is_turned(bent):
    points, normals = bent
    turn = trimesh.transformations.rotation_matrix(0.7, [0.3, -0.5, 0.8])[:3, :3]
    known = gathered(points, normals)
    lattice = Lattice.over(np.full(3, -0.06), np.full(3, 0.06), 2e-3)
    place = lattice.points() @ turn
    low, high = np.array([-0.05, -0.03, -0.008]), np.array([0.05, 0.03, 0.014])
    box = (np.abs(place - (low + high) / 2) - (high - low) / 2).max(axis=1)
    bound = (box / lattice.spacing).reshape(lattice.shape).astype(np.float32)
    evidence = Evidence(points @ turn.T, normals @ turn.T, known.weight, known.evidence.pose)
    turned = Gathered(
        evidence, known.weight, evidence.points, lattice, bound * 0, bound, known.hull, RESOLUTION
    )
    sheet = fit_sheet(turned)
    sheet.vertices = np.asarray(sheet.vertices) @ turn
    assert np.quantile(off(sheet), 0.95) < 0.25 * RESOLUTION


def test_a_thick_body_is_no_sheet():
    rng = np.random.default_rng(1)
    normals = rng.standard_normal((400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    with pytest.raises(NumericalError, match="one sheet"):
        fit_sheet(gathered(np.array([0.04, 0.025, 0.009]) * normals, normals))


def test_scattered_evidence_is_no_sheet(bent):
    rng = np.random.default_rng(2)
    points, normals = bent
    points = points.copy()
    points[:, 2] = rng.uniform(-0.008, 0.014, len(points))
    with pytest.raises(NumericalError, match="one sheet"):
        fit_sheet(gathered(points, normals))


def test_a_sheet_of_which_only_the_rim_was_heard_is_refused(bent):
    points, _ = bent
    sideways = np.zeros_like(points)
    sideways[:, 0] = 1.0
    with pytest.raises(NumericalError, match="sides of a sheet"):
        fit_sheet(gathered(points, sideways))
