# SPDX-License-Identifier: MIT
"""What leaves a run: files for other programs, and a page in the browser."""

from __future__ import annotations

import io
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pyvista
import scipy.io
import trimesh
from numpy.typing import NDArray

from sononerf import __version__, storage
from sononerf.echoes.echoes import Echoes, complete_store
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, ResourceError, SettingsError, SonoNerfError
from sononerf.geometry.lattice import Volume
from sononerf.geometry.poses import Frame, FrameName
from sononerf.progress import Progress
from sononerf.report.mesh_picture import SurfaceViews
from sononerf.report.viewer import Viewer
from sononerf.run.build import locked, true_mesh
from sononerf.run.run import Run, open_run
from sononerf.run.simulate import store_path
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


REFRESH_SECONDS = 2.0
"""Interval at which a run's folder is checked for new files, s."""


class View:
    """A viewer of one folder; :meth:`refresh` shows new files."""

    def __init__(self, path: Path, *, port: int = 8080) -> None:
        self.run = Run(path)
        is_run = self.run.config.is_file()
        if not is_run and not (path / "zarr.json").is_file():
            raise InputError(f"{path}: neither a run nor a store; give the folder of one")
        echoes = None if is_run else Echoes.open(path)
        self.viewer = Viewer(path.resolve().name, port=port)
        self._has_echoes = False
        self._seen: dict[str, object] = {}
        try:
            if echoes is not None:
                self._show(echoes)
            else:
                self.refresh()
        except BaseException:
            self.viewer.close()
            raise

    def _show(self, echoes: Echoes) -> None:
        self.viewer.show_echoes(echoes)
        self._has_echoes = True

    def refresh(self) -> None:
        """Show new parts of the run: echoes, the mesh of the last epoch, model, and surface."""
        if not self.run.config.is_file():
            return
        if not self._has_echoes:
            try:
                self._show(self._echoes())
            except SonoNerfError as error:
                self._say(f"no echoes to show: {error}")
        if self._is_new("model", self.run.path / "model.json"):
            opened = open_run(self.run.path)
            quiet = Progress(quiet=True)
            self.viewer.show_model(
                opened.model, lambda poses: opened.predict(poses, progress=quiet)
            )
        if self.run.is_done("surface"):
            if self._is_new("surface", self.run.reconstruction / "read_out.json"):
                self._show_surface()
            return
        previews = sorted(self.run.path.glob("epochs/*/mesh.ply"))
        if previews and self._is_new("preview", previews[-1]):
            self.viewer.show_preview(trimesh.load_mesh(previews[-1], file_type="ply"))
            self._say(f"epoch {int(previews[-1].parent.name)}; the fit goes on")

    def _echoes(self) -> Echoes:
        if self.run.is_done("fit"):
            return self.run.echoes
        return Echoes.open(store_path(self.run.open(), None, None))

    def _show_surface(self) -> None:
        settings, mesh = self.run.open(), self.run.mesh()
        try:
            truth = None
            if settings.evaluation.registration == "none":
                truth = true_mesh(settings, self.run.provenance)
        except InputError as error:
            self._say(str(error))
            truth = None
        limit = self.run.head.resolution / 2
        views = SurfaceViews(mesh, confidence_of(mesh), error_of(mesh), truth, limit)
        self.viewer.show_surface(views)
        if (self.run.reconstruction / "volume.vti").is_file():
            self.viewer.show_volume(read_volume(self.run.path))
        read_out = self.run.read_out
        self._say(f"surface found as {read_out.get('method')}, refined: {read_out.get('refined')}")

    def _say(self, text: str) -> None:
        self.viewer.say(f"**{self.run.path.resolve().name}**: {text}.")

    def _is_new(self, name: str, file: Path) -> bool:
        """Return True if a file has come or changed since the last look."""
        if not file.is_file():
            return False
        state = (str(file), file.stat().st_mtime_ns)
        changed = self._seen.get(name) != state
        self._seen[name] = state
        return changed

    def follow(self) -> None:
        """Refresh again and again, until the process is stopped."""
        while True:
            time.sleep(REFRESH_SECONDS)
            try:
                self.refresh()
            except SonoNerfError as error:
                self._say(str(error))
