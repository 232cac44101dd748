# SPDX-License-Identifier: MIT
"""The parts of a mesh file, each with its name, in the file's own numbers; no part is trusted."""

import io
import json
import re
import stat
from pathlib import Path

import numpy as np
import trimesh

from sononerf.errors import InputError

FORMATS = ("stl", "ply", "obj", "off", "glb", "gltf")
"""Formats that trimesh reads by itself; others need further libraries, or hold no surface."""
IN_METRES = ("glb", "gltf")  # by their standard; the others state no unit
LARGEST_FILE = 1_000_000_000  # bytes
LARGEST_MESH = 20_000_000  # triangles
STL_HEADER = 84  # bytes, the last four of them the number of triangles
STL_TRIANGLE = 50  # bytes


def kind_of(path: str) -> str:
    """Return a file's format by the end of its name.

    Raises:
        InputError: If it is none that can be read, or no file at all.
    """
    kind = Path(path).suffix.lower().lstrip(".")
    if "://" in path or kind not in FORMATS:
        raise InputError(
            f"{path}: not a file that ends in .{', .'.join(FORMATS)}; convert it, e.g. to STL"
        )
    return kind


def read_parts(path: str) -> dict[str, trimesh.Trimesh]:
    """Read a mesh file and put its parts where its scene graph says.

    Args:
        path: STL, PLY, OBJ, OFF, GLB, or glTF that needs no other file.

    Returns:
        parts: By name, in the order of the file; vertices as they stand there, none merged. A part
            that stands in several places is one.

    Raises:
        InputError: If the file cannot be read, is damaged, too large, or holds no triangles; naming
            it.
    """
    kind = kind_of(path)
    data = _read(Path(path))
    if kind in CHECKS:
        CHECKS[kind](data, path)
    parts = _parse(data, kind, path)
    for name, part in parts.items():
        if part.vertices.shape[1:] != (3,):
            found = part.vertices.shape[1]
            raise InputError(
                f"{path}: damaged; vertices of {name} have {found} coordinates, expected 3"
            )
    faces = sum(len(part.faces) for part in parts.values())
    if faces == 0:
        raise InputError(f"{path}: holds no triangles")
    if kind == "ply":
        _check_ply(data, path, sum(len(part.vertices) for part in parts.values()), faces)
    if faces > LARGEST_MESH:
        raise InputError(f"{path}: {faces} triangles, at most {LARGEST_MESH}; thin it out")
    return parts


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


# Refuse what the parser would read as an empty or shortened mesh without a word.


def _check_stl(data: bytes, path: str) -> None:
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


def _check_off(data: bytes, path: str) -> None:
    lines = [words for line in data.splitlines() if (words := line.partition(b"#")[0].split())]
    if not lines or not re.fullmatch(rb"(ST)?C?N?OFF", lines[0][0]):
        raise InputError(f"{path}: no OFF file; it does not begin with OFF")
    counts, body = lines[0][1:], lines[1:]
    if not counts and body:  # on a line of their own
        counts, body = body[0], body[1:]
    if len(counts) < 2 or not all(word.isdigit() for word in counts[:2]):
        raise InputError(f"{path}: damaged OFF; it does not say how many vertices and faces it has")
    vertices, faces = int(counts[0]), int(counts[1])
    # A face is a number of corners, the corners, and perhaps a colour.
    whole = [
        words[0].isdigit() and len(words) > int(words[0]) > 2
        for words in body[vertices : vertices + faces]
    ]
    if sum(whole) != faces:
        raise InputError(
            f"{path}: damaged OFF; its header promises {faces} faces, {sum(whole)} can be read"
        )


def _check_gltf(data: bytes, path: str) -> None:
    try:
        buffers = json.loads(data)["buffers"]
        places = [str(buffer["uri"]) for buffer in buffers]
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        text = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: cannot be read as GLTF ({type(error).__name__}: {text})"
        ) from None
    for place in places:
        if not place.startswith("data:"):
            raise InputError(
                f"{path}: keeps its numbers in another file, {place[:80]!r}; save it as GLB"
            )


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


CHECKS = {"stl": _check_stl, "off": _check_off, "gltf": _check_gltf}


def _parse(data: bytes, kind: str, path: str) -> dict[str, trimesh.Trimesh]:
    more = {}
    if kind == "obj":  # by its o and g, not by colours
        more = {
            "split_objects": True,
            "split_groups": True,
            "group_material": False,
            "skip_materials": True,
        }
    try:
        found = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, **more)
        placed: dict[str, list[trimesh.Trimesh]] = {name: [] for name in found.geometry}
        for node in sorted(found.graph.nodes_geometry, key=str):
            transform, name = found.graph[node]
            shape = found.geometry[name]
            if isinstance(shape, trimesh.Trimesh):  # points and lines reflect nothing
                part = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
                placed[name].append(part.apply_transform(transform))
        return {name: trimesh.util.concatenate(them) for name, them in placed.items() if them}
    except Exception as error:  # the parsers raise whatever the bytes make them
        text = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: cannot be read as {kind.upper()} ({type(error).__name__}: {text})"
        ) from error


def stacked(parts: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return all vertices (V, 3), all triangles (T, 3), and which part each is of (T,)."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    vertices = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    faces = np.concatenate([np.asarray(p.faces) + n for p, n in zip(parts, first, strict=True)])
    return vertices, faces, np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
