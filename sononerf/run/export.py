# SPDX-License-Identifier: MIT
"""Echoes, predictions and volumes as files of MATLAB and HDF5, and meshes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pyvista
import scipy.io
from numpy.typing import NDArray

from sononerf import __version__, storage
from sononerf.echoes.echoes import complete_store
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, ResourceError, SettingsError
from sononerf.geometry.lattice import Volume
from sononerf.geometry.poses import Frame, FrameName
from sononerf.run.build import locked
from sononerf.run.run import Run
from sononerf.start.surface import MeshFormat, confidence_of, error_of, mesh_bytes

FileType = Literal["mat", "h5"]

LARGEST = 2**31 - 1
"""Largest array in MATLAB's format of version 5, bytes."""
HEAD = "MATLAB 5.0 MAT-file, written by sononerf"
"""Header without the usual date: the same arrays give the same bytes."""


@dataclass(frozen=True, eq=False)
class Named:
    """An array with its description."""

    values: NDArray[Any]  # Any shape
    # Name of each dimension. A one-dimensional array of the same name holds its coordinates
    axes: tuple[str, ...]
    units: str  # Such as ``m``; empty for a plain number
    meaning: str  # A few words


def file_bytes(
    file_type: FileType, arrays: Mapping[str, Named], attributes: Mapping[str, str]
) -> bytes:
    """Return arrays as the bytes of a file; the same arrays give the same bytes.

    MATLAB's file (version 5) has one variable per array and the structs ``units``, ``axes`` and
    ``attributes``. HDF5 has one dataset per array, with dimension scales.
    """
    if file_type == "h5":
        return _hdf5(arrays, attributes)
    for name, array in arrays.items():
        if array.values.nbytes > LARGEST:
            raise ResourceError(
                f"{name}: {array.values.nbytes / 1e9:.1f} GB, and a .mat file holds at most "
                f"{LARGEST / 1e9:.1f} GB in one array; choose a .h5 file"
            )
    return _matlab(arrays, attributes)


def _matlab(arrays: Mapping[str, Named], attributes: Mapping[str, str]) -> bytes:
    data: dict[str, Any] = {name: array.values for name, array in arrays.items()}
    data["units"] = {name: array.units for name, array in arrays.items()}
    data["axes"] = {name: ", ".join(array.axes) for name, array in arrays.items()}
    data["attributes"] = dict(attributes)
    file = io.BytesIO()
    scipy.io.savemat(file, data, do_compression=True, oned_as="column", long_field_names=True)
    return HEAD.ljust(116).encode() + file.getvalue()[116:]


def _hdf5(arrays: Mapping[str, Named], attributes: Mapping[str, str]) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for key, text in attributes.items():
            file.attrs[key] = text
        for name, array in arrays.items():
            made = file.create_dataset(name, data=array.values, track_times=False)
            made.attrs["units"], made.attrs["long_name"] = array.units, array.meaning
            if array.axes == (name,):
                made.make_scale(name)
        for name, array in arrays.items():
            for number, axis in enumerate(array.axes):
                file[name].dims[number].label = axis
                if axis in arrays and axis != name:
                    file[name].dims[number].attach_scale(file[axis])
    return buffer.getvalue()


What = Literal["auto", "echoes", "prediction", "volume", "mesh"]

ARRAYS: dict[str, FileType] = {".mat": "mat", ".h5": "h5", ".hdf5": "h5"}
MESHES: dict[str, MeshFormat] = {".ply": "ply", ".stl": "stl", ".glb": "glb"}


def export(source: Path, output: Path, *, what: What = "auto", frame: FrameName = "auto") -> Path:
    """Write a part of a store or a run as a file of another format, which its suffix names.

    =========== =================== ==========================================
    what        formats             content
    =========== =================== ==========================================
    echoes      ``.mat .h5``        spectrograms, poses, axes
    prediction  ``.mat .h5``        predicted and measured spectrograms
    volume      ``.mat .h5``        summed reflectivity on a grid
    mesh        ``.ply .stl .glb``  the surface
    =========== =================== ==========================================
    """
    suffix = output.suffix.lower()
    if suffix not in (*ARRAYS, *MESHES):
        listed = ", ".join([*ARRAYS, *MESHES])
        raise SettingsError(f"{output}: expected a suffix of {listed}")
    is_store = (source / "zarr.json").is_file()
    if what == "auto" and not is_store:
        what = "mesh" if suffix in MESHES else "prediction"
    elif what == "auto":
        what = "echoes"
    if is_store != (what == "echoes"):
        kind = "a store" if is_store else "no store"
        raise InputError(
            f"{source}: is {kind}; echoes come from a store, prediction, volume and mesh "
            "from the folder of a run"
        )
    if (what == "mesh") != (suffix in MESHES):
        raise SettingsError(
            f"{output}: a mesh is written as {', '.join(MESHES)}, and nothing else is; choose "
            "another suffix, or another --what"
        )
    run = Run(source)
    stated = EnsembleStore.open(source).attributes if is_store else run.provenance
    with locked([] if is_store else [run], output):
        storage.commit_bytes(output, _content(source, suffix, what, Frame.of(stated, frame)))
    return output


def _content(source: Path, suffix: str, what: What, frame: Frame) -> bytes:
    """Return the bytes of the file that :func:`export` writes."""
    if suffix in MESHES:
        mesh = Run(source).mesh()
        known = {"confidence": confidence_of(mesh), "error": error_of(mesh)}
        return mesh_bytes(frame.mesh(mesh), MESHES[suffix], **known)
    parts = {"echoes": _echoes, "prediction": _prediction, "volume": _volume}
    arrays, attributes = parts[what](source, frame)
    plain = {"software": f"sononerf {__version__}", "frame": frame.name, **attributes}
    return file_bytes(ARRAYS[suffix], arrays, plain)


Arrays = tuple[dict[str, Named], dict[str, str]]


def _axes(range_m: NDArray[Any], frequency: NDArray[Any]) -> dict[str, Named]:
    return {
        "range": Named(range_m, ("range",), "m", "half of the path from emitter to receiver"),
        "frequency": Named(frequency, ("frequency",), "Hz", "centre of the frequency bin"),
    }


def _poses(position: NDArray[Any], rotation: NDArray[Any], frame: Frame) -> dict[str, Named]:
    places, rotations = frame.places(position), frame.rotations(rotation)
    return {
        "position": Named(places, ("pose", "world"), frame.unit_name, "position of the head"),
        "rotation": Named(rotations, ("pose", "world", "head"), "", "rotation from head to world"),
    }


def _echoes(source: Path, frame: Frame) -> Arrays:
    store = complete_store(source)
    loud = np.stack([store.read_pose(index) for index in range(len(store))])
    attributes = store.attributes
    units = str((attributes.get("units") or {}).get("spectrogram", "linear magnitude"))
    arrays = {
        "spectrogram": Named(loud, ("pose", "ear", "range", "frequency"), "1", units),
        **_poses(store.positions, store.rotations, frame),
        "split": Named(store.split, ("pose",), "", "0 train, 1 validation, 2 test"),
        **_axes(store.range, store.frequency),
    }
    said = ("origin", "source", "licence", "speed_of_sound", "reference", "settings")
    text = {name: attributes[name] for name in said if attributes.get(name) is not None}
    return arrays, {
        name: value if isinstance(value, str) else storage.to_json(value)
        for name, value in text.items()
    }


def _prediction(source: Path, frame: Frame) -> Arrays:
    file = source / "prediction" / "spectrograms.npz"
    if not file.is_file():
        raise InputError(f"{file}: missing; make it with `sononerf predict {source}`")
    try:
        with np.load(file, allow_pickle=False) as opened:
            content = {name: np.asarray(opened[name]) for name in opened.files}
        arrays = {
            name: Named(
                content[name],
                ("pose", "ear", "range", "frequency"),
                "1",
                f"{name} linear magnitude",
            )
            for name in ("predicted", "measured")
            if name in content
        }
        arrays["number"] = Named(content["pose"], ("pose",), "", "number of the pose in the store")
        arrays |= _poses(content["position"], content["rotation"], frame)
        arrays |= _axes(content["range_m"], content["frequency_hz"])
        return arrays, {"reference": repr(float(content["reference"]))}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(f"{file}: damaged ({error}); predict again") from error


def read_volume(source: Path) -> Volume:
    """Return the volume of a run's reconstruction."""
    file = _reconstructed(source, "volume.vti")
    try:
        with warnings.catch_warnings(action="ignore"):  # VTK's own words on a damaged file
            image = pyvista.ImageData(file)
        flat = np.asarray(image.point_data["reflectivity"], dtype=np.float32)
        values = flat.reshape(image.dimensions, order="F")
        return Volume(values, np.asarray(image.origin), float(image.spacing[0]))
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{file}: damaged ({error}); reconstruct again") from error


def _volume(source: Path, frame: Frame) -> Arrays:
    if not frame.is_world:
        raise InputError(f"{source}: a volume is exported in the world's frame; add --frame world")
    volume = read_volume(source)
    axes = {
        name: Named(axis, (name,), "m", f"centre of the voxel along {name}")
        for name, axis in zip("xyz", volume.axes(), strict=True)
    }
    meaning = "reflectivity summed over directions and frequencies"
    return {"reflectivity": Named(volume.values, ("x", "y", "z"), "1", meaning), **axes}, {}


def _reconstructed(source: Path, name: str) -> Path:
    file = source / "reconstruction" / name
    if not file.is_file():
        raise InputError(f"{file}: missing; make it with `sononerf reconstruct {source}`")
    return file
