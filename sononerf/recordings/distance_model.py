# SPDX-License-Identifier: MIT
r"""Model of the distance between a body's nearest point and any place, from first echoes.

Half of the way from emitter to receiver over a far body is the distance :math:`d(m)` of the point
:math:`m` half way between the two, but for :math:`b^2 / 8 d` with b the part of their separation
across the line of sight. The distance is modelled as

.. math:: d(m) = |m - c| - \sum_k a_k Y_k\!\left(\frac{m - c}{|m - c|}\right)

with polynomials Y of the direction. Centre and coefficients are fitted robustly; each ping is
predicted by a fit without its own part of the pings.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import least_squares

from sononerf.numerics import Floats

DEGREE = 4
"""Largest degree of the polynomials, no unit: it separates parts of a body 45 degrees apart."""
PER_COEFFICIENT = 4
"""Least number of pings for each coefficient, no unit."""
PARTS = 6
"""Number of parts of the pings; each part is predicted from the others (cross-validation)."""
ROUNDS = 8
"""Number of passes of the robust fit; after these the weights no longer change."""
RIDGE = 1e-3
"""Weight of the ridge penalty on the coefficients, no unit: that of one in a thousand pings."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """First echoes of the pings as predicted from one another.

    Attributes:
        residual ((P, E), m): Measured less predicted; NaN where nothing was measured.
        centre ((3,), m): From where distances are counted.
        size (m): Mean distance from there to the body's surface; negative if the echoes contradict
            one another by so much.
    """

    residual: Floats
    centre: Floats
    size: float


def predict(middle: Floats, separation: Floats, first: Floats) -> Prediction:
    """Predict each ping's first echoes from the other pings'.

    Args:
        middle ((P, E, 3), m): Points half way between emitter and receivers.
        separation ((P, E, 3), m): From the emitter to each receiver.
        first ((P, E), m): Ranges of first echoes; not finite without an echo.
    """
    known = np.isfinite(first).any(axis=1)
    pings = np.flatnonzero(known)
    residual = np.full(first.shape, np.nan)
    centre, size = _sphere(middle[pings], first[pings])
    away = middle - centre
    radius = np.linalg.norm(away, axis=2)
    direction = away / np.maximum(radius, 1e-12)[..., None]
    across = separation - (separation * direction).sum(2, keepdims=True) * direction
    wide = (across**2).sum(2)
    measured = first - wide / (8.0 * np.maximum(first, 1e-3))
    degree = DEGREE
    while degree > 1 and len(_powers(degree)) * PER_COEFFICIENT > len(pings):
        degree -= 1
    basis = _basis(direction, degree)
    target = radius - measured  # the body's extent towards each ping
    part = np.arange(len(pings)) % min(PARTS, max(len(pings), 1))
    for held in range(part.max(initial=-1) + 1):
        rest, own = pings[part != held], pings[part == held]
        there = np.isfinite(first[rest])
        if there.sum() <= basis.shape[2]:
            continue
        weights = _robust(basis[rest][there], target[rest][there])
        residual[own] = basis[own] @ weights - target[own]
    residual[~np.isfinite(first)] = np.nan
    return Prediction(residual, centre, size)


def _powers(degree: int) -> list[tuple[int, ...]]:
    """Return the monomials of x, y, z of a degree and one less: all polynomials on the sphere."""
    return [
        powers
        for total in (degree - 1, degree)
        for powers in combinations_with_replacement(range(3), total)
    ]


def _basis(direction: Floats, degree: int) -> Floats:
    columns = [
        np.prod(direction[..., list(powers)], axis=-1) if powers else np.ones(direction.shape[:-1])
        for powers in _powers(degree)
    ]
    return np.stack(columns, axis=-1)


def _robust(basis: Floats, target: Floats) -> Floats:
    """Fit coefficients by least squares whose weights fall with the residual."""
    weight = np.ones(len(target))
    middle = float(np.median(target))
    pull = RIDGE * len(target) * np.eye(basis.shape[1])
    # The pull is towards a sphere, not towards nothing.
    sphere = np.linalg.lstsq(basis, np.full(len(basis), middle), rcond=None)[0]
    fitted = sphere
    for _ in range(ROUNDS):
        scaled = basis * weight[:, None]
        rest = target - basis @ sphere
        fitted = sphere + np.linalg.solve(basis.T @ scaled + pull, scaled.T @ rest)
        error = target - basis @ fitted
        scale = 1.48 * float(np.median(np.abs(error))) + 1e-9
        weight = 1.0 / np.maximum(np.abs(error) / (1.5 * scale), 1.0) ** 2
    return fitted


def _sphere(middle: Floats, first: Floats) -> tuple[Floats, float]:
    """Return centre (3,) and radius of the sphere that explains first echoes best."""
    there = np.isfinite(first)
    places, ranges = middle[there], first[there]
    start = places.mean(axis=0)
    spread = float(np.linalg.norm(places - start, axis=1).mean())
    scale = max(float(np.median(ranges)), 1e-6)

    def misfit(unknown: Floats) -> Floats:
        return (np.linalg.norm(places - unknown[:3], axis=1) - unknown[3] - ranges) / scale

    best = None
    # Poses on one side of a body leave two sides to look on.
    for side in _sides(places, start, scale):
        guess = np.r_[side, np.linalg.norm(places - side, axis=1).mean() - np.median(ranges)]
        solution = least_squares(
            misfit, guess, loss="soft_l1", f_scale=0.02, max_nfev=60, x_scale=max(spread, scale)
        )
        if best is None or solution.cost < best.cost:
            best = solution
    assert best is not None
    return best.x[:3], float(best.x[3])


def _sides(places: Floats, start: Floats, scale: float) -> list[Floats]:
    """Return guesses of a centre: amid the places, and beside them where they are flattest."""
    normal = np.linalg.svd(places - start, full_matrices=True)[2][-1]
    return [start, start + scale * normal, start - scale * normal]
