# SPDX-License-Identifier: MIT
"""Split of pings into training, validation and test; repeated pings stay together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.array_types import Ints
from sononerf.echoes.layout import SPLITS
from sononerf.errors import InputError
from sononerf.geometry.poses import Poses

TRAIN, VALIDATION, TEST = 0, 1, 2
SAME_PLACE, SAME_TURN = 1e-6, 1e-6  # m and no unit: of one pose, printed twice


def pose_groups(poses: Poses) -> Ints:
    """Return a number for each pose, (P,): the same for pings of the same pose."""
    table = np.concatenate(
        [
            np.round(poses.positions / SAME_PLACE),
            np.round(poses.rotations.reshape(len(poses), 9) / SAME_TURN),
        ],
        axis=1,
    )
    return np.unique(table + 0.0, axis=0, return_inverse=True)[1].reshape(-1)


def split_of(poses: Poses, split: ArrayLike | None, *, where: str = "split") -> NDArray[np.int8]:
    """Return what each pose is for, (P,): 0 train, 1 validation, 2 test.

    In: split (P,).
    """
    if split is None:
        return draw_split(poses, where="poses")
    given = np.asarray(split)
    if given.shape != (len(poses),):
        raise InputError(f"{where} has shape {given.shape}, expected ({len(poses)},), one per pose")
    known: dict[Any, int] = {**SPLITS, **{number: number for number in SPLITS.values()}}
    values = given.tolist()
    wrong = next((value for value in values if value not in known), None)
    if wrong is not None:
        raise InputError(f"{where}: found {wrong!r}, expected train, val or test, or 0, 1 or 2")
    found = np.array([known[value] for value in values], dtype=np.int8)
    if not (found == TRAIN).any():
        raise InputError(f"{where}: no pose is for training; mark some as train")
    return found


def draw_split(
    poses: Poses,
    *,
    validation: int | None = None,
    heldout: int | None = None,
    seed: int = 0,
    where: str,
) -> NDArray[np.int8]:
    """Draw at random what each pose is for; repeated pings of one pose stay together.

    Out: split ((P,) int8).
    """
    groups = pose_groups(poses)
    count = int(groups.max(initial=-1)) + 1
    few = min(10, max(count // 20, int(count >= 3))) if validation is None else validation
    some = min(20, max(count // 10, int(count >= 3))) if heldout is None else heldout
    order = np.random.default_rng(seed).permutation(count)
    of_group = np.full(count, TRAIN, dtype=np.int8)
    of_group[order[:some]] = TEST
    of_group[order[some : some + few]] = VALIDATION
    if not (of_group == TRAIN).any():
        raise InputError(
            f"{where}: {count} poses, of which {few} validate and {some} are held out; none is "
            "left to train on"
        )
    return of_group[groups]


def repeats(poses: Poses, split: NDArray[np.int8]) -> dict[int, int]:
    """Return, for one ping of each test pose that was heard more than once, another one of it."""
    groups = pose_groups(poses)
    pairs: dict[int, int] = {}
    for group in np.unique(groups[split == TEST]):
        same = np.flatnonzero((groups == group) & (split == TEST))
        if len(same) > 1:
            pairs[int(same[0])] = int(same[1])
    return pairs
