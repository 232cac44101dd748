# SPDX-License-Identifier: MIT
"""Files of strangers and of careless users: none runs code, leads elsewhere, or takes all memory.

Each is refused with one line that names the file. Packages that add scenes, fields and renderers
may run code: whoever installs one trusts it. Data may not.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import scipy.io
import torch
import trimesh
from trimesh.exchange.gltf import export_gltf

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, SettingsError, SonoNerfError, StorageError
from sononerf.field.checkpoint_io import DurableCheckpointIO, load_weights
from sononerf.geometry.poses import Poses
from sononerf.matlab_files import numbers, opened, read_mat
from sononerf.recordings.readers import read_airsas, read_numpy
from sononerf.report.page import Page
from sononerf.run.build import read_mesh, read_truth
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings, read_yaml
from sononerf.settings.sections import ImportSettings
from sononerf.storage import commit_text, lock, read_json, require_regular
from sononerf.wav_files import read_wav
from tests.matlab_writer import write_new

CANARY = "canary"


def refused(call, *given, match=None, kind=SonoNerfError):
    """Call what must be refused in one line; return the line."""
    with pytest.raises(kind, match=match) as caught:
        call(*given)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Code in place of data.


class Bomb:
    """Pickled, it makes whoever unpickles it call something."""

    def __init__(self, call, *given):
        self.call, self.given = call, given

    def __reduce__(self):
        return self.call, self.given


BOMBS = {
    "system": Bomb(os.system, f"touch {CANARY}"),
    "eval": Bomb(eval, f"open({CANARY!r}, 'w')"),
    "open": Bomb(open, CANARY, "w"),
    "mkdir": Bomb(os.mkdir, CANARY),
}


@pytest.fixture(autouse=True)
def nothing_happens(tmp_path, monkeypatch):
    """Work in an empty folder; no test may leave the canary there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # nothing heeds it
    yield
    assert not (tmp_path / CANARY).exists()


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_never_runs_code(tmp_path, name, zipped):
    content = {"state_dict": {}, "hyper_parameters": BOMBS[name]}
    torch.save(content, tmp_path / "last.ckpt", _use_new_zipfile_serialization=zipped)
    refused(DurableCheckpointIO().load_checkpoint, tmp_path / "last.ckpt", match="plain data")


@pytest.mark.parametrize("name", BOMBS)
def test_weights_and_arrays_never_run_code(tmp_path, name):
    (tmp_path / "model.safetensors").write_bytes(pickle.dumps(BOMBS[name]))
    (tmp_path / "model.json").write_text('{"schema_version": 1, "sha256": "x"}')
    refused(load_weights, tmp_path, match=r"model\.safetensors: damaged")
    array = np.array([BOMBS[name]], dtype=object)
    np.savez(tmp_path / "x.npz", waveform=array, position_m=array)
    refused(read_numpy, tmp_path / "x.npz", ImportSettings(), match=r"x\.npz: damaged")


@pytest.mark.parametrize(
    "text",
    [
        f"!!python/object/apply:os.system ['touch {CANARY}']",
        f"!!python/object/new:os.system ['touch {CANARY}']",
        "!!python/name:os.system",
        "!!python/module:os",
        "!include ../secret",
        "*x",
        "&x [*x]",
    ],
)
def test_settings_have_no_tags_and_no_aliases(tmp_path, text):
    (tmp_path / "x.yaml").write_text(f"scene: {{name: sphere}}\nfit: {text}\n")
    refused(load_settings, tmp_path / "x.yaml", match=r"x\.yaml", kind=SettingsError)


@pytest.mark.parametrize("text", ["<script>x()</script>", '"><img src=x onerror=alert(1)>'])
def test_a_page_shows_text_as_text(text):
    page = Page(text)
    page.say(text)
    page.table([("what", "value"), (text, text)])
    page.code(text)
    assert text not in page.html()


# What leads elsewhere.


@pytest.mark.parametrize(
    "url", ["http://127.0.0.1:9/x.ply", "s3://b/x.ply", "file:///etc/passwd", "zip://x::x.ply"]
)
def test_no_address_is_opened(tmp_path, url):
    refused(load_scene, "mesh", {"path": url, "unit": "m"})
    refused(read_truth, tmp_path / url)
    refused(DurableCheckpointIO().load_checkpoint, url)


def test_hdf5_files_lead_nowhere_and_are_as_large_as_they_say(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = np.arange(3.0)
    with h5py.File(path, "w") as file:
        file["na/position"] = np.arange(3.0)
        file["soft"], file["loop"] = h5py.SoftLink("/x"), h5py.SoftLink("/loop")
        file["far"] = h5py.ExternalLink("b.h5", "x")
        file["text"] = "words"
        layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
        layout[:] = h5py.VirtualSource(tmp_path / "b.h5", "x", shape=(3,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("raw", (3,), "f8", external=[(str(tmp_path / "b.h5"), 0, 24)])
        file.create_dataset("huge", shape=(10**10,), dtype="f8", chunks=(1000,))
        file.create_group("group")

    def read(name):
        with opened(path) as file:
            return numbers(file, name)

    assert read("/na/position").tolist() == [0, 1, 2]
    assert read("none/at/all") is None
    for name, words in (
        *[(name, "is a link") for name in ("soft", "loop", "far")],
        *[(name, "no array of numbers") for name in ("text", "group")],
        *[(name, "lies in another file") for name in ("virtual", "raw")],
        ("huge", "more than the file holds"),
    ):
        refused(read, name, match=words)
    settings = ImportSettings(sampling_rate=1e5)
    refused(read_airsas, path, settings, match="holds no /ch1/ts")


@pytest.mark.parametrize("name", ["metrics.json", "epochs", "reconstruction/mesh.ply"])
def test_a_folder_with_links_is_not_written_into(tmp_path, name):
    (tmp_path / "outside").write_text("precious")
    link = tmp_path / "run" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / "outside")
    with pytest.raises(StorageError, match="is a link"), lock(tmp_path / "run"):
        pass
    assert (tmp_path / "outside").read_text() == "precious"


def test_meshes_name_no_other_files(tmp_path):
    box = trimesh.creation.box((0.03, 0.02, 0.01)).export(file_type="obj")
    (tmp_path / "x.obj").write_text(f"mtllib ../outside\nusemtl x\n{box}")
    assert len(load_scene("mesh", {"path": "x.obj", "unit": "m"}).mesh.faces) == 12
    described = json.loads(GLTF)
    for uri in ("../outside", "/etc/passwd", "http://127.0.0.1:9/x"):
        described["buffers"][0]["uri"] = uri
        (tmp_path / "x.gltf").write_text(json.dumps(described))
        refused(load_scene, "mesh", {"path": "x.gltf", "unit": "m"}, match="in another file")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_what_never_ends_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.wav")
    os.mkfifo(tmp_path / "pipe.yaml")
    os.mkfifo(tmp_path / "pipe.stl")
    refused(read_wav, tmp_path / "pipe.wav", match="is a pipe, expected a file")
    refused(read_yaml, tmp_path / "pipe.yaml", match="is a pipe, expected a file")
    mesh = {"path": "pipe.stl", "unit": "m"}
    refused(load_scene, "mesh", mesh, match="not a regular file")
    refused(Poses.read, tmp_path / "pipe.yaml", match="is a pipe")
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    require_regular(tmp_path / "link")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "smoke", "poses.arrangement=path", "poses.path=/dev/zero"),
        ("simulate", "smoke", "ears.directivity=file", "ears.file=/dev/zero"),
        ("import", "recordings", ".", "--settings", "/dev/zero"),
    ],
)
def test_a_device_is_refused_at_once(words, tmp_path):
    command = [sys.executable, "-m", "sononerf.cli", *words, "--output", "out"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode in (2, 3), done.stderr
    assert "is a device, expected a file" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


# Sizes and depths.


def wav(path, *, stated=200, order="<", long=None, rate=8000):
    """Write a WAV file of 100 samples that states its bytes."""
    kind = {"<": b"RIFF", ">": b"RIFX"}[order] if long is None else b"RF64"
    form = struct.pack(f"{order}IHHIIHH", 16, 1, 1, rate, 2 * rate, 2, 16)
    sizes = b"" if long is None else b"ds64" + struct.pack("<IQQQI", 28, 0, long, 0, 0)
    body = sizes + b"note" + struct.pack(f"{order}I", 3) + b"abc\0" + b"fmt " + form
    data = b"data" + struct.pack(f"{order}I", stated)
    content = b"WAVE" + body + data + bytes(200)
    path.write_bytes(kind + struct.pack(f"{order}I", len(content)) + content)
    return path


def test_a_wav_file_holds_what_it_states(tmp_path):
    for order in "<>":
        assert read_wav(wav(tmp_path / "whole.wav", order=order)).samples.shape == (100, 1)
        short = wav(tmp_path / "short.wav", order=order, stated=202)
        refused(read_wav, short, match="states 202 bytes of samples and holds 200")
    long = wav(tmp_path / "long.wav", stated=0xFFFFFFFF, long=9_000_000_000)
    refused(read_wav, long, match="states 9000000000 bytes")
    refused(read_wav, wav(tmp_path / "slow.wav", rate=0), match=r"slow\.wav")
    for name, data in (
        ("text.wav", b"hello"),
        ("head.wav", b"RIFF\0\0\0\0WAVEds64"),
        ("e.wav", b""),
    ):
        (tmp_path / name).write_bytes(data)
        refused(read_wav, tmp_path / name, match=name)


def test_archives_that_grow_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as file:
        head = io.BytesIO()
        shape = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 1, 60)}
        np.lib.format.write_array_header_1_0(head, shape)
        file.writestr("waveform.npy", head.getvalue() + bytes(10**6))
    refused(read_numpy, tmp_path / "x.npz", ImportSettings(), match=r"x\.npz")
    packed = zlib.compress(struct.pack("<II", 14, 2**31 - 1) + bytes(10**6), 9)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed))
    (tmp_path / "x.mat").write_bytes(head + packed)
    refused(read_mat, tmp_path / "x.mat", ("x",), match=r"x\.mat")


@pytest.mark.parametrize("text", ["[" * 10**5, '{"a": ' + "9" * 10**5 + "}", "{", "", "\x00"])
def test_json_of_any_depth_is_told(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    refused(read_json, tmp_path / "x.json", match=r"x\.json: damaged")


# Broken and mislabelled files.


def test_matlab_files_hold_no_objects_and_are_whole(tmp_path):
    old = tmp_path / "old.mat"
    scipy.io.savemat(old, {"x": np.random.default_rng(0).random(5000)})
    new = write_new(tmp_path / "new.mat", {"x": np.arange(5000.0), "y": {"a": 1.0}})
    (tmp_path / "short_old.mat").write_bytes(old.read_bytes()[:3000])
    (tmp_path / "short_new.mat").write_bytes(new.read_bytes()[:3000])
    (tmp_path / "wav.mat").write_bytes(b"RIFF" + bytes(200))
    for name, words in (
        ("short_old.mat", "damaged or truncated"),
        ("short_new.mat", "truncated"),
        ("wav.mat", "whatever its name says"),
        ("none.mat", "no such file"),
    ):
        refused(read_mat, tmp_path / name, ("x",), match=words)
    with h5py.File(new, "r+") as file:
        file["x"].attrs["MATLAB_object_decode"] = np.int32(3)
        file["y"].attrs["MATLAB_class"] = np.bytes_("table")
    for name in ("x", "y"):
        refused(read_mat, new, (name,), match=f"{name} holds an object")
    (tmp_path / "text.h5").write_text("x,y\n")
    with pytest.raises(InputError, match="no HDF5"), opened(tmp_path / "text.h5"):
        pass


BOX = trimesh.creation.box((30.0, 20.0, 10.0))
STL = BOX.export(file_type="stl")
TEXT = BOX.export(file_type="stl_ascii")
OFF = BOX.export(file_type="off")
GLTF = export_gltf(trimesh.Scene(BOX), embed_buffers=True)["model.gltf"]
ELSEWHERE = export_gltf(trimesh.Scene(BOX))["model.gltf"]
NAN = STL[:96] + np.float32(np.nan).tobytes() + STL[100:]


@pytest.mark.parametrize(
    ("name", "data", "match"),
    [
        ("empty.stl", b"", "empty"),
        ("cut.stl", STL[:-30], "promises 12 triangles"),
        ("long.stl", STL + b"\0", "promises 12 triangles"),
        ("count.stl", STL[:80] + b"\xff\xff\xff\xff" + STL[84:], "promises 4294967295"),
        ("none.stl", bytes(84), "without triangles"),
        ("short.stl", b"solid", "only 5 bytes"),
        ("nan.stl", NAN, "vertex 0 of the mesh"),
        ("cut_text.stl", TEXT[: len(TEXT) // 2].encode(), "breaks off"),
        ("holed_text.stl", TEXT.replace("vertex", "", 1).encode(), "breaks off"),
        ("nan_text.stl", TEXT.replace("vertex 1", "vertex nan1", 1).encode(), "nan_text"),
        ("cut.ply", BOX.export(file_type="ply")[:-20], "promises 12 of face, 10 can be read"),
        ("cut.glb", BOX.export(file_type="glb")[:-100], "damaged GLB; its header promises"),
        ("random.glb", np.random.default_rng(0).bytes(500), "does not begin with glTF"),
        ("random.obj", np.random.default_rng(0).bytes(500), "random.obj"),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 0"),
        ("index.obj", b"v 0 0 1\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "index.obj"),
        ("points.obj", b"v 0 0 1\nv 1 0 0\nv 0 1 0\n", "points.obj"),
        ("flat.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1: a vertex has 2 coordinates"),
        ("cut.off", OFF[:-4].encode(), "promises 12 faces, 11 can be read"),
        ("short.off", "".join(OFF.splitlines(True)[:9]).encode(), "damaged OFF|cannot be read"),
        ("corner.off", OFF.replace("3 ", "2 ").encode(), "promises 12 faces, 0"),
        ("none.off", b"OFF\n", "does not say how many"),
        ("page.off", b"<html>OFF 1 2 3", "it is a web page"),
        ("far.off", f"{OFF.strip()[:-1]}99".encode(), "face 12 names a vertex that is none"),
        ("cut.gltf", GLTF[:-20], "cannot be read as GLTF"),
        ("short.gltf", re.sub(rb"base64,.{40}", b"base64,", GLTF), "short.gltf"),
        ("other.gltf", ELSEWHERE, "in another file, 'gltf_buffer_0.bin'; save it as GLB"),
        ("deep.gltf", b"[" * 100_000, "cannot be read as GLTF"),
        ("bomb.3mf", b"PK", "not a file that ends in"),
        ("a.zip", b"PK", "not a file that ends in"),
    ],
)
def test_damaged_meshes_are_refused_by_name(tmp_path, name, data, match):
    (tmp_path / name).write_bytes(data)
    line = refused(load_scene, "mesh", {"path": name, "unit": "mm"}, match=match, kind=InputError)
    assert name in line


@pytest.mark.parametrize("data", [None, b"", b"ply\n", STL[:-30], b"\x00" * 50])
def test_a_damaged_surface_of_a_run_is_told(tmp_path, data):
    if data is not None:
        (tmp_path / "mesh.ply").write_bytes(data)
        refused(read_truth, tmp_path / "mesh.ply", match=r"mesh\.ply")
    refused(read_mesh, tmp_path / "mesh.ply", "sononerf reconstruct RUN", match=r"mesh\.ply")


# Stores.


@pytest.fixture
def store(tmp_path):
    """A complete store of two poses."""
    made = EnsembleStore.create(
        tmp_path / "store",
        positions=np.eye(3)[:2],
        rotations=np.tile(np.eye(3), (2, 1, 1)),
        split=[0, 1],
        range=[0.3, 0.31, 0.32],
        frequency=[3e4, 4e4],
        attributes={"echo_hash": "x"},
    )
    for index in range(2):
        made.write_pose(index, np.ones((2, 3, 2)))
    return tmp_path / "store"


def rewritten(file, **changes):
    commit_text(file, json.dumps({**json.loads(file.read_text()), **changes}))


@pytest.mark.parametrize(
    "changes",
    [
        {"codecs": [{"name": "numcodecs.pickle", "configuration": {"protocol": 4}}]},
        {"codecs": [{"name": "os.system"}]},
        {"shape": [10**5, 2, 10**5, 10**5]},
        {"data_type": "object"},
        {"node_type": "group"},
    ],
)
def test_a_store_of_another_layout_is_refused(store, changes):
    rewritten(store / "spectrogram" / "zarr.json", **changes)
    refused(EnsembleStore.open, store, match="store")


def test_a_missing_or_damaged_pose_is_named_and_never_silent(store):
    (chunk,) = store.glob("spectrogram/c.1.*")
    data = chunk.read_bytes()
    chunk.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    refused(EnsembleStore.open(store).read_pose, 1, match="pose 1 is damaged")
    chunk.unlink()
    assert EnsembleStore.open(store).missing() == [1]
    refused(EnsembleStore.open(store).read_pose, 1, match="pose 1 is missing")
    shutil.rmtree(store / "position")
    refused(EnsembleStore.open, store, match="position: missing")
