# SPDX-License-Identifier: MIT
from types import SimpleNamespace

import numpy as np
import pytest

from sononerf.data import first_echo
from sononerf.data.first_echo import asked_poses, first_echoes
from sononerf.data.store import EnsembleStore

LENGTH, HOP = 64, 4
SAMPLE = 343.0 / 1e6 / 2
RANGE = 0.2 + HOP * SAMPLE * np.arange(300)
GAIN = np.array([1.0, 0.3, 2.0])
"""Of three frequencies; the power of all together is what is looked at."""
WINDOW = np.hamming(LENGTH) ** 2
LOUDEST = 1.0
FOUND = 0.0001
"""m. Between samples of an echo, half of one off at its top, decibels are read off straight lines:
0.015 mm. The middle of a window of 64 samples lies between two, half a sample, 0.086 mm, off the
first of them."""


def echo(middle, level_db=0.0):
    """Power over range of one echo of a Hamming window."""
    offset = (RANGE - middle) / SAMPLE
    window = 0.54 + 0.46 * np.cos(2 * np.pi * offset / (LENGTH - 1))
    inside = np.abs(offset) <= (LENGTH - 1) / 2
    return LOUDEST**2 * 10 ** (level_db / 10) * np.where(inside, window, 0.0) ** 2


def spectrograms(power):
    """Magnitudes of a pose, (E, R, F), from what both ears hear of it, (E, R)."""
    scale = GAIN / np.sqrt(np.mean(GAIN**2))
    return np.sqrt(np.asarray(power))[..., None] * scale


def found_in(poses, window=WINDOW):
    """Return what is found in training poses of powers (E, R)."""
    store = SimpleNamespace(
        range=RANGE,
        attributes={"reference": LOUDEST / 1000},
        indices=lambda split: {"train": np.arange(len(poses))}[split],
        read_pose=lambda index: spectrograms(poses[index]).astype(np.float32),
    )
    return first_echoes(store, window, SAMPLE)


SUB_SLICES = 0.3 + np.arange(16) / 16 * HOP * SAMPLE


def test_an_echo_is_found_between_slices():
    """To a seventh of the 0.7 mm between slices, at each ear by itself."""
    apart = 0.0123
    found = found_in([[echo(r), echo(r + apart, -20.0)] for r in SUB_SLICES])
    assert found.shape == (16, 2)
    expected = np.stack((SUB_SLICES, SUB_SLICES + apart), axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=FOUND)


@pytest.mark.parametrize(
    ("behind", "level_db"),
    [
        # As loud, a millimetre before the first has faded: where that has risen to a tenth of its
        # top, 3.6 mm before its middle, the second has not begun.
        (0.004, 0.0),
        (0.004, -10.0),
        (0.008, 0.0),
        # The flash of a face behind an edge; 10 dB more and the first would count as a skirt.
        (0.030, 30.0),
        (0.012, 30.0),
    ],
)
def test_an_echo_behind_the_first_one_does_not_move_it(behind, level_db):
    poses = [[echo(r) + echo(r + behind, level_db), echo(r)] for r in SUB_SLICES]
    found = found_in(poses)
    np.testing.assert_allclose(found[:, 0], SUB_SLICES, rtol=0, atol=FOUND)
    # What is nearer than a first echo is taken for empty, so late is the wrong side. What the
    # second adds to the top of the first, 0.2 dB, is a third of a sample's rise at the onset.
    assert (found[:, 0] - found[:, 1]).max() < 0.4 * SAMPLE


def test_what_is_fainter_than_a_skirt_is_no_echo():
    """40 dB below the pose's loudest, and 80 dB below that of all poses."""
    loud = 0.4
    both = [echo(0.3, level) + echo(loud) for level in (-38.0, -42.0)]
    faint = [echo(0.3, level - 81.0) + echo(loud, -42.0) for level in (0.0, 3.0)]
    found = found_in([both, faint])
    np.testing.assert_allclose(found, [[0.3, loud], [loud, 0.3]], rtol=0, atol=FOUND)


def test_noise_is_no_echo():
    """Of seventy decibels below the loudest pose, as the mean of a few independent frequencies."""
    noise = 1e-7 * np.random.default_rng(0).gamma(5.0, 0.2, size=(20, 2, len(RANGE)))
    found = found_in([each + echo(0.4, -40.0) for each in noise])
    np.testing.assert_allclose(found, 0.4, rtol=0, atol=1e-3)


def test_an_ear_that_hears_nothing_tells_nothing():
    silence = np.zeros(len(RANGE))
    murmur = echo(0.3, -81.0)
    found = found_in([[silence, echo(0.3)], [murmur, silence]])
    assert found[0, 0] == found[1, 0] == found[1, 1] == -np.inf
    assert found[0, 1] == pytest.approx(0.3, abs=FOUND)


# Its middle in front of the first slice, on it, and behind it by less than it takes to rise.
@pytest.mark.parametrize("middle", [-0.003, -0.001, 0.0, 0.0005, 0.002, 0.003])
@pytest.mark.parametrize("behind", [None, 0.0, 20.0])
def test_an_echo_that_the_first_slice_cuts_tells_nothing(middle, behind):
    """Nor does one behind it, which is not the first."""
    power = echo(RANGE[0] + middle)
    if behind is not None:
        power = power + echo(RANGE[0] + 0.05, behind)
    assert (found_in([[power, power]]) == -np.inf).all()


def test_an_echo_that_rises_just_behind_the_first_slice_is_found():
    power = echo(RANGE[0] + 0.0045)
    found = found_in([[power, power + echo(0.3)]])
    np.testing.assert_allclose(found, RANGE[0] + 0.0045, rtol=0, atol=FOUND)


def test_only_training_poses_are_looked_at(tmp_path):
    ranges = [0.25, 0.3, 0.35]
    store = EnsembleStore.create(
        tmp_path / "store",
        poses_positions=np.zeros((3, 3)),
        poses_rotations=np.tile(np.eye(3), (3, 1, 1)),
        split=np.array([0, 1, 0]),
        range=RANGE,
        frequency=np.array([30e3, 50e3, 70e3]),
        attributes={"echo_hash": "a", "reference": LOUDEST / 1000},
    )
    for index in (0, 2):  # the other is not even there
        store.write_pose(index, spectrograms([echo(ranges[index])] * 2))
    found = first_echoes(store, WINDOW, SAMPLE)
    np.testing.assert_allclose(found, [[0.25] * 2, [0.35] * 2], rtol=0, atol=FOUND)


EVERY_OTHER = [0, 2, 4, 7, 9, 11, 13, 15, 17, 20, 22, 24]


@pytest.mark.parametrize(("count", "asked"), [(7, range(7)), (12, range(12)), (25, EVERY_OTHER)])
def test_of_many_poses_some_are_asked_evenly(monkeypatch, count, asked):
    monkeypatch.setattr(first_echo, "MOST_POSES", 12)
    train = 3 * np.arange(count)  # others lie between
    store = SimpleNamespace(indices=lambda split: {"train": train}[split])
    assert asked_poses(store).tolist() == train[list(asked)].tolist()


def test_only_asked_poses_are_read(monkeypatch):
    monkeypatch.setattr(first_echo, "MOST_POSES", 2)
    poses = [spectrograms([echo(at)] * 2) for at in (0.25, 0.3, 0.35)]
    store = SimpleNamespace(
        range=RANGE,
        attributes={"reference": LOUDEST / 1000},
        indices=lambda split: {"train": np.arange(3)}[split],
        read_pose=lambda index: {0: poses[0], 2: poses[2]}[index],
    )
    found = first_echoes(store, WINDOW, SAMPLE)
    np.testing.assert_allclose(found, [[0.25] * 2, [0.35] * 2], rtol=0, atol=FOUND)


@pytest.mark.parametrize("length", [63, 128])
def test_how_long_an_echo_rises_is_told_by_its_window(length):
    """An echo of another window is as exact, by its own window alone."""
    offset = (RANGE - 0.3) / SAMPLE
    inside = np.abs(offset) <= (length - 1) / 2
    power = np.where(inside, 0.54 + 0.46 * np.cos(2 * np.pi * offset / (length - 1)), 0.0) ** 2
    right = found_in([[power, power]], window=np.hamming(length) ** 2)
    np.testing.assert_allclose(right, 0.3, rtol=0, atol=FOUND)
    if length == 128:
        wrong = found_in([[power, power]])
        # 10 dB are 21 and 42 samples off the middle.
        np.testing.assert_allclose(wrong, 0.3 - 21 * SAMPLE, rtol=0, atol=3 * SAMPLE)


def test_a_window_that_ends_above_the_onset_has_no_rise():
    assert first_echo._rise(np.ones(9)) == 0.0
    assert first_echo._rise(np.array([0.5, 0.8, 1.0, 0.8, 0.5])) == 0.0
