# SPDX-License-Identifier: MIT
"""Meshes as sets of separate parts."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sononerf.errors import NumericalError


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
