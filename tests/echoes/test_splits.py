# SPDX-License-Identifier: MIT
"""Splits: a few poses are held out; repeated pings of one pose stay together."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.memory_ensemble import draw_split, pose_groups, repeats, split_of
from sononerf.errors import InputError
from sononerf.geometry.poses import Poses


def poses_of(count):
    generator = np.random.default_rng(0)
    return Poses.sphere(count, radius=0.4, aim_jitter=0.1, generator=generator)


def split(poses, **given):
    return draw_split(poses, where="t", **given)


@pytest.mark.parametrize(
    ("count", "expected"), [(2, [2, 0, 0]), (3, [1, 1, 1]), (40, [34, 2, 4]), (1000, [970, 10, 20])]
)
def test_sizes_follow_the_number_of_poses(count, expected):
    assert np.bincount(split(poses_of(count)), minlength=3).tolist() == expected


def test_numbers_and_seed_decide():
    found = split(poses_of(30), validation=5, heldout=7)
    assert np.bincount(found).tolist() == [18, 5, 7]
    assert (split(poses_of(30), seed=1) != split(poses_of(30))).any()
    with pytest.raises(InputError, match="t: 3 poses, of which 1 validate and 2 are held out"):
        split(poses_of(3), validation=1, heldout=2)


@pytest.mark.parametrize("stated", [["train", "test", "val"], [0, 2, 1], np.array([0, 2, 1])])
def test_what_is_stated_counts(stated):
    assert split_of(poses_of(3), stated).tolist() == [0, 2, 1]
    assert np.bincount(split_of(poses_of(40), None)).tolist() == [34, 2, 4]


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ([0, 1], r"shape \(2,\), expected \(3,\)"),
        (["train", "test", "eval"], "found 'eval', expected train, val or test"),
        ([0, 1, 3], "found 3"),
        ([2, 1, 1], "no pose is for training"),
    ],
)
def test_a_wrong_split_is_refused(stated, message):
    with pytest.raises(InputError, match=message):
        split_of(poses_of(3), stated)


def test_repeats_stay_together_and_pair_up():
    once = poses_of(20)
    twice = Poses(np.repeat(once.positions, 2, axis=0), np.repeat(once.rotations, 2, axis=0))
    assert len(np.unique(pose_groups(twice))) == 20
    found = split(twice)
    np.testing.assert_array_equal(found[::2], found[1::2])
    pairs = repeats(twice, found)
    assert len(pairs) == 2
    assert all(found[a] == found[b] == 2 and b == a + 1 for a, b in pairs.items())
    assert repeats(once, split(once)) == {}
