# SPDX-License-Identifier: MIT
"""Layout of a store on disk: zarr v3 arrays and their attributes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

from sononerf import storage
from sononerf.errors import IncompatibleError, InputError, NumericalError

SPECTROGRAM = "spectrogram"
CRC_BYTES = 4
SPLITS = {"train": 0, "val": 1, "test": 2}

AXES: dict[str, tuple[str, tuple[str, ...], tuple[int, ...]]] = {
    # name: type, dimension names, sizes after the first
    "position": ("float64", ("pose", "world"), (3,)),
    "rotation": ("float64", ("pose", "world", "head"), (3, 3)),
    "split": ("int8", ("pose",), ()),
    "range": ("float64", ("range",), ()),
    "frequency": ("float64", ("frequency",), ()),
}
UNITS = {"position": "m", "range": "m", "frequency": "Hz"}
"""Units of the arrays; arrays without one are plain numbers."""

ANEW = "fetch the store again, or move its folder away and simulate or import it anew"
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


def checked_axes(**given: ArrayLike) -> dict[str, NDArray[Any]]:
    """Return axes in the types that are stored, by the names of :data:`AXES`."""
    axes: dict[str, NDArray[Any]] = {}
    for name, (dtype, dims, sizes) in AXES.items():
        raw = np.asarray(given[name], dtype=np.float64)
        if raw.ndim != len(dims) or raw.shape[1:] != sizes or not raw.size:
            raise InputError(f"{name}: shape {raw.shape}, expected ({dims[0]}, *{sizes})")
        if not np.isfinite(raw).all():
            raise NumericalError(f"{name}: holds NaN or infinite values")
        axes[name] = raw.astype(dtype)
    if not np.isin(given["split"], list(SPLITS.values())).all():
        raise InputError("split: expected 0 (train), 1 (validation) or 2 (test)")
    lengths = [len(axes[name]) for name in ("position", "rotation", "split")]
    if len(set(lengths)) > 1:
        raise InputError(f"position, rotation and split differ in length: {lengths}")
    return axes


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
            raise InputError(f"{chunk}: {size} bytes, expected {array.nbytes + CRC_BYTES}; {ANEW}")
        try:
            axes[name] = np.asarray(array[...])
        except Exception as error:  # zarr's codecs raise their own kinds
            raise InputError(f"{chunk}: damaged ({error}); {ANEW}") from error
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
_RESERVED = ("format", "schema_version")


def plain_attributes(path: Path, attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON would give them back, sorted, so that bytes know no order."""
    plain = {key: value for key, value in attributes.items() if key not in _RESERVED}
    try:
        result: dict[str, Any] = json.loads(storage.to_json(plain, sort_keys=True))
    except ValueError as error:
        raise NumericalError(f"{path}: an attribute is NaN or infinite") from error
    return result


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
    return {key: value for key, value in stored.items() if key not in _RESERVED}
