# SPDX-License-Identifier: MIT
"""The ensemble on disk: spectrograms of every pose; each pose is complete or missing."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import ArrayLike

from sononerf import storage
from sononerf.echoes.layout import (
    AXES,
    SPECTROGRAM,
    DurableStore,
    checked_axes,
    chunk_path,
    create_arrays,
    plain_attributes,
    read_attributes,
    read_axes,
    write_group,
)
from sononerf.echoes.memory_ensemble import Ensemble, fault_of
from sononerf.errors import IncompatibleError, InputError, NumericalError
from sononerf.numerics import Singles


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
        poses_positions: ArrayLike,
        poses_rotations: ArrayLike,
        split: ArrayLike,
        range: ArrayLike,  # noqa: A002 - the axis is called so
        frequency: ArrayLike,
        attributes: dict[str, Any],
        receivers: int = 2,
    ) -> EnsembleStore:
        """Create a store with its axes and poses, or open the same one to add spectrograms.

        The group's own file comes last, so that an unfinished store is not taken for one.

        In: poses_positions ((P, 3), m), poses_rotations (P, 3, 3), split (P,), range ((R,), m),
        frequency ((F,), Hz).
        """
        axes = checked_axes(
            position=poses_positions,
            rotation=poses_rotations,
            split=split,
            range=range,
            frequency=frequency,
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
        """Commit one pose.

        In: spectrogram ((E, R, F) float32).
        """
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
        fault = fault_of(values)
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
