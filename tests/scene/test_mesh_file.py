# SPDX-License-Identifier: MIT
"""Files as other programs write them, each with the surface that it holds."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.run.build import read_truth
from sononerf.scene.mesh_file import read_mesh
from sononerf.start.surface import Surface

CORNERS = [(x, y, z) for z in (0, 20) for x, y in ((0, 0), (20, 0), (20, 20), (0, 20))]
SIDES = [(4, 3, 2, 1), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)]
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    "f {} {} {} {}\n".format(*side) for side in SIDES
)
THREE = [tuple(side[k] - 1 for k in part) for side in SIDES for part in ((0, 1, 2), (0, 2, 3))]
STL = "solid cube\n" + "".join(
    "facet normal 0 0 0\nouter loop\n"
    + "".join("vertex {} {} {}\n".format(*CORNERS[corner]) for corner in face)
    + "endloop\nendfacet\n"
    for face in THREE
)
STL += "endsolid cube\n"
# The outline of a C, its mouth between (20, 20) and (60, 40)
MOUTH = [(0, 0), (60, 0), (60, 20), (20, 20), (20, 40), (60, 40), (60, 60), (0, 60)]
MOUTH_AREA, MOUTH_VOLUME = 15200.0, 84000.0


def read(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_mesh(path)


def surface(file):
    return trimesh.Trimesh(file.vertices, file.faces)


def is_the_cube(file):
    mesh = surface(file)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(8000)
    assert mesh.area == pytest.approx(2400)
    assert len(file.faces) == 12
    assert not file.fault


def interleaved(kind):
    """Three cubes, each with its own vertices before its faces, counted back from there."""
    text = ""
    for number in range(3):
        text += f"{kind} part{number}\n" if kind else ""
        text += "".join(f"v {x + 40 * number} {y} {z}\n" for x, y, z in CORNERS)
        text += "".join(f"f {' '.join(str(k - 9) for k in side)}\n" for side in SIDES)
    return text


@pytest.mark.parametrize(
    "text",
    [
        OBJ,
        OBJ.replace(" ", "\t"),
        OBJ.replace("\n", "\r\n"),
        OBJ.replace("\n", "\r"),
        "\ufeff" + OBJ,
        "  " + OBJ.replace("\n", " # made by hand\n  "),
        OBJ.replace("f 4 3", "f 4 \\\n 3"),
        OBJ.replace("v 20 0 0", "v 20 \\\n0 0 1.0"),
        OBJ.replace("f ", "fo "),
        OBJ.replace("20", "2.0e+1"),
        "".join(OBJ.splitlines(True)[8:] + OBJ.splitlines(True)[:8]),
        OBJ.replace("f 4 3 2 1", "vn 0 0 1\nf 4//1 3//1 2//1 1//1"),
        OBJ + "p 1\nl 1 2\ns off\nusemtl a\n",
    ],
)
def test_an_obj_as_others_write_it_is_read(tmp_path, text):
    is_the_cube(read(tmp_path, "a.obj", text))


@pytest.mark.parametrize(("kind", "parts"), [("", 1), ("o", 3), ("g", 3), ("usemtl", 1)])
def test_an_index_of_obj_counts_back_from_its_own_line(tmp_path, kind, parts):
    file = read(tmp_path, "a.obj", interleaved(kind))
    assert surface(file).volume == pytest.approx(24000)
    assert surface(file).extents == pytest.approx([100, 20, 20])
    assert len(file.names) == parts
    np.testing.assert_array_equal(np.bincount(file.part), [36 // parts] * parts)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.obj", OBJ.replace("v 20 0 0", "v 20,5 0 0"), "line 2: '20,5' is no number"),
        ("a.obj", OBJ.replace("v 20 0 0", "v 2.0D+1 0 0"), "line 2: '2.0D.1' is no number"),
        ("a.obj", OBJ.replace("f 4 3", "f 0 3"), "line 9: .* from 1 on, found '0 3 2 1'"),
        ("a.obj", OBJ.replace("f 4 3", "f 9 3"), "face 1 names a vertex that is none of its 8"),
        ("a.obj", OBJ.replace("f 4 3", "f -9 3"), "face 1 names a vertex that is none of its 8"),
        ("a.stl", STL.replace("vertex 20 20 0", "vertex 20 20,5 0"), "line .*'20,5' is no number"),
        ("a.stl", STL[:-20], "breaks off"),
        ("a.stl", "version https://git-lfs.github.com/spec/v1\n", "it is a pointer of Git LFS"),
        ("a.stl", "<!DOCTYPE html><html>solid vertex", "it is a web page"),
        ("a.off", "4OFF\n1 1 0\n", "of the kind '4OFF'"),
        ("a.off", "OFF BINARY\n1 1 0\n", "of the kind 'OFF BINARY'"),
        ("a.stl", STL.replace("endloop\nendfacet\nendsolid", "endsolid"), "breaks off"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(tmp_path, name, text, words):
    with pytest.raises(InputError, match=words):
        read(tmp_path, name, text)


def prism(outline, height=30):
    """Return vertices, and faces that are whole polygons."""
    count = len(outline)
    places = [(x, y, z) for z in (0, height) for x, y in outline]
    walls = [(k, (k + 1) % count, (k + 1) % count + count, k + count) for k in range(count)]
    return places, [tuple(range(count))[::-1], tuple(range(count, 2 * count)), *walls]


def as_off(places, faces):
    text = "".join(f"{' '.join(map(str, place))}\n" for place in places)
    text += "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces)
    return f"OFF\n{len(places)} {len(faces)} 0\n{text}"


def as_obj(places, faces):
    text = "".join(f"v {' '.join(map(str, place))}\n" for place in places)
    return text + "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)


def as_ply(places, faces, order="<", size="B", index="i", *, tail=b""):
    """Return a binary PLY: big or little endian, its lists of any type, mixed polygons."""
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    names = {"B": "uchar", "H": "ushort", "i": "int", "I": "uint"}
    head = (
        f"ply\nformat {form} 1.0\ncomment made\nelement vertex {len(places)}\nproperty float x\n"
        "property float y\nproperty uchar red\nproperty float z\n"
        f"element face {len(faces)}\nproperty list {names[size]} {names[index]} vertex_indices\n"
        "property uchar flag\nend_header\n"
    )
    body = b"".join(struct.pack(f"{order}ffBf", x, y, 9, z) for x, y, z in places)
    for face in faces:
        body += struct.pack(f"{order}{size}{len(face)}{index}B", len(face), *face, 7)
    return head.encode() + body + tail


def as_text_ply(places, faces):
    text = "".join(f"{' '.join(map(str, place))}\n" for place in places)
    text += "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces)
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(places)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_index\n"
        f"end_header\n{text}"
    )


WRITERS = {"a.off": as_off, "a.obj": as_obj, "a.ply": as_ply, "text.ply": as_text_ply}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("turn", [0, 3])
def test_a_concave_polygon_keeps_its_mouth(tmp_path, name, turn):
    outline = MOUTH[turn:] + MOUTH[:turn]
    file = read(tmp_path, name, WRITERS[name](*prism(outline)))
    mesh = surface(file)
    assert mesh.is_watertight
    assert mesh.area == pytest.approx(MOUTH_AREA)
    assert mesh.volume == pytest.approx(MOUTH_VOLUME)
    assert not file.fault
    hits = mesh.ray.intersects_location([[40.0, 30.0, 100.0]], [[0.0, 0.0, -1.0]])[0]
    assert not len(hits)


def test_a_hole_that_a_slit_leads_to_stays_open(tmp_path):
    ring = [(0, 0), (9, 0), (9, 9), (0, 9), (0, 0), (3, 3), (3, 6), (6, 6), (6, 3), (3, 3)]
    file = read(tmp_path, "a.obj", as_obj([(x, y, 0) for x, y in ring], [range(len(ring))]))
    assert surface(file).area == pytest.approx(72)


def test_a_polygon_that_crosses_itself_is_told(tmp_path):
    bow = [(0, 0, 0), (4, 4, 0), (4, 0, 0), (0, 5, 0)]
    assert "1 polygons cross themselves" in read(tmp_path, "a.obj", as_obj(bow, [range(4)])).fault


CUBE = (CORNERS, [tuple(k - 1 for k in side) for side in SIDES])
MIXED = (CORNERS, [*CUBE[1][:3], *THREE[6:]])


@pytest.mark.parametrize(
    "data",
    [
        as_ply(*CUBE),
        as_ply(*MIXED),
        as_ply(CORNERS, MIXED[1][::-1]),
        as_ply(*MIXED, order=">", size="H", index="I"),
        as_ply(*CUBE, order=">", size="i"),
        as_ply(*MIXED, tail=b"more"),
        as_text_ply(*MIXED),
        as_text_ply(*CUBE).replace("\n", "\r\n"),
        as_text_ply(*CUBE).replace("\n", "\r"),
    ],
)
def test_a_ply_as_others_write_it_is_read(tmp_path, data):
    is_the_cube(read(tmp_path, "a.ply", data))


def test_strips_of_triangles_are_read(tmp_path):
    places = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (5, 5, 5), (6, 5, 5), (5, 6, 5)]
    text = as_text_ply(places, [(0, 1, 2, 3, -1, 4, 5, 6)]).replace(
        "element face", "element tristrips"
    )
    mesh = surface(read(tmp_path, "a.ply", text.replace("vertex_index", "vertex_indices")))
    assert len(mesh.faces) == 3
    assert (mesh.face_normals[:, 2] > 0.9).all()


@pytest.mark.parametrize("cut", [1, 5, 30])
def test_a_ply_that_is_cut_off_says_what_it_holds(tmp_path, cut):
    for data in (as_ply(*MIXED), as_ply(*CUBE)):
        with pytest.raises(InputError, match=r"promises \d+ of face, \d+ can be read"):
            read(tmp_path, "a.ply", data[:-cut])


@pytest.mark.parametrize(
    "text",
    [
        STL,
        STL.upper(),
        "\ufeff" + STL,
        "# by hand\n" + STL,
        STL.replace("\n", "\r"),
        STL.replace("\n", " "),
        STL.replace("cube", "x" * 3000),
        STL.replace("cube", "a vertex endfacet facet"),
        STL.replace("endloop", "end loop").replace("endfacet", "end facet"),
    ],
)
def test_a_text_stl_as_others_write_it_is_read(tmp_path, text):
    is_the_cube(read(tmp_path, "a.stl", text))


def test_a_binary_stl_may_speak_of_solids_and_facets(tmp_path):
    words = b"solid facet normal vertex endsolid"
    data = trimesh.Trimesh(CORNERS, THREE).export(file_type="stl")
    is_the_cube(read(tmp_path, "a.stl", words.ljust(80) + data[80:]))


def test_solids_are_parts(tmp_path):
    file = read(tmp_path, "a.stl", STL + STL.replace("cube", "other"))
    assert file.names == ("cube", "other")
    assert np.bincount(file.part).tolist() == [12, 12]


@pytest.mark.parametrize(
    "head",
    [
        "OFF\n8 6 0\n",
        "OFF 8 6 0\n",
        "OFF8 6 0\n",
        "OFF # cube\n\n8 6\n",
        "COFF\n8 6 0\n",
        "8 6 0\n",
    ],
)
def test_an_off_of_every_dialect_is_read(tmp_path, head):
    is_the_cube(read(tmp_path, "a.off", head + as_off(*CUBE).partition("0\n")[2]))
    coloured = as_off(*MIXED).replace("\n3 ", " \n3 ").replace("\n4 ", "\n4 ")
    is_the_cube(read(tmp_path, "b.off", coloured.replace("1 0\n", "1 0 255 0 0\n")))


def as_glb(places, faces, *, code=5126, normalized=False, mode=4, node=None, **more):
    """Return a GLB of metres with y up."""
    kinds = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
    rows = np.asarray(places, dtype=kinds[code])
    wide = np.zeros((len(rows), -(-rows.shape[1] * rows.itemsize // 4) * 4), np.uint8)
    wide[:, : 3 * rows.itemsize] = rows.view(np.uint8).reshape(len(rows), -1)
    order = np.asarray(faces, dtype="<u2").ravel()
    chunk = wide.tobytes() + order.tobytes()
    chunk += b"\0" * (-len(chunk) % 4)
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(chunk)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": wide.size, "byteStride": wide.shape[1]},
            {"buffer": 0, "byteOffset": wide.size, "byteLength": order.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": code, "count": len(rows), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": len(order), "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "scenes": [{"nodes": [0]}],
        **more,
    }
    document["accessors"][0]["normalized"] = normalized
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<I4s", len(text), b"JSON") + text
    data += struct.pack("<I4s", len(chunk), b"BIN\0") + chunk
    return struct.pack("<4sII", b"glTF", 2, len(data) + 12) + data


UNIT = np.array(CORNERS) / 20 * [0.03, 0.09, 0.02]


@pytest.mark.parametrize("code", [5120, 5121, 5122, 5123, 5126])
def test_glb_is_upright_and_quantised_places_are_fractions(tmp_path, code):
    top = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}.get(code)
    data = as_glb(UNIT, THREE)
    if top is not None:
        node = {"scale": [0.03, 0.09, 0.02]}
        places = np.array(CORNERS) // 20 * top
        data = as_glb(places, THREE, code=code, normalized=True, node=node)
    mesh = surface(read(tmp_path, "a.glb", data))
    assert mesh.extents == pytest.approx([0.03, 0.02, 0.09])
    assert mesh.volume == pytest.approx(0.03 * 0.02 * 0.09)


def test_nodes_turn_mirror_and_move(tmp_path):
    nodes = [
        {"children": [1], "rotation": [0, 0.5**0.5, 0, 0.5**0.5]},
        {"mesh": 0, "scale": [-1, 1, 1], "translation": [1, 0, 0]},
    ]
    mesh = surface(read(tmp_path, "a.glb", as_glb(UNIT, THREE, nodes=nodes)))
    assert mesh.volume == pytest.approx(0.03 * 0.02 * 0.09)
    # x lies along -z of glTF, which is y of the world
    assert mesh.bounds[:, 1] == pytest.approx([0.97, 1.0])


def test_strips_and_fans_of_glb_are_read(tmp_path):
    square = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    for mode, order in ((5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
        mesh = surface(read(tmp_path, "a.glb", as_glb(square, order, mode=mode)))
        assert mesh.area == pytest.approx(1)
        assert (mesh.face_normals[:, 1] < -0.9).all()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "EXT_meshopt_compression"),
        ({"nodes": [{"mesh": 0, "skin": 0}]}, "a skin"),
        ({"nodes": [{"mesh": 0, "weights": [0.5]}]}, "a morph target"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "more than 100 nodes"),
        ({"buffers": [{"byteLength": 9, "uri": "a.bin"}]}, "in another file, 'a.bin'"),
        ({"buffers": [{"byteLength": 99_999}]}, "has 168 of them"),
    ],
)
def test_what_glb_has_and_is_not_read_is_refused_by_name(tmp_path, more, words):
    with pytest.raises(InputError, match=words):
        read(tmp_path, "a.glb", as_glb(UNIT, THREE, **more))


def test_gltf_with_its_numbers_within_is_read(tmp_path):
    data = as_glb(UNIT, THREE)
    size = struct.unpack_from("<I", data, 12)[0]
    document, chunk = json.loads(data[20 : 20 + size]), data[28 + size :]
    encoded = base64.b64encode(chunk).decode()
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{encoded}"
    document["extensionsRequired"] = ["KHR_materials_unlit"]
    file = read(tmp_path, "a.gltf", json.dumps(document))
    assert surface(file).extents == pytest.approx([0.03, 0.02, 0.09])


def test_a_surface_that_is_written_comes_back_upright(tmp_path):
    mesh = trimesh.creation.box((0.01, 0.02, 0.05))
    for name in ("a.ply", "a.stl", "a.glb"):
        Surface(mesh).save(tmp_path / name)
        file = read_mesh(tmp_path / name)
        np.testing.assert_allclose(surface(file).bounds, mesh.bounds, atol=1e-7)
    own = trimesh.load_mesh(tmp_path / "a.glb")  # as it stands there
    assert own.extents == pytest.approx([0.01, 0.05, 0.02])


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.stl", STL[: len(STL) // 2]),
        ("a.stl", STL.replace("vertex 20 20 0", "vertex nan 20 0")),
        ("a.ply", as_text_ply(*CUBE)[:-30]),
        ("a.off", as_off(*CUBE)[:-30]),
    ],
)
def test_a_true_surface_passes_the_same_checks(tmp_path, name, data):
    (tmp_path / name).write_text(data)
    with pytest.raises(InputError, match=r"evaluation\.truth: "):
        read_truth(tmp_path / name, "mm")


def test_an_open_true_surface_is_told(tmp_path, caplog):
    (tmp_path / "a.obj").write_text(OBJ[:-9])
    read_truth(tmp_path / "a.obj", "mm")
    assert "the mesh is open" in caplog.text
