# SPDX-License-Identifier: MIT
"""The poses of an experiment: training, validation and test."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.geometry.poses import (
    Poses,
    cap_poses,
    random_poses,
    random_sphere_poses,
    read_pose_csv,
    sphere_poses,
)
from sononerf.settings.schema import PoseSettings

TRAIN, VALIDATION, TEST = 0, 1, 2


def ensemble_poses(wanted: PoseSettings) -> tuple[Poses, NDArray[np.int8]]:
    """Poses of an experiment: those to train on, then those for validation, then for the test.

    Each set draws from a generator of its own, so that the number of one does not move another.
    The poses of a path stay in the order of its table.

    Parameters
    ----------
    wanted : PoseSettings
        Arrangement, numbers and seed.

    Returns
    -------
    poses : Poses
        All of them.
    split : (P,) int8
        0 train, 1 validation, 2 test.
    """
    if wanted.path is not None:
        return _path_poses(wanted, wanted.path)
    train, test = _arrangement(wanted)
    sets = (
        (TRAIN, wanted.count, train),
        (VALIDATION, wanted.validation, test),
        (TEST, wanted.heldout, test),
    )
    made, split = [], []
    for member, count, draw in sets:
        jitter = math.radians(wanted.aim_jitter_deg)
        made.append(draw(count, aim_jitter=jitter, generator=_generator(wanted, member)))
        split.append(np.full(count, member, dtype=np.int8))
    positions = np.concatenate([poses.positions for poses in made])
    rotations = np.concatenate([poses.rotations for poses in made])
    return Poses(positions, rotations), np.concatenate(split)


def _generator(wanted: PoseSettings, member: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([wanted.seed, member]))


def _arrangement(wanted: PoseSettings) -> tuple[Callable[..., Poses], Callable[..., Poses]]:
    """Return what makes the training poses, and what draws those for validation and test."""
    radius, axis = wanted.radius, wanted.axis
    if wanted.arrangement == "sphere":
        return partial(sphere_poses, radius=radius), partial(random_sphere_poses, radius=radius)
    angle = math.pi if wanted.half_angle_deg is None else math.radians(wanted.half_angle_deg)
    distances = radius, wanted.radius_max or radius
    draw = partial(random_poses, radius=distances, axis=axis, half_angle=angle)
    if wanted.arrangement == "volume":
        return draw, draw
    return partial(cap_poses, radius=radius, axis=axis, half_angle=angle), draw


def _path_poses(wanted: PoseSettings, path: Path) -> tuple[Poses, NDArray[np.int8]]:
    """Read a flight path; its rows for validation and test are drawn at random."""
    poses = read_pose_csv(path)
    if len(poses) <= wanted.validation + wanted.heldout:
        raise InputError(
            f"{path}: {len(poses)} poses, of which poses.validation takes {wanted.validation} and "
            f"poses.heldout {wanted.heldout}; none is left to train on"
        )
    split = np.full(len(poses), TRAIN, dtype=np.int8)
    for member, count in ((TEST, wanted.heldout), (VALIDATION, wanted.validation)):
        order = _generator(wanted, member).permutation(len(poses))
        split[order[split[order] == TRAIN][:count]] = member
    return poses, split
