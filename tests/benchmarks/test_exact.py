# SPDX-License-Identifier: MIT
import argparse

import numpy as np
import pytest

from tools.benchmarks import exact as module

pytestmark = pytest.mark.thorough

RANGE = np.arange(0.3, 0.5, 0.001)
FREQUENCY = np.array([15e3, 30e3, 60e3])


def heard(quiet=1.0):
    """Return one pose and two ears: an echo at 0.4 m, its middle frequency weaker or not."""
    magnitude = np.full((1, 2, len(RANGE), 3), 1e-9)
    magnitude[:, :, 100:105] = [1.0, quiet, 1.0]
    return {
        "magnitude": magnitude, "reference": 1e-3, "range": RANGE, "frequency": FREQUENCY,
        "nearest": np.full((1, 2), 0.4), "solved_s": 0.0, "pose_s": 0.0,
    }  # fmt: skip


def test_errors_are_told_band_by_band(monkeypatch):
    found = {"spheres": heard(), "rays": heard(0.5)}
    monkeypatch.setattr(module, "_heard", lambda scene, engine, poses: found[engine])
    arguments = argparse.Namespace(scene="any", engines=["rays"], poses=1)
    _, row = module.exact(arguments)["rows"]
    assert row["10_to_25_khz_db"] == row["41_to_80_khz_db"] == 0.0
    assert row["25_to_41_khz_bias_db"] == pytest.approx(-6.02, abs=0.02)
    assert [round(f) for f, _ in row["by_frequency"]] == [15_000, 30_000, 60_000]


def test_what_comes_early_is_told_apart_from_the_echo():
    silent = module._before("any", heard(), 1e-3)
    assert silent["early_worst_db"] < 0.01
    assert silent["near_worst_db"] < 0.01
    early = heard()
    early["magnitude"][0, 1, 80] = 1e-3  # 20 mm before the echo, 6 dB above m0
    row = module._before("any", early, 1e-3)
    assert row["early_worst_db"] == pytest.approx(6.02, abs=0.01)
    assert row["near_worst_db"] == pytest.approx(6.02, abs=0.01)
    assert 0.0 < row["early_mean_db"] < 0.2
