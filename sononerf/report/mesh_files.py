# SPDX-License-Identifier: MIT
"""Meshes as files."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.report.confidence import confidence_colours, linear_light

MeshFormat = Literal["ply", "stl", "glb"]


def mesh_bytes(
    mesh: trimesh.Trimesh, file_type: MeshFormat, *, confidence: ArrayLike | None = None
) -> bytes:
    """Return a mesh as the bytes of a file; the same mesh gives the same bytes.

    With a confidence PLY and GLB carry a colour per vertex: from dark grey, heard by no pose, to
    bright yellow, heard by a hundred or more, in steps even to the eye over the logarithm (see
    :func:`~sononerf.report.confidence.confidence_colours`). PLY also holds the numbers
    themselves, as the vertices' property ``poses``, and always their normals. STL knows neither.

    Parameters
    ----------
    mesh : Trimesh
        Metres.
    file_type : {"ply", "stl", "glb"}
        Binary PLY, binary STL, or binary glTF.
    confidence : (V,) int, optional
        How many poses heard the surface around each vertex.

    Returns
    -------
    data : bytes
        The file.

    Raises
    ------
    ValueError
        If the format is another one, or there is not one number per vertex, zero or more.
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
    if confidence is not None:
        _carry(bare, file_type, np.asarray(confidence))
    options = {"vertex_normal": True} if file_type == "ply" else {}
    return bytes(bare.export(file_type=file_type, **options))


def _carry(mesh: trimesh.Trimesh, file_type: MeshFormat, poses: NDArray[Any]) -> None:
    """Colour a mesh by its confidence, in place, as far as the format has colours."""
    if poses.shape != (len(mesh.vertices),) or not (poses >= 0).all():
        raise ValueError(
            f"confidence: shape {poses.shape}, expected ({len(mesh.vertices)},), zero or more"
        )
    if file_type == "stl":
        return
    colours = confidence_colours(poses)
    if file_type == "glb":
        colours = linear_light(colours)  # glTF's own rule; a viewer would show sRGB too bright
    else:
        mesh.vertex_attributes["poses"] = poses.astype(np.int32)
    mesh.visual = trimesh.visual.ColorVisuals(
        mesh, vertex_colors=np.round(255 * colours).astype(np.uint8)
    )
