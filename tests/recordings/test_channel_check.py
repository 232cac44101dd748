# SPDX-License-Identifier: MIT
"""Channels that are silent, doubled, deaf or faint are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.recordings.audio import Recording
from sononerf.recordings.pings import channels_of, check_channels, faults_of_channels
from sononerf.recordings.pose_tables import Columns

LOOKS = 6.0


def recording(*channels):
    """One second of pings whose channels have so much amplitude."""
    waves = np.random.default_rng(0).normal(size=(20, len(channels), 50))
    waves *= np.reshape(channels, (-1, 1))
    return Recording(
        Path("pings"),
        100.0,
        tuple(map(str, range(20))),
        np.zeros(20),
        lambda ping: waves[ping],
        Columns("t", {}, {}, None, {}),
    )


def test_a_silent_channel_is_refused():
    check_channels(recording(1.0, 1e-6), None)
    with pytest.raises(InputError, match=r"channel 1 is silent in all pings"):
        check_channels(recording(1.0, 0.0), None)
    check_channels(recording(1.0, 0.0), (0,))
    check_channels(recording(0.0, 0.0), None)  # silence of all is told elsewhere


def test_a_doubled_channel_is_refused():
    with pytest.raises(InputError, match=r"channels 0 and 2 hold the same samples"):
        check_channels(recording(1.0, 1.0, 1.0), (0, 1, 0))


def power(*levels, noise=1e-4):
    """Noise, and one echo of some power per channel."""
    rng = np.random.default_rng(1)
    found = noise * rng.gamma(LOOKS, 1.0 / LOOKS, size=(30, len(levels), 300))
    found[:, :, 100] += levels
    return found


def test_levels_noise_and_echoes_are_counted():
    loud, faint = channels_of(power(1.0, 0.1), LOOKS)
    assert loud.level_db == pytest.approx(0.0, abs=0.01)
    assert faint.level_db == pytest.approx(-10.0, abs=0.05)
    assert loud.noise_db == pytest.approx(-42.0, abs=1.5)
    assert (loud.heard, faint.heard, loud.asked) == (30, 30, 30)
    assert faults_of_channels([loud, faint]) == []


def test_channels_that_the_others_contradict_are_named():
    deaf = faults_of_channels(channels_of(power(1.0, 0.0), LOOKS))
    assert len(deaf) == 1
    assert "channel 1 heard echoes in 0 of 30 pings, and another one in 30" in deaf[0]
    faint = faults_of_channels(channels_of(power(1.0, 1e-5, noise=1e-9), LOOKS))
    assert len(faint) == 1
    assert "channel 1 is 50 dB fainter" in faint[0]
