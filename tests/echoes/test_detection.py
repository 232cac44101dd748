# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from scipy.stats import poisson

from sononerf.echoes.detection import FALSE_ALARMS, Onsets, heard_again, onsets, threshold_levels
from sononerf.echoes.echoes import Echoes
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import ACTIVE_DB, active_level, compress
from sononerf.head.head import Head
from sononerf.settings.schema import SpectrogramSettings

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


HEAD = Head(spectrogram=SpectrogramSettings(range_min=0.2, range_max=0.4))
POSES = 40


def echoes(noise, calibrated=False, at=0.3):
    """Poses that hear a point amid noise of some strength per frequency."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(POSES, 3))
    places *= 0.3 / np.linalg.norm(places, axis=1, keepdims=True)
    echo = np.exp(-(((HEAD.range - at) / 0.004) ** 2))[:, None]
    shape = (POSES, 2, len(HEAD.range), len(HEAD.frequency))
    drawn = rng.standard_normal((2, *shape)) * noise / np.sqrt(2.0)
    heard = np.abs(echo + drawn[0] + 1j * drawn[1])
    return Echoes.from_arrays(heard, Poses.looking_at(places), HEAD, calibrated=calibrated)


def test_its_strength_is_found_per_frequency():
    strength = np.linspace(0.005, 0.02, len(HEAD.frequency))
    known = echoes(strength).store.attributes
    assert known["noise_floor_of"] == "noise before the first echoes"
    np.testing.assert_allclose(known["noise"], np.tile(strength, (2, 1)), rtol=0.15)


def test_the_floor_is_what_two_recordings_differ_by():
    """A second recording with other noise differs as much as the floor says."""
    found = echoes(0.01)
    test, reference = found.store.indices("test"), found.reference
    noise = np.asarray(found.store.attributes["noise"])
    first = np.stack([found.spectrogram(int(i)) for i in test])
    again = np.stack([heard_again(one, noise, 5) for one in first])
    error = np.abs(compress(first, reference) - compress(again, reference))
    louder = np.maximum(compress(first, reference), compress(again, reference))
    active = louder >= found.active_db
    known = found.store.attributes
    assert known["noise_floor_mae_db"] == pytest.approx(error.mean(), rel=0.1)
    assert known["noise_floor_mae_db_active"] == pytest.approx(error[active].mean(), rel=0.2)
    assert known["noise_floor_mae_db_active"] < 0.5 * known["noise_floor_mae_db"]


def test_cells_of_noise_are_not_active():
    found = echoes(0.01)
    silent = np.abs(HEAD.range - 0.3) > 0.05
    levels = np.stack([compress(found.spectrogram(i), found.reference) for i in range(POSES)])
    assert (levels >= ACTIVE_DB)[:, :, silent].mean() > 0.9  # noise is far above the reference
    assert (levels >= found.active_db)[:, :, silent].mean() < 0.005


def test_without_noise_all_is_as_before():
    quiet = echoes(0.0)
    assert quiet.active_db == pytest.approx(ACTIVE_DB)
    assert quiet.store.attributes["noise_floor_mae_db"] is None
    simulated = echoes(0.01, calibrated=True)
    assert simulated.active_db == ACTIVE_DB
    assert "noise" not in simulated.store.attributes
    assert active_level(None, 1.0) == ACTIVE_DB


def test_echoes_from_the_first_slice_on_tell_no_noise():
    early = echoes(0.01, at=HEAD.range[4])
    assert "noise" not in early.store.attributes
    assert early.active_db == ACTIVE_DB
