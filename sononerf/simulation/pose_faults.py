# SPDX-License-Identifier: MIT
"""Poses that make no sense for a scene: inside its surface, or where no echo can be heard."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike

from sononerf.errors import InputError, NumericalError
from sononerf.geometry.plane import Plane
from sononerf.geometry.poses import Poses, aim_fault
from sononerf.geometry.raycast import contains
from sononerf.numerics import Bools, Floats
from sononerf.scene.scene import Scene

logger = logging.getLogger("sononerf")


def check_poses(
    scene: Scene, poses: Poses, *, offsets: Floats | None = None, plane: Plane | None = None
) -> None:
    """Refuse poses that lie inside the surface, or not above the support.

    In: offsets ((K, 3), m).
    """
    points = np.zeros((1, 3)) if offsets is None else np.vstack([np.zeros((1, 3)), offsets])
    places = poses.positions[:, None] + np.einsum("pij,kj->pki", poses.rotations, points)
    mesh = scene.mesh
    faces = mesh.faces[:, ::-1] if mesh.volume < 0.0 else mesh.faces  # inside out
    inside = contains(mesh.vertices, faces, places.reshape(-1, 3)).reshape(places.shape[:2])
    _refuse(inside.any(axis=1), "inside the scene's surface")
    if plane is not None and (low := (plane.height(places) <= 0.0).any(axis=1)).any():
        raise InputError(
            f"{_named(low)} not above the support; move them, for example by "
            "poses.arrangement=cap, or move support.point"
        )


def _refuse(bad: ArrayLike, what: str) -> None:
    bad = np.asarray(bad)
    if bad.any():
        raise InputError(f"{_named(bad)} {what}; move them, or raise poses.radius")


def _named(bad: Bools) -> str:
    """Say how many poses there are of a kind, and which are the first ten."""
    indices = np.flatnonzero(bad)
    listed = ", ".join(str(index) for index in indices[:10])
    return (
        f"{len(indices)} of {len(bad)} poses ({listed}{', ...' if len(indices) > 10 else ''}) are"
    )


def check_reach(
    scene: Scene, poses: Poses, *, bounces: int, range_min: float, range_max: float
) -> None:
    """Warn of poses that no echo can reach within the range limits.

    In: range_min, range_max (m).
    """
    lower, upper = np.asarray(scene.mesh.bounds)
    radius = float(np.linalg.norm(upper - lower)) / 2.0
    nearest = np.linalg.norm(poses.positions - np.clip(poses.positions, lower, upper), axis=1)
    distance = np.linalg.norm(poses.positions - (lower + upper) / 2.0, axis=1)
    far, near = nearest > range_max, distance + bounces * radius < range_min
    if (far | near).all():
        raise NumericalError(deaf(range_min, range_max))
    for bad, what, limit in (
        (far, "farther from the scene than range_max", range_max),
        (near, "nearer to all of the scene than range_min", range_min),
    ):
        if bad.any():
            logger.warning(
                "%s %s (%g m) and will hear nothing; set spectrogram.range_%s, or move them",
                *(_named(bad), what, limit, "max" if bad is far else "min"),
            )


def check_aim(scene: Scene, poses: Poses, *, is_directional: bool) -> None:
    """Warn of poses that look away from the scene, and of poses that are all the same."""
    fault = aim_fault(poses, np.asarray(scene.mesh.bounds).mean(axis=0))
    if fault and is_directional:
        logger.warning("%s", fault)
    if len(poses) > 1 and not np.ptp(poses.positions, axis=0).any():
        logger.warning("all %d poses are at one place; check the table of poses", len(poses))


def deaf(range_min: float, range_max: float) -> str:
    """Say that no pose hears anything within the range limits."""
    return (
        f"no pose received an echo between {range_min} and {range_max} m; check poses.radius, "
        "the scene's size (of a file, its unit) and the range limits"
    )
