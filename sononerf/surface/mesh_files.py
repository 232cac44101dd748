# SPDX-License-Identifier: MIT
"""Mesh files, with the number of poses that heard each vertex, and its error."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.numerics import Floats

MeshFormat = Literal["ply", "stl", "glb"]


def mesh_bytes(
    mesh: trimesh.Trimesh,
    file_type: MeshFormat,
    *,
    confidence: ArrayLike | None = None,
    error: ArrayLike | None = None,
) -> bytes:
    """Return a mesh as the bytes of a file; the same mesh gives the same bytes.

    With a confidence PLY and GLB carry a colour per vertex: from dark grey, heard by no pose, to
    bright yellow, heard by a hundred or more, in steps even to the eye over the logarithm (see
    :func:`~sononerf.surface.mesh_files.confidence_colours`). PLY also holds the numbers
    themselves, as the vertices' property ``poses``, their error (m) as the property ``error``, and
    always their normals. STL knows none of them.

    In: confidence (V,), error ((V,), m).
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
    if error is not None and file_type == "ply":
        bare.vertex_attributes["error"] = np.asarray(error, dtype=np.float32)
    options = {"vertex_normal": True} if file_type == "ply" else {}
    return bytes(bare.export(file_type=file_type, **options))


def _carry(mesh: trimesh.Trimesh, file_type: MeshFormat, poses: NDArray[Any]) -> None:
    """Colour a mesh by its confidence, in place, if the format has colours."""
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


def confidence_of(mesh: trimesh.Trimesh) -> NDArray[np.int32] | None:
    """Return how many poses heard each vertex (V,) of a mesh that was read from a PLY file.

    None where the file does not say.
    """
    found = _property(mesh, "poses")
    return None if found is None else found.astype(np.int32)


def error_of(mesh: trimesh.Trimesh) -> NDArray[np.float32] | None:
    """Return the error ((V,), m) of each vertex of a mesh that was read from a PLY file.

    None where the file does not say.
    """
    found = _property(mesh, "error")
    return None if found is None else found.astype(np.float32)


def _property(mesh: trimesh.Trimesh, name: str) -> NDArray[Any] | None:
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    if raw is None or name not in (raw.dtype.names or ()) or len(raw) != len(mesh.vertices):
        return None
    return np.asarray(raw[name])


# Number of poses from which on the colour is the brightest.
MANY_POSES = 100
# Dark grey and bright yellow in OKLab; on the line between the two, equal steps look equal.
FEW_COLOUR, MANY_COLOUR = (0.34, 0.0, -0.01), (0.93, -0.02, 0.15)


def confidence_colours(poses: ArrayLike) -> Floats:
    """Colour numbers of poses: dark grey for none, bright yellow for a hundred and more.

    Steps are even to the eye (a straight line in OKLab [1]_) over the logarithm of one plus the
    number, and the ends are the same for every mesh, so that pictures can be compared.

    In: poses (N,). Out: colours (N, 3).

    References:
        .. [1] B. Ottosson, "A perceptual color space for image processing", 2020.
    """
    counts = np.asarray(poses, dtype=np.float64)
    share = np.clip(np.log1p(counts) / np.log1p(MANY_POSES), 0, 1)[..., None]
    few, many = np.asarray(FEW_COLOUR), np.asarray(MANY_COLOUR)
    lightness, a, b = np.moveaxis(few + share * (many - few), -1, 0)
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    linear = np.stack(
        [
            4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
            -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
            -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
        ],
        axis=-1,
    ).clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_light(colours: ArrayLike) -> Floats:
    """Turn sRGB colours (..., 3), 0 to 1, into linear light, as glTF has them."""
    given = np.asarray(colours, dtype=np.float64)
    return np.where(given <= 0.04045, given / 12.92, ((given + 0.055) / 1.055) ** 2.4)
