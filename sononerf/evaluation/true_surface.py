# SPDX-License-Identifier: MIT
"""The true surface, prepared once for all that is compared with it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.evaluation.nearest import Nearest
from sononerf.evaluation.solid import (
    Solid,
    count_parts,
    outer_surface_of,
    sample_solid,
    solid_from_mesh,
)

Samples = tuple[NDArray[np.float64], NDArray[np.float64]]


class TrueSurface:
    """The outer surface of the solid union of the true bodies; each part made when first needed.

    Parameters
    ----------
    mesh : Trimesh
        Metres, world frame; closed bodies, which may overlap, and open sheets.

    Raises
    ------
    NumericalError
        If the mesh is empty or not finite.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.solid: Solid = solid_from_mesh(mesh, drop_cavities=True)
        self._samples: dict[tuple[int, int], Samples] = {}

    @cached_property
    def nearest(self) -> Nearest:
        """Distances to the outer surface."""
        return Nearest(outer_surface_of(self.solid))

    @cached_property
    def components(self) -> int:
        """How many parts there are; see :func:`count_parts`."""
        return count_parts(self.solid)

    def samples(self, count: int, seed: int) -> Samples:
        """Return points (count, 3) m and normals of the outer surface, drawn once per seed."""
        key = (count, seed)
        if key not in self._samples:
            self._samples[key] = sample_solid(self.solid, count, seed)
        return self._samples[key]
