# SPDX-License-Identifier: MIT
import argparse

import numpy as np
import pytest

from tools.benchmarks import exact as module

RANGE = np.arange(0.3, 0.5, 0.001)
FREQUENCY = np.array([15e3, 30e3, 60e3])


def echo(quiet=1.0):
    """Return one pose and two ears: an echo at 0.4 m, its middle frequency weaker or not."""
    magnitude = np.full((1, 2, len(RANGE), 3), 1e-9)
    magnitude[:, :, 100:105] = [1.0, quiet, 1.0]
    return magnitude


def test_errors_are_by_band():
    low, middle, high = module.errors(echo(0.5), echo(), FREQUENCY)
    assert low[0] == high[0] == 0.0
    assert middle[1] == pytest.approx(-6.02, abs=0.02)


def test_what_comes_early_is_told_apart_from_the_echo():
    nearest = np.full((1, 2), 0.4)
    assert module.before(echo(), echo(), RANGE, nearest) < 0.01
    early = echo()
    early[0, 1, 80] = 1e-3  # 20 mm before the echo, 6 dB above m0
    assert module.before(early, echo(), RANGE, nearest) == pytest.approx(6.02, abs=0.01)


@pytest.mark.slow
def test_the_table_has_a_row_for_each_body_and_engine():
    arguments = argparse.Namespace(bodies=["balls"], engines=["hybrid", "rays"], rays=3000)
    lines = module.exact(arguments).splitlines()
    assert len(lines) == 4
    hybrid, rays = (float(line.split("|")[3].split("(")[0]) for line in lines[2:])
    assert hybrid < 0.5 < 5.0 < rays
