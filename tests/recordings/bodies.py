# SPDX-License-Identifier: MIT
"""Random bodies, the first echoes that come from them, and poses around them."""

from __future__ import annotations

import numpy as np

from sononerf.geometry.poses import Poses, cap_poses, euler_from_rotation, random_poses
from sononerf.recordings.pose_tables import Columns, turntable_poses

EMITTER = np.array([0.0, 0.0, -0.010])
EARS = np.array([[-0.010, 0.010, 0.005], [-0.010, -0.010, 0.005]])


def body(rng):
    """Points of up to five ellipsoids, of 8 to 30 mm, about the origin."""
    middle, parts = rng.normal(0, 0.012, 3), []
    for _ in range(rng.integers(1, 6)):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        unit = rng.normal(size=(800, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        part = unit * rng.uniform(0.008, 0.03, 3) @ turn
        parts.append(middle + rng.normal(0, 0.03, 3) + part)
    return np.concatenate(parts)


def first_echoes(rng, poses, points, *, ears=EARS, noise=3e-4):
    """Ranges (P, E) of first echoes: noisy, one in seventeen wrong, one in twenty missing."""
    out = poses.positions + poses.rotations @ EMITTER
    back = poses.positions[:, None] + np.einsum("pij,ej->pei", poses.rotations, ears)
    first = np.zeros((len(poses), len(ears)))
    for index in range(len(poses)):
        there = np.linalg.norm(points - out[index], axis=1)
        again = np.linalg.norm(points[:, None] - back[index], axis=2)
        first[index] = (there[:, None] + again).min(axis=0) / 2.0
    first += noise * rng.normal(size=first.shape)
    wrong = rng.random(first.shape) < 0.06
    side = np.where(rng.random(first.shape) < 0.2, -1.0, 1.0)
    first += wrong * side * np.abs(rng.normal(0, 0.02, first.shape))
    first[rng.random(first.shape) < 0.05] = -np.inf
    return first


def poses_of(rng, kind):
    """Poses on a sphere, in a volume, on a cap, or of a turntable."""
    jitter, radius = np.radians(12), rng.uniform(0.3, 0.6)
    if kind == "sphere":
        return Poses.sphere(90, radius=radius, aim_jitter=jitter, generator=rng)
    if kind == "volume":
        return random_poses(
            90, radius=(0.3, 0.6), axis=rng.normal(size=3), half_angle=np.pi, aim_jitter=jitter,
            generator=rng,
        )  # fmt: skip
    if kind == "cap":
        return cap_poses(
            90, radius=radius, axis=(1, 0.2, 0.3), half_angle=np.radians(60), aim_jitter=jitter,
            generator=rng,
        )  # fmt: skip
    angle, height = np.meshgrid(np.radians(np.arange(0, 360, 12)), np.linspace(-0.05, 0.1, 4))
    return turntable_poses(angle.ravel(), height.ravel(), radius=radius, clockwise=False)


def table(poses, unit="deg"):
    """Columns as a user would have them, in metres and degrees or radians."""
    angles = dict(zip(("yaw", "pitch", "roll"), euler_from_rotation(poses.rotations), strict=True))
    places = dict(zip("xyz", poses.positions.T, strict=True))
    return Columns("t", {**places, **angles}, {}, None, {"yaw": unit, "x": "m"})
