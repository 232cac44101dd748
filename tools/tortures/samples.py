# SPDX-License-Identifier: MIT
"""One small sound file of each kind that sononerf reads, and the reader that takes it."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import safetensors.torch
import scipy.io
import torch
import trimesh
from scipy.io import wavfile

from sononerf.checksums import recorded
from sononerf.echoes.store import EnsembleStore
from sononerf.field.checkpoint_io import DurableCheckpointIO, load_weights, save_weights
from sononerf.geometry.poses import Poses
from sononerf.head.call_file import load_call
from sononerf.head.directivity.read import read_directivity
from sononerf.recordings.airsas import read_airsas
from sononerf.recordings.arrays import read_numpy
from sononerf.recordings.audio import read_audio
from sononerf.recordings.columns import read_table
from sononerf.recordings.sonotrace import read_sonotracelab
from sononerf.run.build import read_truth
from sononerf.run.run_folder import RunFolder
from sononerf.scene.scene import load_scene
from sononerf.settings.import_schema import ImportSettings
from sononerf.settings.loading import load_settings, read_yaml, shipped_configs
from sononerf.storage import commit_bytes, commit_json
from sononerf.surface.mesh_files import mesh_bytes

RATE = ImportSettings(sampling_rate=1e5)
UNITS = ImportSettings(length="m", angle="deg")


@dataclass(frozen=True)
class Sample:
    """A kind of file.

    Attributes:
        name: Name of the kind.
        suffix: Suffix of the file.
        data: A sound file.
        read: Reads a file, or raises a fault that the user can read; returns what it found.
        is_checked: Whether the format holds a checksum, so that no change may pass.
    """

    name: str
    suffix: str
    data: bytes
    read: Callable[[Path], Any]
    is_checked: bool = False


def digest(*parts: Any) -> str:
    """Return a hash of arrays, tensors, mappings and plain data."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, dict):
            found.update(digest(*[x for key in sorted(part) for x in (key, part[key])]).encode())
        elif isinstance(part, torch.Tensor):
            found.update(part.numpy().tobytes())
        elif isinstance(part, np.ndarray):
            found.update(part.tobytes())
        else:
            found.update(repr(part).encode())
    return found.hexdigest()


def _file(folder: Path, name: str, write: Callable[[Path], object]) -> bytes:
    path = folder / name
    write(path)
    return path.read_bytes()


def _hdf5(path: Path, arrays: dict[str, Any]) -> None:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


def _scene(path: Path) -> str:
    scene = load_scene("mesh", {"path": str(path), "unit": "m"})
    return digest(scene.mesh.vertices, scene.mesh.faces)


def _checkpoint(path: Path) -> str:
    found = DurableCheckpointIO().load_checkpoint(path)
    return digest(found["state_dict"], found["global_step"])


def samples(folder: Path) -> list[Sample]:
    """Return a sound file of each kind.

    Args:
        folder: For files on the way.
    """
    rng = np.random.default_rng(0)
    poses = Poses.sphere(12, radius=0.4)
    sphere = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    sound = (2e4 * rng.uniform(-1, 1, (900, 2))).astype(np.int16)
    call = (2e4 * np.sin(2 * np.pi * 4e4 * np.arange(400) / 2.5e5)).astype(np.int16)
    yaml = (shipped_configs()["sweep"]).read_bytes()
    lines = ["azimuth_deg,elevation_deg,frequency_hz,gain"]
    lines += [f"{a},{e},40000,1" for a in range(-180, 180, 30) for e in (-60, 0, 60)]
    arrays = {
        "waveform": rng.standard_normal((6, 2, 300)),
        "sampling_rate": np.array(2.5e5),
        "position_m": poses.positions[:6],
        "rotation": poses.rotations[:6],
    }
    sensor = {
        "position": [[0.4, 0.0, 0.0]],
        "orientation": [[0.0, 0.0, 180.0]],
        "coordsReceivers": [[0.0, 0.03, 0.0], [0.0, -0.03, 0.0]],
        "coordsEmitter": [[0.0, 0.0, 0.0]],
    }
    lab = {
        "structSensor": sensor,
        "structSimulationResult": {"impulseResponse": rng.standard_normal((64, 2))},
        "structSimulationParameters": {"sampleRateImpresp": 4.5e5, "speedOfSound": 340.0},
    }
    sas = {
        "ch1/ts": rng.standard_normal((5, 80)),
        "na/position": np.arange(5) * 0.01,
        "na/temperature": np.full(5, 21.5),
    }
    state = {"w": torch.arange(200.0), "b": torch.ones(3)}
    content = {"state_dict": state, "global_step": 7, "epoch": 1}
    DurableCheckpointIO().save_checkpoint(content, folder / "last.ckpt")
    checkpoint = (folder / "last.ckpt").read_bytes()
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)

    def wav(values: Any, rate: int) -> bytes:
        file = io.BytesIO()
        wavfile.write(file, rate, values)
        return file.getvalue()

    def mesh(kind: str) -> bytes:
        found = sphere.export(file_type=kind)
        return found.encode() if isinstance(found, str) else bytes(found)

    audio = lambda path: digest(*read_audio(path))  # noqa: E731
    return [
        Sample("settings", ".yaml", yaml, lambda path: load_settings(path).plain()),
        Sample("YAML", ".yaml", b"a: [1, {b: c}]\nd: |\n  text\ne: 1.5e3\n", read_yaml),
        Sample("poses", ".csv", poses.table().encode(), lambda path: Poses.read(path).positions),
        Sample(
            "table of poses",
            ".csv",
            poses.table().encode(),
            lambda path: read_table(path, UNITS).values,
        ),
        Sample("directivity", ".csv", "\n".join(lines).encode(), read_directivity),
        Sample("WAV, 16 bit", ".wav", wav(sound, 250_000), audio),
        Sample("WAV, float", ".wav", wav(sound.astype(np.float32) / 32768, 250_000), audio),
        Sample("call", ".wav", wav(call, 250_000), load_call),
        Sample("STL", ".stl", mesh("stl"), _scene),
        Sample("STL, text", ".stl", mesh("stl_ascii"), _scene),
        Sample("PLY", ".ply", mesh("ply"), _scene),
        Sample("OBJ", ".obj", mesh("obj"), _scene),
        Sample("OFF", ".off", mesh("off"), _scene),
        Sample("GLB", ".glb", mesh("glb"), _scene),
        Sample("true surface", ".ply", mesh("ply"), read_truth),
        Sample("npz", ".npz", packed.getvalue(), lambda path: read_numpy(path, RATE)),
        Sample(
            "MATLAB 5",
            ".mat",
            _file(folder, "lab.mat", lambda path: scipy.io.savemat(path, lab)),
            lambda path: read_sonotracelab(path, RATE),
        ),
        Sample(
            "HDF5",
            ".h5",
            _file(folder, "sas.h5", lambda path: _hdf5(path, sas)),
            lambda path: read_airsas(path, RATE),
        ),
        Sample("SOFA", ".sofa", _sofa(folder), read_directivity),
        Sample("checkpoint", ".ckpt", checkpoint, _checkpoint, is_checked=True),
    ]


def _sofa(folder: Path) -> bytes:
    from sononerf.head.directivity.sofa import write_sofa

    table = folder / "ears.csv"
    lines = ["azimuth_deg,elevation_deg,frequency_hz,gain,receiver"]
    lines += [
        f"{a},{e},{f},1,{ear}"
        for a in range(-180, 180, 60)
        for e in (-60, 0, 60)
        for f in (2e4, 6e4)
        for ear in (0, 1)
    ]
    table.write_text("\n".join(lines))
    return _file(folder, "ears.sofa", lambda path: write_sofa(path, read_directivity(table)))


def make_store(folder: Path) -> None:
    """Write a small store that is whole."""
    rng, poses = np.random.default_rng(1), Poses.sphere(6, radius=0.4)
    store = EnsembleStore.create(
        folder,
        poses_positions=poses.positions,
        poses_rotations=poses.rotations,
        split=np.array([0, 0, 0, 0, 1, 2]),
        range=np.linspace(0.3, 0.5, 20),
        frequency=np.linspace(2e4, 8e4, 8),
        attributes={"echo_hash": "of a sample", "reference": 1.0},
    )
    for index in range(6):
        store.write_pose(index, rng.random((2, 20, 8)).astype(np.float32))
    store.seal()


def read_store(folder: Path) -> str:
    """Return a hash of all that a store holds."""
    store = EnsembleStore.open(folder)
    if store.missing():
        store.read_pose(store.missing()[0])
    heard = [store.read_pose(index) for index in range(len(store))]
    axes = [store.positions, store.rotations, store.split, store.range, store.frequency]
    return digest(*heard, *axes, dict(store.attributes))


def make_run(folder: Path) -> None:
    """Write the files of a run that others read: weights, metrics, mesh, provenance."""
    with recorded(folder):
        save_weights(folder, {"field.w": torch.arange(300.0)}, {"settings": {}, "reference": 1.0})
        commit_json(folder / "metrics.json", {"schema": 1, "prediction": {"mae_db": 1.25}})
        commit_json(folder / "provenance.json", {"sononerf": "0", "to_original": None})
        sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
        commit_bytes(folder / "reconstruction" / "mesh.ply", mesh_bytes(sphere, "ply"))
        commit_json(folder / "reconstruction" / "read_out.json", {"level": 0.5})


def read_run(folder: Path) -> str:
    """Return a hash of all that is read of a run."""
    run = RunFolder(folder)
    state, description = load_weights(folder)
    mesh = run.mesh()
    return digest(
        state, description, run.read_metrics(), run.provenance, run.read_out,
        np.asarray(mesh.vertices), np.asarray(mesh.faces),
    )  # fmt: skip


def weights_of(tensors: dict[str, torch.Tensor]) -> bytes:
    """Return the bytes of a file of weights."""
    return bytes(safetensors.torch.save(tensors))
