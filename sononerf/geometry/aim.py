# SPDX-License-Identifier: MIT
"""Aim of heads: poses that look away from a body, and the mistake that explains it."""

from __future__ import annotations

import numpy as np

from sononerf.array_types import Floats
from sononerf.geometry.poses import Poses, euler_from_rotation, rotation_from_euler

ASIDE = np.radians(45.0)
"""Median angle between the heads' aim and the body above which a mistake is suspected, rad. Bats
aim within some degrees; a call is half as loud 30 to 40 degrees off its axis."""
EXPLAINED = np.radians(20.0)
"""Median angle between the heads' corrected aim and the body below which a suspected mistake counts
as the explanation, rad."""


def off_axis(poses: Poses, centre: Floats) -> Floats:
    """Return the angles (P,) between where heads look and where a body is, rad.

    In: centre ((3,), m).
    """
    to_body = centre - poses.positions
    distance = np.linalg.norm(to_body, axis=1)
    ahead = (to_body * poses.rotations[:, :, 0]).sum(axis=1)
    return np.arccos((ahead / np.maximum(distance, 1e-12)).clip(-1.0, 1.0))


def aim_fault(poses: Poses, centre: Floats) -> str:
    """Return a line if poses look away from a body, and its likely cause; empty otherwise.

    In: centre ((3,), m).
    """
    if not len(poses):
        return ""
    stated = float(np.median(off_axis(poses, centre)))
    if stated < ASIDE:
        return ""
    yaw, pitch, roll = (np.asarray(a) for a in euler_from_rotation(poses.rotations))
    others: dict[str, list[Floats]] = {
        "yaw and pitch are swapped": [pitch, yaw, roll],
        "the sign of pitch is the opposite one (positive pitch looks down)": [yaw, -pitch, roll],
        "the sign of yaw is the opposite one": [-yaw, pitch, roll],
        "the poses look the other way": [yaw + np.pi, -pitch, -roll],
    }
    degrees = [np.degrees(angle) for angle in (yaw, pitch, roll)]
    if max(np.abs(angle).max() for angle in degrees) <= 2.0 * np.pi:
        others["angles are in radians, and are read as degrees"] = degrees
    angles = {}
    for name, turns in others.items():
        turned = Poses(poses.positions, rotation_from_euler(*turns))
        angles[name] = float(np.median(off_axis(turned, centre)))
    best = min(angles, key=angles.__getitem__)
    cause = f"; perhaps {best}" if angles[best] < min(EXPLAINED, stated / 2.0) else ""
    where = "look away from" if stated > np.pi / 2.0 else "look past"
    return f"poses {where} the body, by {np.degrees(stated):.0f} degrees in the median{cause}"
