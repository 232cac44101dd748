# SPDX-License-Identifier: MIT
"""How far voxels lie behind the onsets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sononerf.echoes.free_space import EchoHull
from sononerf.geometry.lattice import Lattice

_COARSER = 4  # voxels between the places of the first look; only saves time


def clearance_grid(hull: EchoHull, lattice: Lattice) -> NDArray[np.float64]:
    """Return how far each voxel lies behind the onsets, (X, Y, Z) m; exact near zero.

    Parameters
    ----------
    hull : EchoHull
        What the onsets leave.
    lattice : Lattice
        The voxels.

    Returns
    -------
    clearance : (X, Y, Z) float, m
        Its slope is at most one, so voxels that a coarse look finds far from zero need no second
        one. At most the diagonal of the lattice, where no pose says anything.
    """
    far = lattice.spacing * float(np.linalg.norm(lattice.shape))
    coarse = [np.unique(np.append(np.arange(0, n, _COARSER), n - 1)) for n in lattice.shape]
    corners = np.stack(np.meshgrid(*coarse, indexing="ij"), axis=-1).reshape(-1, 3)
    found = np.minimum(hull.clearance(lattice.origin + lattice.spacing * corners)[0], far)
    values = found.reshape([len(c) for c in coarse])
    for axis, (picked, count) in enumerate(zip(coarse, lattice.shape, strict=True)):
        at = np.interp(np.arange(count), picked, np.arange(len(picked)))
        left = np.minimum(at.astype(int), max(len(picked) - 2, 0))
        part = (at - left).reshape([-1 if a == axis else 1 for a in range(3)])
        right = np.minimum(left + 1, len(picked) - 1)
        values = values.take(left, axis) * (1 - part) + values.take(right, axis) * part
    near = np.abs(values) < _COARSER * lattice.spacing
    places = lattice.origin + lattice.spacing * np.argwhere(near)
    values[near] = np.minimum(hull.clearance(places)[0], far)
    return np.asarray(values)
