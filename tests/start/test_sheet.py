# SPDX-License-Identifier: MIT
"""A thin body through what the network finds of a sheet."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.geometry.lattice import Lattice
from sononerf.start.sheet import SHEET_THICKNESS, fit_sheet

RESOLUTION = 6e-3
SIZE = np.array([0.05, 0.03])
LOW, HIGH = np.array([-0.05, -0.03, -0.008]), np.array([0.05, 0.03, 0.014])
"""The room that the onsets leave, a box around a bent sheet, m."""


def height(x, y):
    return 5.0 * x**2 - 8.0 * y**2


def found(chance, turn=None):
    """Fit a sheet to the probability that a function gives of each place of the room."""
    turn = np.eye(3) if turn is None else turn
    lattice = Lattice.over(np.full(3, -0.06), np.full(3, 0.06), RESOLUTION / 4)
    place = lattice.points() @ turn
    room = ((HIGH - LOW) / 2 - np.abs(place - (LOW + HIGH) / 2)).min(axis=1)
    values = np.where(room > 0, chance(*place.T), 0.0)
    return fit_sheet(
        values.reshape(lattice.shape).astype(np.float32),
        room.reshape(lattice.shape),
        lattice,
        RESOLUTION,
    )


def near(x, y, z):
    """What the network finds of a saddle: uncertain by a range resolution, a third of it wrong."""
    sure = np.exp(-0.5 * ((z - height(x, y)) / (0.3 * RESOLUTION)) ** 2)
    missing = (np.sin(150 * x) * np.cos(130 * y)) > 0.5
    elsewhere = np.exp(-0.5 * ((z - 0.01) / (0.3 * RESOLUTION)) ** 2)
    return 0.5 * np.where(missing, elsewhere, sure)


def off(mesh):
    x, y, z = np.asarray(mesh.vertices).T
    inner = (np.abs(x) < 0.045) & (np.abs(y) < 0.026)
    return np.abs(z - height(x, y))[inner]


def test_a_bent_sheet_is_one_thin_closed_body():
    sheet = found(near)
    assert sheet.is_watertight
    assert sheet.euler_number == 2
    assert np.quantile(off(sheet), 0.95) < 0.3 * RESOLUTION
    np.testing.assert_allclose(np.ptp(np.asarray(sheet.vertices), axis=0)[:2], 2 * SIZE, rtol=0.08)
    thickness = sheet.volume / (4 * SIZE.prod())
    assert thickness == pytest.approx(SHEET_THICKNESS * RESOLUTION, rel=0.3)


def test_a_sheet_is_found_however_it_is_turned():
    turn = trimesh.transformations.rotation_matrix(0.7, [0.3, -0.5, 0.8])[:3, :3]
    sheet = found(near, turn)
    sheet.vertices = np.asarray(sheet.vertices) @ turn
    assert np.quantile(off(sheet), 0.95) < 0.3 * RESOLUTION


def test_a_thick_body_is_no_sheet():
    with pytest.raises(NumericalError, match="one sheet"):
        found(
            lambda x, y, z: (np.abs(x) < 0.045) & (np.abs(y) < 0.027) & (np.abs(z - 0.002) < 0.009)
        )


def test_what_is_everywhere_and_what_is_nowhere_is_no_sheet():
    with pytest.raises(NumericalError, match="one sheet"):
        found(lambda x, y, z: 0 * x + 0.5)
    with pytest.raises(NumericalError, match="nothing was found"):
        found(lambda x, y, z: 0 * x)
