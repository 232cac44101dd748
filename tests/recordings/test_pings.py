# SPDX-License-Identifier: MIT
"""Pings are cut where their calls left, to a part of a sample; bad ones are found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.recordings.pose_tables import Columns
from sononerf.recordings.recording import (
    Clipping,
    Cutter,
    Recording,
    check_numbers,
    clipped_pings,
    cut,
    mixed_channels,
)

RATE = 1e5


def recording(waves, emission=0.0):
    waves = [np.atleast_2d(wave) for wave in waves]
    return Recording(
        path=Path("a.wav"),
        sampling_rate=RATE,
        labels=tuple(f"ping {index}" for index in range(len(waves))),
        emission=np.broadcast_to(np.asarray(emission, float), len(waves)).copy(),
        read=lambda index: waves[index],
        columns=Columns("t", {}, {}, None, {}),
    )


def pulse(middle, count=600):
    """A wave packet within the band, anywhere between samples."""
    time = np.arange(count) - middle
    return np.exp(-((time / 12.0) ** 2)) * np.cos(2 * np.pi * 0.2 * time)


@pytest.mark.parametrize("emission", [100.0, 100.37, 99.5, 0.25])
def test_a_cut_begins_with_the_emission(emission):
    echo = cut(pulse(300.0)[None], emission, 400)
    np.testing.assert_allclose(echo[0], pulse(300.0 - emission, 400), atol=1e-9)


def test_what_was_not_recorded_is_silent():
    echo = cut(pulse(50.0)[None], -120.4, 400)
    np.testing.assert_allclose(echo[0], pulse(170.4, 400), atol=1e-6)
    assert np.abs(echo[0, :50]).max() < 1e-6
    later = cut(pulse(50.0, 100)[None], 20.0, 300)
    assert not later[0, 80:].any()


def test_channels_are_chosen_and_averaged():
    samples = np.arange(8.0).reshape(4, 2)
    np.testing.assert_array_equal(mixed_channels(samples, (3, (0, 1))), [[6, 7], [1, 2]])
    assert mixed_channels(samples, None) is samples
    with pytest.raises(InputError, match="no channel 4; the recordings have 0 to 3"):
        mixed_channels(samples, (4,))


def test_offset_gain_and_background():
    wave = np.stack([pulse(300.0), pulse(320.0)])
    still = 0.3 * np.stack([pulse(200.0), pulse(250.0)])
    known = recording([wave + still], emission=1e-3)
    cutter = Cutter(known, delay=2e-4, gain=np.array([2.0, 3.0]), background=still[:, 120:])
    echo = cutter.echo(0, 400)
    expected = np.stack([2.0 * pulse(180.0, 400), 3.0 * pulse(200.0, 400)])
    np.testing.assert_allclose(echo, expected, atol=1e-9)
    assert (cutter.samples(0), cutter.begins(0)) == (480, 0)
    assert Cutter(known, delay=-1.5e-3).begins(0) == 50


def looks(waves, step=0.0):
    return [Clipping.of(np.atleast_2d(wave), step) for wave in waves]


def test_clipped_pings_are_those_that_stay_at_the_limit():
    loud, faint = 1.7 * pulse(300.0), 0.4 * pulse(300.0)
    flat = np.clip(loud, -0.9, 0.9)
    assert clipped_pings(looks([faint, flat, flat, 0.5 * flat])).tolist() == [
        False,
        True,
        True,
        False,  # no more than loud: others of this channel are louder
    ]
    assert not clipped_pings(looks([loud, faint])).any()
    one_side = np.clip(3 * loud, -9.0, 0.9)
    assert clipped_pings(looks([faint, one_side])).tolist() == [False, True]
    assert clipped_pings([]).shape == (0,)


def test_coarse_numbers_and_silence_are_not_clipped():
    step = 2.0**-15
    quiet = np.round(20 * pulse(300.0)) * step  # stays at 20 steps for some samples
    assert not clipped_pings(looks([quiet, 0 * quiet], step)).any()
    full = np.clip(np.round(4 * pulse(300.0) / step), -32768, 32767) * step
    assert clipped_pings(looks([quiet, full], step)).tolist() == [False, True]


def test_clipping_counts_only_where_echoes_are():
    direct = np.clip(3 * pulse(50.0), -1, 1) + 0.1 * pulse(400.0)
    cutter = Cutter(recording([direct]))
    assert clipped_pings([cutter.clipped(0, 0, 600)]).all()
    assert not clipped_pings([cutter.clipped(0, 200, 600)]).any()


def test_times_outside_and_nan_are_told():
    def told(known, last, words):
        with pytest.raises(InputError) as caught:
            check_numbers(known, Cutter(known), last)
        assert words in str(caught.value)

    told(recording([pulse(9)] * 3, [0, 1.0, 2.0]), 0, "ping 1 and 1 more: the time of the emission")
    told(recording([pulse(9)] * 2, [0, 5e-3]), 300, "ping 1: has ")
    bad = pulse(9.0)
    bad[7] = np.nan
    told(recording([pulse(9.0), bad]), 0, "ping 1: holds samples that are NaN")
