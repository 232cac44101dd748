# SPDX-License-Identifier: MIT
"""Where a field sounds from: the points of a surface that face the places it was heard from.

The fit brings the *sound* of a field into its place, to a tenth of a millimetre; the places that
the sound is made of need not lie there, since several that overlap share an echo. So nothing is
read off the places themselves. For each pose the echoes that they make together are found, and each
of them is put where it is heard: at its own range, on the line of sight. It is a glint, a point of
the surface whose normal looks at the pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.field.field import Field

Array = NDArray[np.float64]
REACH = 0.018
"""Places no farther than this from the middle of an echo, m, take part in it."""
DEPTH = 0.006
"""Standard deviation of the range over which they do, m: what the analysis window resolves."""
TAKEN_REACH, TAKEN_DEPTH = 1.3, 2.5
"""How many times farther than that places count as explained by it."""
FAINTEST_PLACE, FAINTEST_REST = 1e-5, 3e-3
"""Of a pose's power: places below the one are not looked at; below the other the search ends."""
MOST = 60
"""Glints per pose."""
SETTLING = 3
"""How often an echo's middle is found anew."""
BANDS = 5
"""Frequencies whose power is summed."""
FEW_SUPPORT = 0.3
"""Others' power around a glint is little where it is this part of what is usual."""


@dataclass(frozen=True, eq=False)
class Glints:
    """Points of a surface, as they were heard.

    Attributes
    ----------
    points : (G, 3) float, m
        World frame.
    normals : (G, 3) float
        Unit vectors towards the poses.
    power : (G,) float
        Of the echo, without spreading.
    pose : (G,) int
        Which pose heard it.
    """

    points: Array
    normals: Array
    power: Array
    pose: NDArray[np.intp]

    def where(self, kept: NDArray[np.bool_]) -> Glints:
        """Return those for which (G,) is true."""
        return Glints(self.points[kept], self.normals[kept], self.power[kept], self.pose[kept])


@torch.no_grad()
def find_glints(
    field: Field,
    places: Tensor,
    sources: Tensor,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Glints:
    """Listen to a field from where it was heard, and locate its echoes.

    Parameters
    ----------
    field : Field
        That knows directions.
    places : (N, 3) float, m
        Where it is not silent.
    sources : (P, 3) float, m
        Where it was heard from: half way between emitter and ears.
    progress : callable, optional
        Called with the poses done and the poses in all.

    Returns
    -------
    glints : Glints
        Of all poses; none where nothing is heard.
    """
    count = len(field.frequency)
    bands = torch.arange(BANDS, device=places.device) * (count - 1) // (BANDS - 1)
    where = places.double().cpu().numpy()
    found: list[tuple[Array, Array, float, int]] = []
    for pose, source in enumerate(sources):
        ray = source - places
        distance = ray.norm(dim=-1)
        unit = ray / distance[:, None]
        index = field.audible(places, source[None])[0].nonzero()[:, 0]
        response, lead = field.echo(places[index], unit[index], bands)
        power = response.abs().square().mean(-1) / distance[index] ** 4
        loud = power > FAINTEST_PLACE * power.max() if len(power) else power > 0
        index = index[loud]
        found += [
            (*echo, pose)
            for echo in _echoes(
                where[index.cpu().numpy()],
                (distance[index] - lead[loud]).double().cpu().numpy(),
                power[loud].double().cpu().numpy(),
                source.double().cpu().numpy(),
            )
        ]
        if progress is not None:
            progress(pose + 1, len(sources))
    return Glints(
        np.array([point for point, _, _, _ in found]).reshape(-1, 3),
        np.array([normal for _, normal, _, _ in found]).reshape(-1, 3),
        np.array([power for _, _, power, _ in found]),
        np.array([pose for _, _, _, pose in found], dtype=np.intp),
    )


def _echoes(
    places: Array, ranges: Array, power: Array, source: Array
) -> list[tuple[Array, Array, float]]:
    """Gather what sounds together, the loudest first: point, normal and power of each echo."""
    found = []
    left, total = power.copy(), power.sum()
    for _ in range(MOST):
        if not left.sum() > FAINTEST_REST * total:
            break
        loudest = int(left.argmax())
        middle, at = places[loudest], ranges[loudest]
        for _ in range(SETTLING):
            near = ((places - middle) ** 2).sum(axis=1) < REACH**2
            weight = power * near * np.exp(-0.5 * ((ranges - at) / DEPTH) ** 2)
            loudness = float(weight.sum())
            middle, at = weight @ places / loudness, float(weight @ ranges) / loudness
        towards = source - middle
        normal = towards / np.linalg.norm(towards)
        # Free of spreading, so that far and near poses weigh alike.
        found.append((source - at * normal, normal, loudness * at**4))
        explained = ((places - middle) ** 2).sum(axis=1) < (TAKEN_REACH * REACH) ** 2
        left[explained & (np.abs(ranges - at) < TAKEN_DEPTH * DEPTH)] = 0
        left[loudest] = 0
    return found


def trust(glints: Glints, *, reach: float = 0.012, tolerance: float = 0.0015) -> Array:
    """Return how far the poses bear each glint out, (G,) from 0 to 1.

    A true one has those of other poses around it that lie on one smooth surface with it. Second
    bounces and what interference makes are heard elsewhere from each pose, and are weak.

    Parameters
    ----------
    glints : Glints
        Of all poses.
    reach : float, m
        How far around a glint others are asked.
    tolerance : float, m
        How far two may lie from one smooth surface.

    Returns
    -------
    trust : (G,) float
        The share of the power around a glint that comes from such as lie on one surface with it,
        times how far that power itself reaches what is usual; both squared. Zero where nobody
        else is near.
    """
    count = len(glints.points)
    pairs = cKDTree(glints.points).query_pairs(reach, output_type="ndarray")
    i, j = pairs[glints.pose[pairs[:, 0]] != glints.pose[pairs[:, 1]]].T
    between = glints.points[j] - glints.points[i]
    both = glints.normals[i] + glints.normals[j]
    # Of two points of one sphere the chord is at right angles to the sum of their normals.
    level = np.abs((between * both).sum(axis=1)) < 2 * tolerance
    alike = (glints.normals[i] * glints.normals[j]).sum(axis=1) > 0.5
    agrees = level & alike
    power = glints.power
    support = np.bincount(i, power[j] * agrees, count) + np.bincount(j, power[i] * agrees, count)
    around = np.bincount(i, power[j], count) + np.bincount(j, power[i], count) + power
    if not float(power @ support) > 0:
        return np.zeros(count)
    usual = float(np.average(support, weights=power))
    share: Array = (support / around) ** 2 * (support / (support + FEW_SUPPORT * usual)) ** 2
    return share
