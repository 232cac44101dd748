# SPDX-License-Identifier: MIT
"""Keep the two sides of a sheet apart while they move."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

APART = 0.15
"""Least thickness of a sheet, shortest wavelengths. A thinner one sounds the same, but its sides
could change places, and each would hide the other."""
_OPPOSED = -0.5  # cosine between the normals of two sides, at most
_AROUND = 16  # vertices among which that of the other side is looked for


class Sides:
    """Which vertices of a sheet lie opposite each other; those of the rim have no partner.

    Parameters
    ----------
    mesh : Trimesh
        A closed sheet, m, whose sides do not cross.
    least : float, m
        Thickness that is kept.
    """

    def __init__(self, mesh: trimesh.Trimesh, least: float) -> None:
        places, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
        _, near = cKDTree(places).query(places, k=min(_AROUND, len(places)))
        opposed = np.einsum("vkd,vd->vk", normals[near], normals) < _OPPOSED
        some = np.flatnonzero(opposed.any(axis=1))
        self._vertex = torch.as_tensor(some)
        self._other = torch.as_tensor(near[some, opposed[some].argmax(axis=1)])
        self._least = least

    def apart(self, vertices: Tensor, normals: Tensor) -> Tensor:
        """Return the vertices (V, 3), moved outward where the sides are too close.

        Parameters
        ----------
        vertices : (V, 3) float64, m
            As they are now.
        normals : (V, 3) float64
            Outward unit vectors.
        """
        one, other = (part.to(vertices.device) for part in (self._vertex, self._other))
        gap = ((vertices[one] - vertices[other]) * normals[one]).sum(1, keepdim=True)
        short = (self._least - gap).clamp_min(0.0)
        return vertices.index_add(0, one, 0.5 * short * normals[one])
