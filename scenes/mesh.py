# SPDX-License-Identifier: MIT
"""Any surface from a file: STL, PLY, OBJ or GLB."""

from __future__ import annotations

import io
import stat
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from sononerf.errors import InputError
from sononerf.scene import MATERIALS, MaterialName, Scene, check_surface

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
FORMATS = ("stl", "ply", "obj", "glb")
LARGEST_FILE = 1_000_000_000  # bytes
LARGEST_MESH = 20_000_000  # triangles
STL_HEADER = 84  # bytes, the last four of them the number of triangles
STL_TRIANGLE = 50  # bytes


def mesh(
    path: str,
    unit: Literal["m", "cm", "mm"] | None = None,
    centre: bool = True,
    material: MaterialName = "rigid",
) -> Scene:
    """Load a surface from a file.

    Parameters
    ----------
    path : str
        STL, PLY, OBJ or GLB; relative to the working directory.
    unit : {"m", "cm", "mm"}, optional
        Of the file's numbers. GLB is in metres by its standard; the others say nothing, so it
        must be given.
    centre : bool
        Move the middle of the bounding box to the origin, at which poses look.
    material : {"rigid", "sonotracelab", "leaf", "insect"}
        Of all of it.

    Returns
    -------
    scene : Scene
        Metres.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged, or holds no surface; naming it.
    """
    file = Path(path)
    kind = file.suffix.lower().lstrip(".")
    if "://" in path or kind not in FORMATS:
        raise InputError(
            f"{path}: not a file that ends in .{', .'.join(FORMATS)}; convert it, e.g. to STL"
        )
    if unit is None:
        if kind != "glb":
            raise InputError(
                f"{path}: {kind.upper()} states no unit; set scene.options.unit to m, cm or mm"
            )
        unit = "m"
    data = _read(file)
    if kind == "stl":
        _check_stl(data, path)
    loaded = _parse(data, kind, path)
    vertices = np.asarray(loaded.vertices, dtype=np.float64) * METRES[unit]
    faces = np.asarray(loaded.faces)
    if kind == "ply":
        _check_ply(data, path, len(vertices), len(faces))
    if len(faces) > LARGEST_MESH:
        raise InputError(f"{path}: {len(faces)} triangles, at most {LARGEST_MESH}; thin it out")
    try:
        # Before vertices are merged: that would drop those that are no numbers without a word.
        check_surface(trimesh.Trimesh(vertices, faces, process=False, validate=False))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if centre:
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    return Scene(trimesh.Trimesh(vertices, faces), MATERIALS[material])


def _read(file: Path) -> bytes:
    try:
        status = file.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{file}: not a regular file")
        if status.st_size > LARGEST_FILE:
            raise InputError(f"{file}: {status.st_size} bytes, at most {LARGEST_FILE}")
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    if not data:
        raise InputError(f"{file}: empty")
    return data


def _check_stl(data: bytes, path: str) -> None:
    """Refuse what the parser would read as an empty or shortened mesh without a word."""
    text = data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:2000]
    if text:
        words = data.lower().split()
        if words.count(b"vertex") != 3 * words.count(b"endfacet") or b"endsolid" not in words:
            raise InputError(f"{path}: text STL that breaks off; save it again")
        return
    if len(data) < STL_HEADER:
        raise InputError(f"{path}: no STL, only {len(data)} bytes")
    count = int.from_bytes(data[80:STL_HEADER], "little")
    if len(data) != STL_HEADER + STL_TRIANGLE * count:
        raise InputError(
            f"{path}: damaged STL; its header promises {count} triangles, its {len(data)} bytes "
            f"hold {(len(data) - STL_HEADER) / STL_TRIANGLE:g}"
        )
    if count == 0:
        raise InputError(f"{path}: STL without triangles")


def _check_ply(data: bytes, path: str, vertices: int, faces: int) -> None:
    for line in data[:10_000].split(b"end_header")[0].splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit():
            found = {b"vertex": vertices, b"face": faces}.get(words[1])
            if found is not None and found < int(words[2]):
                raise InputError(
                    f"{path}: damaged PLY; its header promises {int(words[2])} of "
                    f"{words[1].decode()}, {found} can be read"
                )


def _parse(data: bytes, kind: str, path: str) -> trimesh.Trimesh:
    try:
        found = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False).to_mesh()
    except Exception as error:  # the parsers raise whatever the bytes make them
        text = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: cannot be read as {kind.upper()} ({type(error).__name__}: {text})"
        ) from error
    if len(found.faces) == 0:
        raise InputError(f"{path}: holds no triangles")
    return found
