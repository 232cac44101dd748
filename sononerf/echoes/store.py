# SPDX-License-Identifier: MIT
"""A store on disk: zarr v3 arrays, their layout and attributes, one chunk per pose."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

from sononerf import storage
from sononerf.echoes.memory_ensemble import (
    AXES,
    RESERVED,
    Ensemble,
    checked_axes,
    plain_attributes,
    spectrogram_fault,
)
from sononerf.errors import IncompatibleError, InputError, NumericalError
from sononerf.numerics import Singles

SPECTROGRAM = "spectrogram"
CRC_BYTES = 4

UNITS = {"position": "m", "range": "m", "frequency": "Hz"}
"""Units of the arrays; arrays without one are plain numbers."""

FETCH_ANEW = "fetch the store again, or move its folder away and simulate or import it anew"
"""Advice about damage that writing single poses again does not mend."""


class DurableStore(LocalStore):
    """zarr's local store, whose own writing is not fsynced, with every write committed."""

    def _commit(self, key: str, value: Buffer) -> None:
        self._check_writable()
        storage.commit_bytes(self.root / key, value.to_bytes())

    async def set(self, key: str, value: Buffer) -> None:
        """Commit one key."""
        self._commit(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Commit one key unless it is there."""
        if not (self.root / key).exists():
            self._commit(key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Commit one key, for the zarr versions that write without a loop."""
        self._commit(key, value)


def chunk_path(root: Path, name: str, index: tuple[int, ...]) -> Path:
    """Return the file of one chunk; all chunks of an array lie in one folder."""
    return root / name / ".".join(["c", *map(str, index)])


def _create(
    root: Path,
    name: str,
    *,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dtype: str,
    dimensions: tuple[str, ...],
) -> Any:
    packed = name == SPECTROGRAM
    return zarr.create_array(
        store=DurableStore(root / name),
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        # A chunk that is lost must not read as silence.
        fill_value=np.nan if packed else 0,
        serializer=BytesCodec(endian="little"),
        compressors=[ZstdCodec(level=3), Crc32cCodec()] if packed else [Crc32cCodec()],
        filters=None,
        # Flat names: one folder to fsync instead of one per dimension.
        chunk_key_encoding={"name": "default", "separator": "."},
        dimension_names=dimensions,
        config={"write_empty_chunks": True},
        overwrite=True,
        attributes={"units": UNITS.get(name, "1")},
    )


def create_arrays(root: Path, axes: dict[str, NDArray[Any]], receivers: int) -> None:
    """Write the axes whole and declare the spectrogram, all before the group that shows them."""
    for name, values in axes.items():
        dtype, dimensions, _ = AXES[name]
        array = _create(
            root, name, shape=values.shape, chunks=values.shape, dtype=dtype, dimensions=dimensions
        )
        array[...] = values
    size = (receivers, len(axes["range"]), len(axes["frequency"]))
    _create(
        root,
        SPECTROGRAM,
        shape=(len(axes["position"]), *size),
        chunks=(1, *size),
        dtype="float32",
        dimensions=("pose", "ear", "range", "frequency"),
    )


def _open_array(
    root: Path, name: str, group: Any, dtype: str, dims: tuple[str, ...], sizes: tuple[int, ...]
) -> Any:
    """Return one array of the group if it has the expected layout; its data are not read yet."""
    path = root / name
    try:
        array = group.get(name)
    except Exception as error:  # the error of damaged metadata depends on the parser
        raise InputError(f"{path}: damaged ({type(error).__name__}: {error})") from error
    if not isinstance(array, zarr.Array):
        raise InputError(f"{path}: missing; simulate or fetch the ensemble again")
    metadata = array.metadata.to_dict()
    codecs = [codec["name"] for codec in metadata["codecs"]]
    packed = name == SPECTROGRAM
    expected = ["bytes", "zstd", "crc32c"] if packed else ["bytes", "crc32c"]
    chunks = (1, *array.shape[1:]) if packed else array.shape
    stored = {
        "type": (str(array.dtype), dtype),
        "dimension names": (tuple(array.metadata.dimension_names or ()), dims),
        "shape": (array.shape[-len(sizes) :] if sizes else (), sizes),
        "number of dimensions": (array.ndim, len(dims)),
        "chunks": (array.chunks, chunks),
        "codecs": (codecs, expected),
        "big-endian": (metadata["codecs"][0].get("configuration") == {"endian": "big"}, False),
        "chunk names": (
            metadata["chunk_key_encoding"],
            {"name": "default", "configuration": {"separator": "."}},
        ),
        "fill value": (bool(np.isnan(array.fill_value)), packed),
    }
    for what, (is_there, wanted) in stored.items():
        if is_there != wanted:
            raise InputError(f"{path}: {what} {is_there}, expected {wanted}")
    if min(array.shape) < 1:
        raise InputError(f"{path}: empty (shape {array.shape})")
    return array


def read_axes(root: Path, group: Any) -> tuple[dict[str, NDArray[Any]], Any]:
    """Check every array against the layout of :func:`create_arrays`, and read the axes.

    Out: (P, E, R, F).
    """
    axes = {}
    for name, (dtype, dims, sizes) in AXES.items():
        array = _open_array(root, name, group, dtype, dims, sizes)
        chunk = chunk_path(root, name, (0,) * array.ndim)
        size = chunk.stat().st_size if chunk.is_file() else 0
        # This also bounds the memory: a declared size without a file of that size is refused.
        if size != array.nbytes + CRC_BYTES:
            raise InputError(
                f"{chunk}: {size} bytes, expected {array.nbytes + CRC_BYTES}; {FETCH_ANEW}"
            )
        try:
            axes[name] = np.asarray(array[...])
        except Exception as error:  # zarr's codecs raise their own kinds
            raise InputError(f"{chunk}: damaged ({error}); {FETCH_ANEW}") from error
    poses = {len(axes[name]) for name in ("position", "rotation", "split")}
    if len(poses) > 1:
        raise InputError(f"{root}: position, rotation and split differ in length: {sorted(poses)}")
    dims = ("pose", "ear", "range", "frequency")
    sizes = (len(axes["range"]), len(axes["frequency"]))
    spectrogram = _open_array(root, SPECTROGRAM, group, "float32", dims, sizes)
    if spectrogram.shape[0] != len(axes["position"]):
        raise InputError(
            f"{root / SPECTROGRAM}: holds {spectrogram.shape[0]} poses, expected "
            f"{len(axes['position'])}"
        )
    return axes, spectrogram


FORMAT = "sononerf-ensemble"
SCHEMA_VERSION = 1


def write_group(path: Path, plain: dict[str, Any]) -> None:
    """Write the group's own file; zarr's update would keep the order of the calls in its bytes."""
    own = {"format": FORMAT, "schema_version": SCHEMA_VERSION}
    group = {"zarr_format": 3, "node_type": "group", "attributes": {**own, **plain}}
    storage.commit_json(path / "zarr.json", group)


def read_attributes(path: Path) -> dict[str, Any]:
    """Return a store's attributes without the format's own names."""
    group = storage.read_json(path / "zarr.json")
    try:
        kind = (group["node_type"], group["zarr_format"])
        stored = dict(group["attributes"])
    except (KeyError, TypeError, ValueError):
        kind, stored = None, {}
    if kind != ("group", 3) or stored.get("format") != FORMAT:
        raise InputError(f"{path}: no ensemble of sononerf, or its zarr.json is damaged")
    version = stored.get("schema_version")
    if version != SCHEMA_VERSION:
        raise IncompatibleError(
            f"{path}: schema_version {version!r}, this sononerf reads {SCHEMA_VERSION}; "
            "install the sononerf that wrote it"
        )
    return {key: value for key, value in stored.items() if key not in RESERVED}


class EnsembleStore(Ensemble):
    """An ensemble in a zarr v3 group, one chunk per pose; open it with :meth:`open`.

    A pose is there when its chunk is there; zarr checks the chunk's CRC-32C. The same input gives
    the same bytes in any order of the poses.
    """

    def __init__(self, path: Path, *, mode: Literal["r", "r+"] = "r") -> None:
        self.path = path
        self.mode = mode
        if not (path / "zarr.json").is_file():
            raise InputError(f"{path}: no ensemble store; make one with `sononerf simulate`")
        self._attributes = read_attributes(path)
        try:
            store = DurableStore(path, read_only=mode == "r")
            group = zarr.open_group(store, mode=mode, zarr_format=3, use_consolidated=False)
        except Exception as error:  # the error of damaged metadata depends on the parser
            raise InputError(f"{path}: damaged ({type(error).__name__}: {error})") from error
        self._axes, self._spectrogram = read_axes(path, group)

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, (self.path, self.mode)

    @classmethod
    def open(cls, path: Path, *, mode: Literal["r", "r+"] = "r") -> EnsembleStore:
        """Open a store; see the class."""
        return cls(path, mode=mode)

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        positions: ArrayLike,
        rotations: ArrayLike,
        split: ArrayLike,
        range: ArrayLike,  # noqa: A002 - the axis is called so
        frequency: ArrayLike,
        attributes: dict[str, Any],
        receivers: int = 2,
    ) -> EnsembleStore:
        """Create a store with its axes and poses, or open the same one to add spectrograms.

        The group's own file comes last, so that an unfinished store is not taken for one.

        In: positions ((P, 3), m), rotations (P, 3, 3), split (P,), range ((R,), m),
        frequency ((F,), Hz).
        """
        axes = checked_axes(
            position=positions, rotation=rotations, split=split, range=range, frequency=frequency
        )
        plain = plain_attributes(path, attributes)
        if not (path / "zarr.json").exists():
            _refuse_foreign(path)
            create_arrays(path, axes, receivers)
            write_group(path, plain)
        store = cls(path, mode="r+")
        if store.attributes.get("echo_hash") != plain.get("echo_hash"):
            raise IncompatibleError(
                f"{path}: holds echoes of other settings; choose another folder, or --overwrite"
            )
        for name, values in axes.items():
            if not np.array_equal(values, store._axes[name]):
                raise IncompatibleError(
                    f"{path}: its {name} differs; choose another folder, or --overwrite"
                )
        if store.receivers != receivers:
            raise IncompatibleError(
                f"{path}: holds {store.receivers} receivers, expected {receivers}; choose another "
                "folder, or --overwrite"
            )
        return store

    @property
    def receivers(self) -> int:
        """Number of receivers."""
        return int(self._spectrogram.shape[1])

    def update_attributes(self, **values: Any) -> None:
        """Set attributes; all of them or, if the process dies, none."""
        self._refuse_reading()
        plain = plain_attributes(self.path, {**self._attributes, **values})
        write_group(self.path, plain)
        self._attributes = plain

    def write_pose(self, index: int, spectrogram: ArrayLike) -> None:
        """Commit one pose. In: spectrogram ((E, R, F) float32)."""
        self._refuse_reading()
        self._spectrogram[index] = self._checked(index, spectrogram)

    def read_pose(self, index: int) -> Singles:
        """Return one pose's magnitude, (E, R, F), verified."""
        self._refuse_unknown(index)
        way_out = "give the same simulate or import command again"
        if not self._chunk(index).is_file():
            raise InputError(f"{self.path}: pose {index} is missing; {way_out}")
        try:
            values = np.array(self._spectrogram[index], dtype=np.float32, order="C")
        except Exception as error:  # zarr's codecs raise their own kinds
            raise InputError(
                f"{self.path}: pose {index} is damaged ({error}); {way_out}"
            ) from error
        fault = spectrogram_fault(values)
        if fault:
            raise InputError(
                f"{self.path}: pose {index} holds {fault}; whoever wrote the store has to mend it"
            )
        return values

    def missing(self) -> list[int]:
        """Return the poses without a file."""
        return [index for index in range(len(self)) if not self._chunk(index).is_file()]

    @property
    def is_sealed(self) -> bool:
        """True if no pose is missing and the results over all poses are stored."""
        return "reference" in self._attributes and not self.missing()

    def damaged(self) -> list[int]:
        """Read all poses that are there; return those that are damaged."""
        indices = []
        for index in range(len(self)):
            if self._chunk(index).is_file():
                try:
                    self.read_pose(index)
                except InputError:
                    indices.append(index)
        return indices

    def remove_damaged(self) -> None:
        """Remove the files of damaged poses, which then count as missing."""
        self._refuse_reading()
        for index in self.damaged():
            storage.remove_file(self._chunk(index))

    def _chunk(self, index: int) -> Path:
        return chunk_path(self.path, SPECTROGRAM, (index, 0, 0, 0))

    def _refuse_reading(self) -> None:
        if self.mode == "r":
            raise InputError(f"{self.path}: opened for reading; open it with mode='r+'")


def _reopen(path: Path, mode: Literal["r", "r+"]) -> EnsembleStore:
    return EnsembleStore(path, mode=mode)


def _refuse_foreign(path: Path) -> None:
    """Refuse a folder with files that an unfinished store does not have."""
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path}: is a file, expected a folder; choose another")
    ours = {*AXES, SPECTROGRAM}
    foreign = sorted(p.name for p in path.iterdir() if p.name not in ours and p.name[0] != ".")
    if foreign:
        raise InputError(f"{path}: holds {foreign[0]!r} and is no ensemble store; choose another")


class SubtractedStore(EnsembleStore):
    """Ensemble from which the power of another one at the same poses is subtracted.

    There is no phase, so power is subtracted cell by cell. A cell in which the surroundings alone
    have more power becomes silent.
    """

    def __init__(self, path: Path, background: Path) -> None:
        super().__init__(path)
        self._background = EnsembleStore.open(background)
        for name in AXES:
            mine, theirs = self._axes[name], self._background._axes[name]
            if mine.shape != theirs.shape or not np.allclose(mine, theirs, rtol=0, atol=1e-6):
                raise IncompatibleError(
                    f"{background}: its {name} differs from that of {path}; a background is heard "
                    "at the same poses and analysed alike"
                )
        missing = self._background.missing()
        if missing:
            raise InputError(
                f"{background}: pose {missing[0]} is missing; finish it with `sononerf simulate`"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return SubtractedStore, (self.path, self._background.path)

    def read_pose(self, index: int) -> Singles:
        """Return one pose's magnitude, (E, R, F), without the surroundings."""
        whole = np.square(super().read_pose(index), dtype=np.float64)
        left = whole - np.square(self._background.read_pose(index), dtype=np.float64)
        return np.sqrt(left.clip(min=0.0)).astype(np.float32)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the whole, except for the loudness of the rest, without a noise floor."""
        unknown = dict.fromkeys(("noise_floor_mae_db", "noise_floor_mae_db_active", "noise"))
        given = super().attributes
        return {**given, **unknown, "reference": given["reference"] * self._part}

    @cached_property
    def _part(self) -> float:
        """Level of the loudest training cell over that of the whole."""
        train = [int(index) for index in self.indices("train")]
        left = max(float(self.read_pose(index).max()) for index in train)
        if not left > 0.0:
            raise NumericalError(
                f"{self._background.path}: as loud as {self.path} everywhere, so nothing is left; "
                "is it the same ensemble?"
            )
        return left / max(float(super(SubtractedStore, self).read_pose(i).max()) for i in train)
