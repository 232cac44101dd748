# SPDX-License-Identifier: MIT
"""Which first echoes were heard too late, judged by what the others heard.

A first echo comes from somewhere: some place at its range must be left by all the others. Where the
nearest point of a body answered too faintly to be heard, as a thin sheet's edge does beside the
flash of its face, a pose takes a later echo for the first, and rules out places that others heard.
One such pose cuts off a part of the space that the echoes leave. It is known by that: it stands
alone against several others, which agree on a place. That place is there, so the echo was late by
what lies between, at least; what is nearer yet it rules out as before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from sononerf.geometry.hull import EchoHull

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOLERANCE = 0.0015
"""How much too late an echo must be, m: some times more than how well its onset can be read."""
READING = 0.0005
"""How well the range of a first echo is read, m."""
MOST = 1.2e8
"""Cells times first echoes that are looked at in one pass: with more of them it is coarser."""
FEW = (0.02, 4)
"""A place is looked at as the origin of an echo while at most this share of all, or so many, rule
it out."""
AGAINST = 2.0
"""So many first echoes must lose their origin to one that is too late. One that loses it to n
others counts for 1/n: it may be itself that is wrong."""
COARSE = 24
"""Cells along the longest side, at first."""
OCTANTS = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def corrected(hull: EchoHull, lower: ArrayLike, upper: ArrayLike) -> EchoHull:
    """Return the hull with first echoes that were heard too late where they should have been.

    Parameters
    ----------
    hull : EchoHull
        What the first echoes leave.
    lower, upper : (3,) float, m
        Corners of a box that everything heard lies in.

    Returns
    -------
    hull : EchoHull
        The same poses; ``first`` is nearer by :func:`lateness`.
    """
    return replace(hull, first=hull.first - lateness(hull, lower, upper))


def lateness(hull: EchoHull, lower: ArrayLike, upper: ArrayLike) -> Array:
    """Return by how much first echoes were heard too late, at least, (P, E) m; 0 if they were not.

    It is what gives all those their origin back that lost it to one. Parameters as in
    ``corrected``.
    """
    first = hull.first.reshape(-1)
    found = np.zeros(len(first))
    box = np.asarray((lower, upper), dtype=np.float64)
    heard = np.flatnonzero(np.isfinite(first))
    homeless = heard[~_cells(hull, box, heard, 0)[1].any(axis=0)]
    if len(homeless) < AGAINST:
        return found.reshape(hull.first.shape)
    few = max(int(FEW[0] * len(first)), FEW[1])
    against, meets, cells = _cells(hull, box, homeless, few)
    count = against.sum(axis=1).astype(int)
    blocks = sparse.csr_matrix(against)
    while True:
        least = np.where(meets, count[:, None], few + 1).min(axis=0, initial=few + 1)
        asks = np.flatnonzero((least > 0) & (least <= few) & (found[homeless] == 0))
        if not len(asks):
            break
        origins = sparse.csr_matrix(meets[:, asks] & (count[:, None] == least[asks]))
        lost = (origins.T.astype(float) @ blocks.astype(float)) > 0  # (asks, first echoes)
        blame = np.asarray(lost.multiply(1.0 / least[asks][:, None]).sum(axis=0)).reshape(-1)
        blame[found > 0] = 0.0
        worst = int(blame.argmax())
        if blame[worst] < AGAINST:
            break
        ruled_out = np.flatnonzero(against[:, worst])
        depth = -hull.behind(cells[ruled_out]).reshape(len(ruled_out), -1)[:, worst]
        theirs = origins[ruled_out].toarray()
        each = np.where(theirs, depth[:, None], np.inf).min(axis=0)
        found[worst] = each[np.isfinite(each)].max()
        count -= against[:, worst]
    return found.reshape(hull.first.shape)


def _cells(
    hull: EchoHull, box: Array, wanted: NDArray[np.intp], few: int
) -> tuple[Mask, Mask, Array]:
    """Return cells at the range of wanted first echoes that at most a few rule out.

    Returns
    -------
    against : (N, P E) bool
        Which first echoes rule a cell out.
    meets : (N, W) bool
        At which wanted ones' range it lies.
    cells : (N, 3) float, m
        Their middles.
    """
    lower, upper = box
    side = float((upper - lower).max()) / COARSE
    axes = [np.arange(a + side / 2, b + side / 2, side) for a, b in zip(lower, upper, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        reach = side * np.sqrt(3) / 2 + READING
        kept = []
        for start in range(0, len(cells), hull.chunk):
            part = cells[start : start + hull.chunk]
            behind = hull.behind(part).reshape(len(part), -1)
            against, meets = behind < -reach, np.abs(behind[:, wanted]) <= reach
            keep = (against.sum(axis=1) <= few) & meets.any(axis=1)
            kept.append((part[keep], against[keep], meets[keep]))
        cells, against, meets = (np.concatenate(each) for each in zip(*kept, strict=True))
        finer = 8.0 * len(cells) * hull.first.size
        if reach <= TOLERANCE or finer > MOST or not len(cells):
            return against, meets, cells
        cells = (cells[:, None] + side * OCTANTS).reshape(-1, 3)
        side /= 2
