# SPDX-License-Identifier: MIT
"""The lag of poses behind pings is found from first echoes, and taken off a store."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.errors import SettingsError
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.recordings.lag import find_lag, is_path, later
from sononerf.recordings.pose_check import Consistency
from sononerf.run.calibrate import calibrate
from sononerf.settings.schema import SpectrogramSettings
from tests.recordings.bodies import EARS, EMITTER, body, first_echoes

CHECK = Consistency(EMITTER, EARS, 0.0058)


def flight(row, count, turns=3.0, start=0.0):
    """Places (P, 3), m, of a flight around the origin, up and down, at changing distance."""
    along = np.asarray(row) / count
    angle = start + 2.0 * np.pi * turns * along
    lift = 0.5 * np.sin(2.0 * np.pi * along + start)
    distance = 0.35 + 0.05 * np.sin(4.0 * np.pi * along + 1.0)
    level = np.cos(lift)
    return Poses.looking_at(
        distance[:, None]
        * np.stack([level * np.cos(angle), level * np.sin(angle), np.sin(lift)], axis=1)
    )


def slow(*cases):
    return [pytest.param(*case, marks=pytest.mark.slow) for case in cases]


@pytest.mark.parametrize(
    ("seed", "lag"), [(0, -0.82), (8, 0.45), *slow((2, -1.7), (3, 0.6), (5, 2.3), (7, 0.0))]
)
def test_a_lag_is_found_within_its_uncertainty(seed, lag):
    rng, count = np.random.default_rng(seed), 240
    start = rng.uniform(0.0, 6.0)
    rows = np.arange(count)
    first = first_echoes(rng, flight(rows + lag, count, start=start), body(rng))
    heard = rows[::2]
    found, deviation = find_lag(flight(rows, count, start=start), first[heard], heard, CHECK)
    assert abs(found - lag) < 2.5 * deviation
    assert deviation < 1.2


def test_a_place_that_all_poses_share_tells_no_lag():
    rng = np.random.default_rng(0)
    poses = flight(np.full(60, 7.0), 60)
    found, deviation = find_lag(poses, first_echoes(rng, poses, body(rng)), np.arange(60), CHECK)
    assert abs(found) < deviation
    assert deviation > 1.0


def test_poses_are_interpolated_on_their_path():
    poses = flight(np.arange(200), 200)
    moved = later(poses, 0.25)
    truth = flight(np.arange(200) + 0.25, 200)
    step = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1).mean()
    assert np.abs(moved.positions - truth.positions)[:-1].max() < 0.02 * step
    assert np.abs(moved.rotations - truth.rotations)[:-1].max() < 1e-3
    np.testing.assert_allclose(moved.positions[-1], poses.positions[-1])
    np.testing.assert_allclose(later(poses, -1.0).positions[1:], poses.positions[:-1])
    assert is_path(poses)
    assert not is_path(Poses.sphere(90, radius=0.4, generator=np.random.default_rng(0)))


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """A flight whose pings are 2.2 rows early, and some of its poses shuffled; the true flight."""
    count, lag, folder = 160, -2.2, tmp_path_factory.mktemp("stores")
    head = Head(analysis=SpectrogramSettings(range_min=0.2, range_max=0.5))
    rng, rows = np.random.default_rng(8), np.arange(count)
    truth = flight(rows + lag, count)
    first = first_echoes(rng, truth, body(rng))
    near = (np.asarray(head.range)[:, None] - first[:, :, None, None]) / head.resolution
    heard = np.exp(-(near**2)) * np.ones(len(head.frequency)) + 1e-6
    stated, order = flight(rows, count), rng.permutation(count)[:40]
    for name, chosen in (("flight", rows), ("shuffled", order)):
        Echoes.from_arrays(heard[chosen], stated[chosen], head).save(folder / name)
    return folder, truth


@pytest.mark.slow
def test_a_store_without_its_lag(stores):
    folder, truth = stores
    before = Echoes.open(folder / "flight")
    found = calibrate(folder / "flight", folder / "out", ["lag"])
    assert "ping n belongs to row n -" in found.lines[0]
    made = Echoes.open(folder / "out")

    def off(echoes):
        return np.linalg.norm(echoes.positions - truth.positions, axis=1)[3:].mean()

    assert off(made) < 0.5 * off(before)
    np.testing.assert_array_equal(made.store.split, before.store.split)
    np.testing.assert_array_equal(made.store.read_pose(5), before.store.read_pose(5))


def test_bad_input_is_one_line(stores):
    folder, _ = stores
    with pytest.raises(SettingsError, match="lag: successive poses are no neighbours"):
        calibrate(folder / "shuffled", folder / "other", ["lag"])
    with pytest.raises(SettingsError, match="lag is found before a surface is known: calibrate it"):
        calibrate(folder / "flight", folder / "other", ["lag", "radius"])
    with pytest.raises(SettingsError, match="a store; radius is found by a surface: fit first"):
        calibrate(folder / "flight", folder / "other", ["radius"])
    assert not (folder / "other").exists()
