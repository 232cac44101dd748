# SPDX-License-Identifier: MIT
"""Read the triangles of glTF 2.0, binary or text, and turn them from y up to z up.

Source: Khronos Group, "glTF 2.0 Specification", 2021.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sononerf.errors import InputError
from sononerf.numerics import Floats, Ints

Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the axes of glTF, where y is up, to the world's, where z is up."""
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
TRIANGLES, STRIP, FAN = 4, 5, 6
HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "EXT_texture_",
    "KHR_mesh_quantization",
)
"""Beginnings of the extensions that leave the surface as it is."""
DEEPEST = 100
"""Number of nodes above a node, at most; more is a circle."""


def read_gltf(data: bytes, *, binary: bool) -> tuple[Floats, Ints, Ints, tuple[str, ...]]:
    """Return vertices (V, 3), m, triangles (T, 3), the part of each (T,), and the parts' names.

    Raises:
        InputError: If it needs another file, or something that is not read here; by name.
    """
    document, chunk = _chunks(data) if binary else (json.loads(data), None)
    for name in map(str, document.get("extensionsRequired", [])):
        if not name.startswith(HARMLESS):
            raise _not_read(f"the extension {name[:80]}")
    buffers = [_buffer(one, chunk) for one in document.get("buffers", [])]
    vertices, faces, part, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [], 0
    names: dict[str, int] = {}
    for node, place in _nodes(document):
        if "skin" in node:
            raise _not_read("a skin")
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise _not_read("the extension EXT_mesh_gpu_instancing")
        if "mesh" not in node:
            continue
        mesh = document["meshes"][node["mesh"]]
        name = str(mesh.get("name", f"mesh_{node['mesh']}"))
        for primitive in mesh["primitives"]:
            if primitive.get("mode", TRIANGLES) < TRIANGLES:  # points and lines reflect nothing
                continue
            if any(node.get("weights") or mesh.get("weights") or []):
                raise _not_read("a morph target")
            own = _accessor(document, buffers, primitive["attributes"]["POSITION"])
            order = np.arange(len(own))
            if "indices" in primitive:
                order = _accessor(document, buffers, primitive["indices"]).astype(np.int64).ravel()
            if len(order) and order.max() >= len(own):
                raise InputError(f"damaged; {name} names vertex {order.max()}, it has {len(own)}")
            corners = _triangles(order, primitive.get("mode", TRIANGLES))
            if np.linalg.det(place[:3, :3]) < 0.0:  # mirrored
                corners = corners[:, ::-1]
            vertices.append((own @ place[:3, :3].T + place[:3, 3]) @ Z_UP.T)
            faces.append(corners + count)
            part += [names.setdefault(name, len(names))] * len(corners)
            count += len(own)
    return np.concatenate(vertices), np.concatenate(faces), np.array(part, np.int64), tuple(names)


def _not_read(what: str) -> InputError:
    return InputError(f"has {what}, which is not read; save it without, as plain triangles")


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """Return the document of a GLB and its binary chunk."""
    if data[:4] != b"glTF":
        raise InputError("no GLB; it does not begin with glTF")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"GLB of version {version}, expected 2")
    if length > len(data):
        raise InputError(f"damaged GLB; its header promises {length} bytes, it has {len(data)}")
    at = 12
    chunks: dict[bytes, bytes] = {}
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return json.loads(chunks[b"JSON"]), chunks.get(b"BIN\0")


def _buffer(buffer: dict[str, Any], chunk: bytes | None) -> bytes:
    place = buffer.get("uri")
    if place is None:
        content = chunk or b""
    elif str(place).startswith("data:"):
        try:
            content = base64.b64decode(str(place).partition(",")[2], validate=True)
        except binascii.Error as error:
            raise InputError(f"damaged; a buffer is no base64 ({error})") from None
    else:
        raise InputError(f"keeps its numbers in another file, {str(place)[:80]!r}; save it as GLB")
    if len(content) < buffer["byteLength"]:
        raise InputError(
            f"damaged; a buffer of {buffer['byteLength']} bytes has {len(content)} of them"
        )
    return content


def _accessor(document: dict[str, Any], buffers: list[bytes], number: int) -> NDArray[Any]:
    """Return the rows of an accessor (N, K), normalized ones as numbers from -1 to 1."""
    accessor = document["accessors"][number]
    code, count = np.dtype(TYPES[accessor["componentType"]]), int(accessor["count"])
    width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise _not_read("a sparse or compressed accessor")
    view = document["bufferViews"][accessor["bufferView"]]
    begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", code.itemsize * width)
    content = buffers[view["buffer"]]
    if begin + stride * (count - 1) + code.itemsize * width > len(content):
        raise InputError(f"damaged; an accessor of {count} rows reaches beyond its buffer")
    rows = np.ndarray((count, width), code, content, begin, (stride, code.itemsize))
    if accessor.get("normalized") and code.kind in "iu":
        return np.maximum(rows / np.iinfo(code).max, -1.0)
    return rows.astype(np.float64) if width == 3 else rows


def _nodes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Floats]]:
    """Yield the nodes of the scene that is shown, each with its place in the world (4, 4)."""
    nodes, scenes = document.get("nodes", []), document.get("scenes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in children]
    if scenes:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    pending = [(number, np.eye(4), 0) for number in reversed(roots)]
    while pending:
        number, above, depth = pending.pop()
        if depth > DEEPEST:
            raise InputError(f"has more than {DEEPEST} nodes above one another")
        node = nodes[number]
        place = above @ _transform(node)
        yield node, place
        pending += [(child, place, depth + 1) for child in reversed(node.get("children", []))]


def _transform(node: dict[str, Any]) -> Floats:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    place = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    place[:3, :3] = turn * np.array(node.get("scale", [1.0, 1.0, 1.0]), dtype=np.float64)
    place[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return place


def _triangles(order: Ints, mode: int) -> Ints:
    """Return the triangles (T, 3) of a list of vertices, as the mode of a primitive says."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if mode == STRIP:
        return strip_triangles(order)
    corners = order[np.arange(max(len(order) - 2, 0))[:, None] + np.arange(3)]
    corners[:, 0] = order[:1]
    return corners


def strip_triangles(order: Ints) -> Ints:
    """Return the triangles (T, 3) of a strip, without those that have a corner twice."""
    order = np.asarray(order, dtype=np.int64)
    corners = order[np.arange(max(len(order) - 2, 0))[:, None] + np.arange(3)]
    corners[1::2] = corners[1::2, ::-1]
    return corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
