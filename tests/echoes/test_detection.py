# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from scipy.stats import poisson

from sononerf.echoes.detection import FALSE_ALARMS, Onsets, onsets, threshold_levels

SLICES = 400
WINDOW = np.hamming(33) ** 2


def echo(middle, power=1.0, half=16.0):
    """Power of a point echo, its window's middle at a slice."""
    offset = (np.arange(SLICES) - middle) / half
    window = 0.54 + 0.46 * np.cos(np.pi * offset)
    return power * np.where(np.abs(offset) <= 1, window, 0.0) ** 2


def found_in(power, looks=4.0):
    power = np.asarray(power)
    return onsets(power, threshold_levels(power, looks), WINDOW, 1.0)


def noise(shape, looks, seed=0):
    return np.random.default_rng(seed).gamma(looks, 1.0 / looks, size=shape)


def test_noise_alone_is_no_echo():
    power = noise((100, SLICES), 4.0)
    assert np.isfinite(found_in(power)).sum() <= 1
    assert (power > threshold_levels(power, 4.0).total).mean() < 1e-4


def test_echoes_are_found_between_slices_and_in_noise():
    middles = 150 + np.linspace(0, 50, 40)
    plain = np.stack([echo(m) for m in middles])
    np.testing.assert_allclose(found_in(plain), middles, atol=0.1)
    loud = found_in(plain + noise(plain.shape, 4.0) * 1e-3)
    np.testing.assert_allclose(loud, middles, atol=1.0)
    # 17 dB: the threshold, not a tenth of the echo, is where its rise is read.
    faint = found_in(plain + noise(plain.shape, 4.0) * 0.02)
    assert np.isfinite(faint).all()
    assert (np.abs(faint - middles) < 8).all()  # a quarter of the window
    # Under noise there is none to be found, and none is invented.
    assert not np.isfinite(found_in(plain * 0.5 + noise(plain.shape, 4.0))).any()


def test_a_second_echo_does_not_move_the_first():
    first = 150 + np.linspace(0, 1, 10)
    for behind, power in ((10, 1.0), (20, 10.0), (60, 1000.0)):
        rows = [echo(m) + echo(m + behind, power) for m in first] + [echo(200.0)] * 5
        np.testing.assert_allclose(found_in(rows)[:10], first, atol=0.6)  # of 32 slices


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_precursor_that_all_echoes_have_is_no_echo(scale):
    """As sidelobes of pulse compression are: 25 dB below each echo, 60 slices before it."""
    middles = np.linspace(150, 250, 50)
    level = 10 ** (-2.5) * noise((50,), 4.0)
    rows = [echo(m) + echo(m - 60, p) for m, p in zip(middles, level, strict=True)]
    np.testing.assert_allclose(found_in(scale * np.stack(rows)), middles, atol=0.1)
    # Nor is it one if the last slice cuts the echo.
    cut = echo(SLICES - 1) + echo(SLICES - 61, 10 ** (-2.5))
    assert found_in(scale * np.stack([*rows, cut]))[-1] == -np.inf
    # An echo that some have there, and others elsewhere, is one.
    real = [echo(m) + echo(m - 40 - i, 1e-3) for i, m in enumerate(middles)]
    np.testing.assert_allclose(found_in(real), middles - 40 - np.arange(50), atol=0.1)


def test_a_cut_echo_leaves_the_first_unknown():
    cut, behind = echo(4.0), echo(200.0)
    assert found_in([cut + behind])[0] == -np.inf
    # Unless what is cut is faint beside it.
    assert found_in([1e-3 * cut + behind])[0] == pytest.approx(200.0, abs=0.1)


def test_silence_has_no_onset():
    assert not np.isfinite(found_in(np.zeros((3, SLICES)))).any()


@pytest.mark.parametrize("scale", [1e-12, 1e9])
def test_the_level_of_all_does_not_matter(scale):
    rows = np.stack([echo(m) for m in np.linspace(100, 300, 30)]) + 1e-3 * noise((30, SLICES), 4.0)
    np.testing.assert_allclose(found_in(scale * rows), found_in(rows), rtol=1e-9)


def test_what_no_recording_could_hold_is_no_echo():
    """A simulator without noise has residues far below its echoes."""
    middles = 200 + 5.0 * np.arange(20)
    rows = np.stack([echo(m) for m in middles])
    rows[3] += echo(40.0, 1e-9)
    np.testing.assert_allclose(found_in(rows), middles, atol=0.1)
    # 77 dB below the loudest an echo is one, before faint poses too.
    rows[0] = echo(100.0, 2e-7)
    assert found_in(rows)[0] == pytest.approx(100.0, abs=1.0)


def test_an_onset_is_at_a_point_echos_own_range_not_at_its_greatest():
    """A filter may answer loudest a little after the time that it is read at."""
    rise = np.interp(np.arange(41), [0, 26, 40], [0.0, 1.0, 0.0])  # its own range is at 20
    power = np.full((12, SLICES), 1e-9)
    for row in power:
        row[130:171] += rise  # of an echo at 150
    levels = threshold_levels(power, 4.0)
    np.testing.assert_allclose(onsets(power, levels, rise, 1.0), 150.0, atol=0.2)


@pytest.mark.parametrize("heard", [1, 2, 5])
def test_the_chance_of_onsets_is_that_of_false_alarms(heard):
    first = np.full((400, 2), -np.inf)
    first[:heard, 0] = 0.3
    shape = (400, 2, SLICES)
    found = Onsets(
        np.arange(400), 0.1 + 5e-4 * np.arange(SLICES), np.ones(shape), np.ones(shape, bool), first
    )
    # 200 mm of range hold 34 independent values of each of the 800 rows.
    usual = FALSE_ALARMS * 800 * SLICES * 5e-4 / 5.8e-3
    assert found.chance(5.8e-3) == pytest.approx(poisson.sf(heard - 1, usual), rel=1e-6)
