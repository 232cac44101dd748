# SPDX-License-Identifier: MIT
"""Range limits that are left out follow from the echoes; those that are set stay."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.run.understand import understand
from tests.recordings.recorded import SETTINGS, arrays, waveforms


def limits(tmp_path, *overrides, **changes):
    np.savez(tmp_path / "a.npz", **arrays(**changes))
    found = understand(
        "numpy", tmp_path / "a.npz", tmp_path / "s", overrides=[*SETTINGS, *overrides]
    )
    analysis = found.settings.spectrogram
    assert len(found.head.range) > 10
    return analysis.range_min, analysis.range_max


def test_they_hold_the_echoes_and_little_more(tmp_path):
    low, high = limits(tmp_path, waveform=waveforms(noise=1e-4))
    # The point is 0.36 to 0.44 m from the poses.
    assert 0.25 < low < 0.36
    assert 0.44 < high < 0.62


def test_what_is_set_stays(tmp_path):
    low, high = limits(tmp_path, "spectrogram.range_min=0.31", waveform=waveforms(noise=1e-4))
    assert low == 0.31
    assert high < 0.62
    both = limits(tmp_path, "spectrogram.range_min=0.31", "spectrogram.range_max=0.5")
    assert both == (0.31, 0.5)


def test_the_call_itself_is_left_out(tmp_path):
    waves = waveforms(noise=1e-4)
    waves[:, :, :20] += 50.0  # direct sound, far louder than echoes
    assert limits(tmp_path, waveform=waves)[0] > 0.06


def test_a_late_beginning_moves_the_first_range(tmp_path):
    waves = waveforms(noise=1e-4)
    start = 500 / 250_000  # 0.343 m: the first echoes are cut off
    low, _ = limits(tmp_path, waveform=waves[:, :, 500:], start=start)
    assert low == pytest.approx(0.343, abs=0.02)
