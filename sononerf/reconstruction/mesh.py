# SPDX-License-Identifier: MIT
"""Meshes read out of volumes and oriented points, and written as files."""

from __future__ import annotations

from typing import Literal

import numpy as np
import trimesh

from sononerf.errors import NumericalError
from sononerf.reconstruction.isosurface import automatic_level, isosurface
from sononerf.reconstruction.oriented import oriented_surface
from sononerf.reconstruction.parts import clean_mesh, split_parts

__all__ = [
    "automatic_level",
    "clean_mesh",
    "isosurface",
    "mesh_bytes",
    "oriented_surface",
    "split_parts",
]

MeshFormat = Literal["ply", "stl", "glb"]


def mesh_bytes(mesh: trimesh.Trimesh, file_type: MeshFormat) -> bytes:
    """Return a mesh as the bytes of a file; the same mesh gives the same bytes.

    Parameters
    ----------
    mesh : Trimesh
        Metres.
    file_type : {"ply", "stl", "glb"}
        Binary PLY, binary STL, or binary glTF.

    Returns
    -------
    data : bytes
        The file.

    Raises
    ------
    ValueError
        If the format is another one.
    NumericalError
        If the mesh is empty or a vertex is not finite.
    """
    if file_type not in ("ply", "stl", "glb"):
        raise ValueError(f"file_type: {file_type!r}, expected 'ply', 'stl' or 'glb'")
    if not len(mesh.faces):
        raise NumericalError("the mesh is empty: there is nothing to write")
    if not np.isfinite(mesh.vertices).all():
        raise NumericalError("the mesh has vertices that are not finite")
    # A bare copy: names, paths and times that a loader attached stay out of the file.
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    return bytes(bare.export(file_type=file_type))
