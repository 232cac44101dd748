# SPDX-License-Identifier: MIT
"""Errors of a recording are found again, each with an uncertainty that holds the truth."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.refinement.self_calibration import Calibrator
from sononerf.refinement.tracer import StillSurface
from tests.memory import echoes_of

COUNT = 14


@pytest.fixture
def heard(bumpy, optics, poses):
    """What poses at several distances hear of the bumpy, with errors."""

    def make(*, gain=(0.0, 0.0), offset=0.0, speed=0.0):
        positions, rotations = poses.positions[:COUNT], poses.rotations[:COUNT]
        positions = positions * np.linspace(0.8, 1.25, len(positions))[:, None]
        count = len(positions)
        magnitude = StillSurface(bumpy, optics).render(
            positions, rotations, np.full(count, np.exp(-speed)), np.full(count, 2 * offset)
        )
        magnitude = magnitude * np.exp(np.asarray(gain, dtype=np.float32))[:, None, None]
        split = np.zeros(count, dtype=int)
        return echoes_of(optics.head, positions, rotations, lambda pose: magnitude[pose], split)

    return make


def found(mesh, echoes, optics, *kinds, steps=6):
    work = Calibrator(mesh, echoes, optics, kinds, dependent=50.0)
    for _ in range(steps):
        work.step()
    return work.result()


def test_gains_are_found(bumpy, heard, optics):
    estimate = found(bumpy, heard(gain=(0.1, 0.7)), optics, "gain", steps=4)
    np.testing.assert_allclose(estimate.calibration.gain.mean(axis=1), [0.1, 0.7], atol=0.02)
    assert estimate.error_db[-1] < 0.2 * estimate.error_db[0]


@pytest.mark.slow
def test_a_range_offset_is_told_from_the_size(bumpy, heard, optics):
    # A fit to ranges that are 2 mm too far makes the body smaller by as much.
    normals = np.asarray(bumpy.vertex_normals)
    small = trimesh.Trimesh(bumpy.vertices - 0.002 * normals, bumpy.faces, process=False)
    estimate = found(small, heard(offset=0.002), optics, "range_offset", steps=8)
    assert estimate.calibration.range_offset == pytest.approx(0.002, abs=0.0002)
    assert estimate.deviation["range_offset"] < 0.001


@pytest.mark.slow
def test_the_speed_of_sound_is_found_from_several_distances(bumpy, heard, optics):
    several = found(bumpy, heard(speed=0.005), optics, "speed_of_sound")
    assert several.calibration.speed_of_sound == pytest.approx(0.005, abs=0.0005)


def test_without_errors_nothing_is_found(bumpy, heard, optics):
    estimate = found(bumpy, heard(), optics, "gain", "speed_of_sound", steps=2)
    assert np.abs(estimate.calibration.gain).max() < 1e-3
    assert abs(estimate.calibration.speed_of_sound) < 1e-4
