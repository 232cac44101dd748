# SPDX-License-Identifier: MIT
"""Which pings are for training, validation and test; repeated pings stay together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sononerf.array_types import Ints
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


def assign_split(
    poses: Poses,
    stated: NDArray[np.int8] | None,
    *,
    validation: int | None,
    heldout: int | None,
    seed: int,
    where: str,
) -> NDArray[np.int8]:
    """Return what each ping is for.

    Args:
        poses: P of them.
        stated ((P,) int8 or None): As the table says; drawn at random where None.
        validation, heldout: How many poses; a twentieth and a tenth where None, at most 10 and 20.
        seed: Of the draw.
        where: The table, for messages.

    Returns:
        split ((P,) int8): 0 train, 1 validation, 2 test.

    Raises:
        InputError: If none is left to train on.
    """
    groups = pose_groups(poses)
    count = int(groups.max(initial=-1)) + 1
    if stated is not None:
        split = stated
    else:
        few = min(10, max(count // 20, int(count >= 3))) if validation is None else validation
        some = min(20, max(count // 10, int(count >= 3))) if heldout is None else heldout
        order = np.random.default_rng(seed).permutation(count)
        of_group = np.full(count, TRAIN, dtype=np.int8)
        of_group[order[:some]] = TEST
        of_group[order[some : some + few]] = VALIDATION
        split = of_group[groups]
    if not (split == TRAIN).any():
        raise InputError(
            f"{where}: {count} poses, and none is left to train on; lower import.validation and "
            "import.heldout, or correct the column split"
        )
    return split


def repeats(poses: Poses, split: NDArray[np.int8]) -> dict[int, int]:
    """Return, for one ping of each test pose that was heard more than once, another one of it."""
    groups = pose_groups(poses)
    pairs: dict[int, int] = {}
    for group in np.unique(groups[split == TEST]):
        same = np.flatnonzero((groups == group) & (split == TEST))
        if len(same) > 1:
            pairs[int(same[0])] = int(same[1])
    return pairs
