# SPDX-License-Identifier: MIT
"""Read the surface of a mesh file, in the file's own numbers; no part of it is trusted.

Each format is read here: the libraries that read them all leave out polygons, take cut files for
whole ones, or end the process on the bytes of a stranger.
"""

from __future__ import annotations

import codecs
import re
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.numerics import Floats, Ints
from sononerf.scene.gltf import read_gltf, strip_triangles
from sononerf.storage import name_by_content, wrong_kind

LARGEST_FILE = 1_000_000_000  # bytes
LARGEST_MESH = 20_000_000  # triangles
IN_METRES = ("glb", "gltf")  # by their standard; the others state no unit
STL_HEADER = 84  # bytes, the last four of them the number of triangles
STL_TRIANGLE = 50  # bytes
MAX_AREA_ERROR = 1e-2
"""Difference between a concave polygon's area and that of its triangles, over the former, above
which it is said. Corners that are a little off a plane make less."""
_LINE = re.compile(r"\r\n|\r|\n")


@dataclass(frozen=True)
class MeshFile:
    """The surface of a file, cut into triangles.

    Attributes:
        vertices (V, 3): In the unit of the file; z is up.
        faces (T, 3): Indices of vertices.
        part (T,): Index of each triangle's part.
        names: Names of the parts: geometries of GLB and glTF, objects and groups of OBJ, solids of
            text STL; one for the others.
        fault: What is wrong with its polygons, one line; empty if nothing is.
    """

    vertices: Floats
    faces: Ints
    part: Ints
    names: Sequence[str]
    fault: str = ""


@dataclass(frozen=True)
class Polygons:
    """Polygons as a file states them."""

    vertices: Floats | list[list[float]]
    sizes: Ints | list[int]  # (P,): Number of corners of each polygon
    corners: Ints | list[int]  # Indices of vertices, polygon after polygon
    part: Ints | list[int] | None = None  # (P,)
    names: Sequence[str] = ("mesh",)


def kind_of(path: Path | str) -> str:
    """Return a file's format by the end of its name.

    Raises:
        InputError: If it is none that can be read.
    """
    kind = Path(path).suffix.lower().lstrip(".")
    if "://" in str(path) or kind not in READERS:
        endings = ", .".join(READERS)
        raise InputError(f"{path}: not a file that ends in .{endings}; convert it, e.g. to STL")
    return kind


def read_mesh(path: Path | str) -> MeshFile:
    """Read a mesh file, and put its parts where its scene graph says.

    Args:
        path: STL, PLY, OBJ, OFF, GLB, or glTF that needs no other file.

    Raises:
        InputError: If the file cannot be read, is damaged, too large, or holds no triangles; naming
            it.
    """
    kind = kind_of(path)
    data = _read(Path(path))
    try:
        stated = READERS[kind](data)
    except Exception as error:  # whatever the bytes of a stranger lead to
        if name_by_content(Path(path)):
            raise wrong_kind(Path(path), f"{kind.upper()} file") from None
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from None
        text = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: cannot be read as {kind.upper()} ({type(error).__name__}: {text})"
        ) from error
    vertices = np.asarray(stated.vertices, dtype=np.float64).reshape(-1, 3)
    sizes = np.asarray(stated.sizes, dtype=np.int64)
    corners = np.asarray(stated.corners, dtype=np.int64)
    if not (sizes > 2).any():
        raise InputError(f"{path}: holds no triangles")
    if (wrong := (corners < 0) | (corners >= len(vertices))).any():
        at = int(wrong.argmax())
        raise InputError(
            f"{path}: damaged {kind.upper()}; face {np.cumsum(sizes).searchsorted(at, 'right') + 1}"
            f" names a vertex that is none of its {len(vertices)}"
        )
    if len(corners) > 3 * LARGEST_MESH:
        raise InputError(f"{path}: more than {LARGEST_MESH} triangles; thin it out")
    faces, polygon, crossed = triangles(vertices, sizes, corners)
    fault = f"{crossed} polygons cross themselves; cut them into triangles" if crossed else ""
    used, index = np.unique(faces, return_inverse=True)
    part = np.zeros(len(sizes), np.int64) if stated.part is None else np.asarray(stated.part)
    return MeshFile(vertices[used], index.reshape(-1, 3), part[polygon], stated.names, fault)


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


def triangles(vertices: Floats, sizes: Ints, corners: Ints) -> tuple[Ints, Ints, int]:
    """Cut polygons into triangles: convex ones as fans, the others by ears.

    In: vertices (V, 3), sizes (P,), corners (sum of sizes,). Out: triangles (T, 3), the polygon of
    each (T,), and the number of polygons whose triangles have another area.
    """
    begin = np.cumsum(sizes) - sizes
    faces, polygon, crossed = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)], 0
    for size in np.unique(sizes[sizes > 2]):
        some = np.flatnonzero(sizes == size)
        index = corners[begin[some, None] + np.arange(size)]
        place = vertices[index]
        spokes = place - place[:, :1]
        normal = np.cross(spokes, np.roll(spokes, -1, axis=1)).sum(axis=1)
        ahead = np.roll(place, -1, axis=1) - place
        turn = np.einsum("pnk,pk->pn", np.cross(np.roll(ahead, 1, axis=1), ahead), normal)
        square = (normal**2).sum(axis=1)
        concave = (turn < -1e-9 * square[:, None]).any(axis=1) & (size > 3)
        fan = np.column_stack([np.zeros(size - 2, int), np.arange(1, size - 1), np.arange(2, size)])
        faces.append(index[~concave][:, fan].reshape(-1, 3))
        polygon.append(np.repeat(some[~concave], size - 2))
        for row in np.flatnonzero(concave):
            flat = np.delete(place[row], np.abs(normal[row]).argmax(), axis=1)
            cut = mapbox_earcut.triangulate_float64(flat, np.array([size], np.uint32))
            cut = cut.reshape(-1, 3).astype(np.int64)
            side = place[row][cut]
            outward = np.cross(side[:, 1] - side[:, 0], side[:, 2] - side[:, 0])
            if (outward @ normal[row]).sum() < 0.0:
                cut = cut[:, ::-1]
            area = np.linalg.norm(outward, axis=1).sum()
            crossed += abs(area**2 / square[row] - 1.0) > 2.0 * MAX_AREA_ERROR
            faces.append(index[row][cut])
            polygon.append(np.full(len(cut), some[row]))
    number = np.concatenate(polygon)
    order = np.argsort(number, kind="stable")
    return np.concatenate(faces)[order], number[order], crossed


def _numbers(words: Sequence[str], line: int) -> list[float]:
    """Return words as numbers; the one that is none is named with its line."""
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            raise InputError(
                f"line {line}: {word[:80]!r} is no number; decimals have a point, exponents an e"
            ) from None
    return numbers


def _text(data: bytes) -> str:
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if wide else "utf-8-sig", errors="replace")


def _read_obj(data: bytes) -> Polygons:
    """Read OBJ. An index below zero counts back from the line that it stands on."""
    vertices: list[list[float]] = []
    sizes, corners, part = [], [], []
    names: dict[str, int] = {}
    of, group, line = "", "", ""
    for number, more in enumerate(_LINE.split(_text(data)), start=1):
        line += more.partition("#")[0].strip()
        if line.endswith("\\"):
            line = line[:-1] + " "
            continue
        key, *words = line.split() or [""]
        line = ""
        if key == "v":
            if len(words) < 3:
                raise InputError(
                    f"line {number}: a vertex has {len(words)} coordinates, expected 3"
                )
            vertices.append(_numbers(words[:3], number))
        elif key in ("f", "fo"):
            indices = [word.partition("/")[0] for word in words]
            if not all(re.fullmatch(r"[+-]?\d+", index) and int(index) for index in indices):
                raise InputError(
                    f"line {number}: expected indices of vertices, from 1 on, found "
                    f"{' '.join(words)[:80]!r}"
                )
            corners += [int(i) - 1 if int(i) > 0 else len(vertices) + int(i) for i in indices]
            sizes.append(len(indices))
            name = "_".join(filter(None, (of, group))) or "mesh"
            part.append(names.setdefault(name, len(names)))
        elif key == "o":
            of, group = " ".join(words), ""
        elif key == "g":
            group = " ".join(words)
    return Polygons(vertices, sizes, corners, part, tuple(names))


def _read_off(data: bytes) -> Polygons:
    """Read OFF; what stands behind the coordinates and the corners, such as colours, is left."""
    lines = [
        (number, words)
        for number, line in enumerate(_LINE.split(_text(data)), start=1)
        if (words := line.partition("#")[0].split())
    ]
    if lines and re.match(r"\w*(4|n)\w*OFF|\w*OFF BINARY", " ".join(lines[0][1])):
        raise InputError(
            f"OFF of the kind {' '.join(lines[0][1][:2])[:20]!r}, which is not read; save it as "
            "text with three coordinates"
        )
    word = re.fullmatch(r"(?:ST)?C?N?OFF(\d*)|()\d+", lines[0][1][0]) if lines else None
    if not word:
        raise InputError("no OFF file; it does not begin with OFF")
    counts = lines[0][1] if word[2] is not None else [*filter(None, [word[1]]), *lines[0][1][1:]]
    body = lines[1:]
    if not counts and body:  # on a line of their own
        counts, body = body[0][1], body[1:]
    if len(counts) < 2 or not all(count.isdigit() for count in counts[:2]):
        raise InputError("damaged OFF; it does not say how many vertices and faces it has")
    count, faces = int(counts[0]), int(counts[1])
    vertices = [_numbers(words[:3], number) for number, words in body[:count]]
    for (number, _), vertex in zip(body, vertices, strict=False):
        if len(vertex) < 3:
            raise InputError(f"line {number}: a vertex has {len(vertex)} coordinates, expected 3")
    whole = [
        [int(corner) for corner in words[1 : 1 + int(words[0])]]
        for _, words in body[count : count + faces]
        if words[0].isdigit() and len(words) > int(words[0]) > 2
    ]
    if len(whole) != faces:
        raise InputError(
            f"damaged OFF; its header promises {faces} faces, {len(whole)} can be read"
        )
    return Polygons(vertices, [len(face) for face in whole], [at for face in whole for at in face])


_SOLID = re.compile(
    r"\bsolid\b(.*?)(?=\bfacet\s+normal\b|\bendsolid\b)(.*?)\bendsolid\b", re.I | re.S
)
_VERTEX = re.compile(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.I)


def _read_stl(data: bytes) -> Polygons:
    """Read STL, binary or text. A name may hold any word, and a binary header too."""
    count = int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")
    lower = data.lower()
    if len(data) != STL_HEADER + STL_TRIANGLE * count and b"vertex" in lower and b"solid" in lower:
        return _read_text_stl(_text(data))
    if len(data) < STL_HEADER:
        raise InputError(f"no STL, only {len(data)} bytes")
    if len(data) != STL_HEADER + STL_TRIANGLE * count:
        raise InputError(
            f"damaged STL; its header promises {count} triangles, its {len(data)} bytes "
            f"hold {(len(data) - STL_HEADER) / STL_TRIANGLE:g}"
        )
    if count == 0:
        raise InputError("STL without triangles")
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(data, record, offset=STL_HEADER)["corners"]
    return Polygons(corners.reshape(-1, 3), np.full(count, 3), np.arange(3 * count))


def _read_text_stl(text: str) -> Polygons:
    vertices: list[list[float]] = []
    part: list[int] = []
    names: dict[str, int] = {}
    end = 0
    for solid in _SOLID.finditer(text):
        end = solid.end()
        corners = list(_VERTEX.finditer(text, *solid.span(2)))
        facets = len(re.findall(r"\bfacet\s+normal\b", solid[2], re.I))
        ends = len(re.findall(r"\bend\s*facet\b", solid[2], re.I))
        if not len(corners) == 3 * facets == 3 * ends:
            raise InputError("text STL that breaks off, or a facet without three corners")
        for corner in corners:
            try:
                vertices.append([float(word) for word in corner.groups()])
            except ValueError:
                _numbers(corner.groups(), len(_LINE.findall(text, 0, corner.start())) + 1)
        name = " ".join(solid[1].split()) or "solid"
        part += [names.setdefault(name, len(names))] * facets
    if not end or re.search(r"\bfacet\s+normal\b", text[end:], re.I):
        raise InputError("text STL that breaks off; save it again")
    count = len(part)
    return Polygons(vertices, np.full(count, 3), np.arange(3 * count), part, tuple(names))


_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_OLD = "char uchar short ushort int uint float double".split()
_NEW = "int8 uint8 int16 uint16 int32 uint32 float32 float64".split()
PLY_TYPES = dict(zip((*_OLD, *_NEW), 2 * _CODES, strict=True))
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def _read_ply(data: bytes) -> Polygons:
    """Read PLY: vertices, and faces or strips of triangles; text is turned into numbers first."""
    header = re.match(rb"ply\s.*?\bend_header[ \t]*(\r\n|\r|\n)", data, re.S)
    if not header:
        raise InputError("damaged PLY; it has no header")
    end = header.end()
    lines = [line.split() for line in _LINE.split(header[0].decode("latin-1"))]
    form = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    if form not in PLY_ORDERS:
        raise InputError(f"damaged PLY; its format is {form!r}, expected {', '.join(PLY_ORDERS)}")
    if header[1] == b"\r\n" and header[0].count(b"\r\n") < header[0].count(b"\r"):
        end -= 1  # lines end in \r alone, and the \n is a number
    body, order = data[end:], PLY_ORDERS[form]
    if form == "ascii":
        try:
            body = np.array(_text(body).split(), dtype=np.float64).tobytes()
        except ValueError:
            for number, line in enumerate(_LINE.split(_text(body)), start=len(lines)):
                _numbers(line.split(), number)
    elements: list[tuple[str, int, list[tuple[str, str, str]]]] = []
    for key, *words in filter(None, lines):
        if key == "element":
            elements.append((words[0], int(words[1]), []))
        elif key == "property":
            types = [
                order + ("f8" if form == "ascii" else PLY_TYPES[word])
                for word in words[:-1]
                if word != "list"
            ]
            elements[-1][2].append((words[-1], types[0] if len(types) == 2 else "", types[-1]))
    at = 0
    columns: dict[str, _Columns] = {}
    for name, count, properties in elements:
        columns[name], at = _ply_rows(body, at, name, count, properties)
    places = columns.get("vertex", {})
    if not {"x", "y", "z"} <= set(places):
        raise InputError(
            f"PLY whose vertices have no x, y and z but {', '.join(places) or 'nothing'}"
        )
    vertices = np.column_stack([places[axis][1] for axis in "xyz"])
    if strips := columns.get("tristrips", {}).get("vertex_indices"):
        corners = np.concatenate(
            [
                strip_triangles(strip[strip >= 0])
                for strip in np.split(strips[1], np.flatnonzero(strips[1] < 0))
            ]
        )
        return Polygons(vertices, np.full(len(corners), 3), corners.reshape(-1))
    faces = columns.get("face", {})
    sizes, corners = faces.get("vertex_indices") or faces.get("vertex_index") or _NO_FACES
    return Polygons(vertices, sizes, corners)


_Columns = dict[str, tuple[Ints, NDArray[Any]]]
"""Columns of an element by name: how many numbers each row has (R,), and all numbers in a row."""
_NO_FACES = (np.zeros(0, np.int64), np.zeros(0, np.int64))


def _ply_rows(
    body: bytes, at: int, element: str, count: int, properties: list[tuple[str, str, str]]
) -> tuple[_Columns, int]:
    """Read the rows of an element; return its columns, and where the next element begins.

    In: properties (name, type of the number of items of a list or empty, type of the items).
    """
    done = 0

    def take(code: str, number: int) -> NDArray[Any]:
        nonlocal at
        size = np.dtype(code).itemsize * number
        if not 0 <= size <= len(body) - at:
            raise InputError(
                f"damaged PLY; its header promises {count} of {element}, {done} can be read"
            )
        at += size
        return np.frombuffer(body, code, number, at - size)

    def row() -> list[NDArray[Any]]:
        return [take(code, int(take(size, 1)[0]) if size else 1) for _, size, code in properties]

    if not count:
        return {}, at
    begin = at
    lengths = [len(values) for values in row()]
    record = np.dtype(
        [
            field
            for n, (_, size, code) in enumerate(properties)
            for field in ([(f"{n}#", size)] if size else []) + [(str(n), code, (lengths[n],))]
        ]
    )
    at = begin
    if record.itemsize * count <= len(body) - at:
        table = np.frombuffer(body, record, count, at)
        if all((table[f"{n}#"] == lengths[n]).all() for n, one in enumerate(properties) if one[1]):
            columns = {
                name: (np.full(count, lengths[n]), table[str(n)].reshape(-1))
                for n, (name, _, _) in enumerate(properties)
            }
            return columns, at + table.nbytes
    rows = []
    for done in range(count):  # noqa: B007  # also told where the file breaks off
        rows.append(row())
    return {
        name: (np.array([len(one[n]) for one in rows]), np.concatenate([one[n] for one in rows]))
        for n, (name, _, _) in enumerate(properties)
    }, at


READERS: dict[str, Callable[[bytes], Polygons]] = {
    "stl": _read_stl,
    "ply": _read_ply,
    "obj": _read_obj,
    "off": _read_off,
    "glb": lambda data: _of_gltf(data, binary=True),
    "gltf": lambda data: _of_gltf(data, binary=False),
}


def _of_gltf(data: bytes, *, binary: bool) -> Polygons:
    vertices, faces, part, names = read_gltf(data, binary=binary)
    return Polygons(vertices, np.full(len(faces), 3), faces.reshape(-1), part, names)
