# SPDX-License-Identifier: MIT
"""Meshes as sets of separate parts."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sononerf.errors import NumericalError

# Parts below a ball of this many voxels across are finer than the grid resolves.
MIN_PART_VOXELS = 3.0
# Parts with less than this share of the energy that a typical part has are noise.
MIN_PART_ENERGY = 0.01


def part_labels(mesh: trimesh.Trimesh) -> NDArray[np.intp]:
    """Return which part each triangle belongs to, (T,); parts share no edge."""
    count, pairs = len(mesh.faces), np.asarray(mesh.face_adjacency).reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels: NDArray[np.intp] = connected_components(graph, directed=False)[1]
    return labels


def submesh(mesh: trimesh.Trimesh, faces: NDArray[np.bool_] | NDArray[np.intp]) -> trimesh.Trimesh:
    """Return the triangles chosen by a mask (T,) or by indices, with the vertices they use."""
    chosen = np.asarray(mesh.faces)[faces]
    used, index = np.unique(chosen, return_inverse=True)
    return trimesh.Trimesh(
        np.asarray(mesh.vertices)[used], index.reshape(-1, 3), process=False, validate=False
    )


def split_parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the parts that share no edge, the one of the largest area first."""
    if not len(mesh.faces):
        return []
    labels = part_labels(mesh)
    areas = np.bincount(labels, weights=mesh.area_faces)
    order = np.argsort(-areas, kind="stable")
    return [submesh(mesh, labels == label) for label in order]


def clean_mesh(mesh: trimesh.Trimesh, *, min_area_fraction: float = 0.01) -> trimesh.Trimesh:
    """Return the mesh without its crumbs.

    Parameters
    ----------
    mesh : Trimesh
        Any mesh.
    min_area_fraction : float
        Parts with less than this share of the largest part's area are dropped.

    Returns
    -------
    mesh : Trimesh
        A new mesh; the largest part is always kept.

    Raises
    ------
    ValueError
        If the fraction lies outside 0 to 1.
    NumericalError
        If the mesh is empty.
    """
    if not 0 <= min_area_fraction <= 1:
        raise ValueError(f"min_area_fraction: {min_area_fraction}, expected 0 to 1")
    if not len(mesh.faces):
        raise NumericalError("the mesh is empty: it has no triangle")
    labels = part_labels(mesh)
    areas = np.bincount(labels, weights=mesh.area_faces)
    keep = areas >= min_area_fraction * areas.max()
    return submesh(mesh, keep[labels])


def supported_parts(
    mesh: trimesh.Trimesh,
    points: NDArray[np.float64],
    energies: NDArray[np.float64],
    *,
    reach: float,
    spacing: float,
) -> trimesh.Trimesh:
    """Leave out hollows, parts that the grid does not resolve, and parts that hardly echo.

    Parameters
    ----------
    mesh : Trimesh
        A surface read out of a grid.
    points : (N, 3) float, m
        What the surface was read out of.
    energies : (N,) float
        Zero or more.
    reach : float, m
        How far from the surface a point still supports it.
    spacing : float, m
        The grid's voxel size.

    Returns
    -------
    mesh : Trimesh
        A new mesh; the largest part is kept where none is large enough.
    """
    labels = part_labels(mesh)
    parts = [submesh(mesh, labels == label) for label in range(labels.max() + 1)]
    volumes = np.array([part.volume for part in parts])
    areas = np.array([part.area for part in parts])
    distance, vertex = cKDTree(mesh.vertices).query(points)
    owner = np.zeros(len(mesh.vertices), np.intp)
    owner[mesh.faces] = labels[:, None]
    close = distance < reach
    support = np.bincount(owner[vertex[close]], weights=energies[close], minlength=len(parts))
    # No sound comes out of a hollow; its wall has a negative volume.
    keep = volumes >= np.pi / 6 * (MIN_PART_VOXELS * spacing) ** 3
    if not keep.any():
        keep = volumes == volumes.max()
    order = np.flatnonzero(keep)[np.argsort(support[keep], kind="stable")]
    share = np.cumsum(areas[order]) / areas[order].sum()
    typical = support[order[int(np.searchsorted(share, 0.5))]]
    keep &= support >= MIN_PART_ENERGY * typical
    return submesh(mesh, keep[labels])
