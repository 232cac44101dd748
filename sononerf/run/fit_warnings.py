# SPDX-License-Identifier: MIT
"""Warnings before a fit that cannot give a useful result."""

from __future__ import annotations

import numpy as np

from sononerf.echoes.echoes import SAME, Echoes
from sononerf.geometry.poses import Poses, aim_fault
from sononerf.numerics import Floats

LINE = (
    "all training poses lie on a straight line: the echoes do not tell the angle around it, so the "
    "surface may be drawn out around the line; fly another way as well"
)
MOSTLY = 0.5
"""Fraction of a table or a region above which a fault of it is reported, no unit. It is a half,
since a few repeated poses, or corners out of every pose's reach, do no harm."""
SOME = 0.25
"""Fraction of the poses with an echo that may hear none from the region, no unit. Of a body 70 mm
beside the region 3 of 8 poses all around heard none; of a body within it all heard one."""
FEWEST = 8.0
"""Mean distance between neighbouring places on a sphere around the region that poses face, range
resolutions, above which poses are too few. The shipped experiments have 1 to 6. Between such places
no part of a convex body reflects sound straight back."""
SIDE = 8
"""Number of places along each side of the region whose distance from the poses is checked."""


def fit_warnings(echoes: Echoes, region: Floats, *, is_set: bool) -> list[str]:
    """Return warnings about a fit, one line each.

    In: region ((2, 3), m).
    """
    training = echoes.poses("train")
    warnings = [_repeated(training)]
    if echoes.hull.width < echoes.head.resolution:
        warnings.append(LINE)
    if echoes.head.ears.is_directional and (fault := aim_fault(training, region.mean(axis=0))):
        warnings.append(f"training {fault}")
    warnings.append(_few(training, region, echoes.head.resolution))
    if is_set:
        warnings += [_out_of_reach(echoes, training, region), _elsewhere(echoes, region)]
    plane = echoes.head.plane
    if plane is not None and plane.height(region.mean(axis=0)) < 0.0:
        warnings.append(
            "the echoes come from below the support; check support.point and the heights of poses"
        )
    return [line for line in warnings if line]


def _repeated(poses: Poses) -> str:
    whole = np.column_stack([poses.positions, poses.rotations.reshape(-1, 9)])
    different = len(np.unique(np.round(whole / SAME), axis=0))
    if different > MOSTLY * len(poses):
        return ""
    return f"only {different} of {len(poses)} training poses differ; check the table of poses"


def _few(poses: Poses, region: Floats, resolution: float) -> str:
    """Return a warning if the poses face places too far apart for the range resolution."""
    places = len(np.unique(np.round(poses.positions / SAME), axis=0))
    radius = float((region[1] - region[0]).mean()) / 2.0
    gap = radius * float(np.sqrt(4.0 * np.pi / max(places, 1)))
    if gap <= FEWEST * resolution:
        return ""
    needed = int(np.ceil(places * (gap / (FEWEST * resolution)) ** 2))
    return (
        f"{places} places of training poses are few for a region of {2e3 * radius:.0f} mm across "
        f"at a range resolution of {1e3 * resolution:.1f} mm: record from {needed} or more, or set "
        "a smaller region"
    )


def _out_of_reach(echoes: Echoes, poses: Poses, region: Floats) -> str:
    """Return a warning if the region holds poses, or places that no pose hears."""
    within = ((poses.positions > region[0]) & (poses.positions < region[1])).all(axis=1)
    if within.any():
        return (
            f"{within.sum()} training poses lie inside the region, where there is no body: it is "
            "larger than the scene can be; check region.lower and region.upper (m)"
        )
    axes = [np.linspace(low, high, SIDE) for low, high in region.T]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    some = poses.positions[np.linspace(0, len(poses) - 1, min(len(poses), 64)).astype(int)]
    away = np.linalg.norm(places[:, None] - some[None], axis=2)
    ranges = echoes.head.range
    deaf = ((away < ranges[0]) | (away > ranges[-1])).all(axis=1)
    if deaf.mean() <= MOSTLY:
        return ""
    return (
        f"no training pose hears {100 * deaf.mean():.0f} % of the region within {ranges[0]:.3g} to "
        f"{ranges[-1]:.3g} m; check region.lower and region.upper (m)"
    )


def _elsewhere(echoes: Echoes, region: Floats) -> str:
    """Return a warning if poses hear an echo, and none from the region that was set."""
    free = Echoes(echoes.store, echoes.head)
    heard = np.isfinite(free.onsets.first).any(axis=1)
    hull = echoes.within(region).hull
    corners = np.stack(np.meshgrid(*region.T, indexing="ij"), axis=-1).reshape(-1, 3)
    out = np.linalg.norm(hull.emitters[:, None] - corners, axis=-1)[:, None]  # (P, 1, 8)
    back = np.linalg.norm(hull.receivers[:, :, None] - corners, axis=-1)  # (P, E, 8)
    farthest = ((out + back) / 2.0).max(axis=-1) + echoes.head.resolution
    # Sound before any echo from the region is no onset here; outliers have weight zero.
    from_region = (np.isfinite(hull.trusted) & (hull.trusted <= farthest)).any(axis=1)
    none = heard & ~from_region
    if none.sum() <= SOME * heard.sum():
        return ""
    return (
        f"{none.sum()} of {heard.sum()} training poses hear echoes, and none from the region: the "
        "body lies elsewhere, or the places of poses are wrong; leave region.lower and "
        "region.upper out to find it"
    )
