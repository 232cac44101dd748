# SPDX-License-Identifier: MIT
"""Ensembles: spectrograms of receivers at many poses, in memory, and their split.

Repeated pings of one pose stay together in training, validation or test.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf import storage
from sononerf.errors import InputError, NumericalError
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import RANGE_DB, active_level, compress, mae_db
from sononerf.numerics import Floats, Ints, Singles

SPLITS = {"train": 0, "val": 1, "test": 2}
TRAIN, VALIDATION, TEST = 0, 1, 2
AXES: dict[str, tuple[str, tuple[str, ...], tuple[int, ...]]] = {
    # name: type, dimension names, sizes after the first
    "position": ("float64", ("pose", "world"), (3,)),
    "rotation": ("float64", ("pose", "world", "head"), (3, 3)),
    "split": ("int8", ("pose",), ()),
    "range": ("float64", ("range",), ()),
    "frequency": ("float64", ("frequency",), ()),
}
RESERVED = ("format", "schema_version")
SAME_PLACE, SAME_ROTATION = 1e-6, 1e-6  # m and no unit: rounding of a pose that is printed twice


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


def plain_attributes(path: Path, attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON would give them back, sorted: equal ones give equal bytes."""
    plain = {key: value for key, value in attributes.items() if key not in RESERVED}
    try:
        result: dict[str, Any] = json.loads(storage.to_json(plain, sort_keys=True))
    except ValueError as error:
        raise NumericalError(f"{path}: an attribute is NaN or infinite") from error
    return result


def pose_groups(poses: Poses) -> Ints:
    """Return a number for each pose, (P,): the same for pings of the same pose."""
    table = np.concatenate(
        [
            np.round(poses.positions / SAME_PLACE),
            np.round(poses.rotations.reshape(len(poses), 9) / SAME_ROTATION),
        ],
        axis=1,
    )
    return np.unique(table + 0.0, axis=0, return_inverse=True)[1].reshape(-1)


def split_of(poses: Poses, split: ArrayLike | None, *, where: str = "split") -> NDArray[np.int8]:
    """Return the use of each pose, (P,): 0 train, 1 validation, 2 test. In: split (P,)."""
    if split is None:
        return draw_split(poses, where="poses")
    given = np.asarray(split)
    if given.shape != (len(poses),):
        raise InputError(f"{where} has shape {given.shape}, expected ({len(poses)},), one per pose")
    uses: dict[Any, int] = {**SPLITS, **{number: number for number in SPLITS.values()}}
    values = given.tolist()
    # True would be equal to 1, which is validation.
    wrong = next((one for one in values if isinstance(one, bool) or one not in uses), None)
    if wrong is not None:
        raise InputError(f"{where}: found {wrong!r}, expected train, val or test, or 0, 1 or 2")
    found = np.array([uses[value] for value in values], dtype=np.int8)
    if not (found == TRAIN).any():
        raise InputError(f"{where}: no pose is for training; mark some as train")
    return found


def draw_split(
    poses: Poses,
    *,
    validation: int | None = None,
    heldout: int | None = None,
    seed: int = 0,
    where: str,
) -> NDArray[np.int8]:
    """Draw the use of each pose at random; repeated pings of one pose stay together.

    Out: split ((P,) int8).
    """
    groups = pose_groups(poses)
    count = int(groups.max(initial=-1)) + 1
    few = min(10, max(count // 20, int(count >= 3))) if validation is None else validation
    some = min(20, max(count // 10, int(count >= 3))) if heldout is None else heldout
    order = np.random.default_rng(seed).permutation(count)
    of_group = np.full(count, TRAIN, dtype=np.int8)
    of_group[order[:some]] = TEST
    of_group[order[some : some + few]] = VALIDATION
    if not (of_group == TRAIN).any():
        raise InputError(
            f"{where}: {count} poses, of which {few} validate and {some} are held out; none is "
            "left to train on"
        )
    return of_group[groups]


def repeats(poses: Poses, split: NDArray[np.int8]) -> dict[int, int]:
    """Return a second ping for each test pose that was recorded more than once."""
    groups = pose_groups(poses)
    pairs: dict[int, int] = {}
    for group in np.unique(groups[split == TEST]):
        same = np.flatnonzero((groups == group) & (split == TEST))
        if len(same) > 1:
            pairs[int(same[0])] = int(same[1])
    return pairs


class Ensemble(ABC):
    """Spectrograms of receivers at every pose; each pose is complete or missing.

    Attributes:
        path: Name of the ensemble in messages: its folder, if it is on disk.
    """

    path: Path
    _axes: dict[str, NDArray[Any]]
    _attributes: dict[str, Any]

    def __len__(self) -> int:
        return len(self._axes["position"])

    @property
    def positions(self) -> Floats:
        """Head positions, (P, 3), m, world frame."""
        return self._axes["position"].copy()

    @property
    def rotations(self) -> Floats:
        """Head to world, (P, 3, 3)."""
        return self._axes["rotation"].copy()

    @property
    def split(self) -> NDArray[np.int8]:
        """Use of each pose, (P,): 0 training, 1 validation, 2 test."""
        return self._axes["split"].copy()

    @property
    def range(self) -> Floats:
        """One-way distances of the slices, (R,), m."""
        return self._axes["range"].copy()

    @property
    def frequency(self) -> Floats:
        """Frequencies of the bins, (F,), Hz."""
        return self._axes["frequency"].copy()

    @property
    @abstractmethod
    def receivers(self) -> int:
        """Number of receivers."""

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the ensemble, as a copy: settings, versions, units, c, m0 ..."""
        return dict(self._attributes)

    def indices(self, split: Literal["train", "val", "test"]) -> Ints:
        """Return the numbers of a split's poses, in order."""
        if split not in SPLITS:
            raise InputError(f"split {split!r}: there are {', '.join(SPLITS)}")
        return np.flatnonzero(self.split == SPLITS[split])

    @abstractmethod
    def update_attributes(self, **values: Any) -> None:
        """Set attributes, all at once."""

    @abstractmethod
    def read_pose(self, index: int) -> Singles:
        """Return one pose's magnitude, (E, R, F), linear."""

    @abstractmethod
    def write_pose(self, index: int, spectrogram: ArrayLike) -> None:
        """Store one pose's linear magnitude, (E, R, F)."""

    @abstractmethod
    def missing(self) -> list[int]:
        """Return the numbers of the poses that are not there."""

    def _checked(self, index: int, spectrogram: ArrayLike) -> Singles:
        """Return a spectrogram as float32; refuse another shape, and invalid values."""
        self._refuse_unknown(index)
        values = np.ascontiguousarray(spectrogram, dtype="<f4")
        shape = (self.receivers, len(self._axes["range"]), len(self._axes["frequency"]))
        if values.shape != shape:
            raise InputError(
                f"{self.path}: pose {index} has shape {values.shape}, "
                f"expected (receivers, ranges, frequencies) {shape}"
            )
        fault = spectrogram_fault(values)
        if fault:
            raise NumericalError(f"{self.path}: pose {index} holds {fault}")
        return values

    def _refuse_unknown(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise InputError(f"{self.path}: no pose {index}; there are 0 to {len(self) - 1}")


MAX_MAGNITUDE = 1e18
"""Largest magnitude of a spectrogram: the square of a larger one overflows single precision."""


def spectrogram_fault(spectrogram: Singles) -> str:
    """Return where a spectrogram (E, R, F) holds invalid magnitudes; empty if nowhere."""
    usable = (spectrogram >= 0.0) & (spectrogram <= MAX_MAGNITUDE)  # False for NaN
    if usable.all():
        return ""
    at = np.unravel_index(int(usable.argmin()), usable.shape)
    found = spectrogram[at]
    return f"the magnitude {found:g} (receiver {at[0]}, range slice {at[1]}, frequency {at[2]})"


class MemoryEnsemble(Ensemble):
    """An ensemble in memory. At first all its poses are missing.

    In: positions ((P, 3), m), rotations (P, 3, 3), split (P,), range ((R,), m), frequency ((F,),
    Hz).
    """

    def __init__(
        self,
        *,
        positions: ArrayLike,
        rotations: ArrayLike,
        split: ArrayLike,
        range: ArrayLike,  # noqa: A002 - the axis is called so
        frequency: ArrayLike,
        receivers: int,
        attributes: dict[str, Any],
    ) -> None:
        self.path = Path("echoes")
        self._axes = checked_axes(
            position=positions, rotation=rotations, split=split, range=range, frequency=frequency
        )
        self._attributes = plain_attributes(self.path, attributes)
        self._receivers = receivers
        self._heard: dict[int, Singles] = {}

    @property
    def receivers(self) -> int:
        """Number of receivers."""
        return self._receivers

    def update_attributes(self, **values: Any) -> None:
        """Set attributes, all at once."""
        self._attributes = plain_attributes(self.path, {**self._attributes, **values})

    def read_pose(self, index: int) -> Singles:
        """Return one pose's magnitude, (E, R, F), linear; raises as of the base class."""
        self._refuse_unknown(index)
        if index not in self._heard:
            raise InputError(f"{self.path}: pose {index} is missing; simulate it, or write it")
        return self._heard[index].copy()

    def write_pose(self, index: int, spectrogram: ArrayLike) -> None:
        """Keep one pose's magnitude, (E, R, F), linear; raises as of the base class."""
        self._heard[index] = self._checked(index, spectrogram).copy()

    def missing(self) -> list[int]:
        """Return the numbers of the poses that are not there."""
        return [index for index in np.arange(len(self)).tolist() if index not in self._heard]


def seal(
    ensemble: Ensemble, again: dict[int, Singles], *, silent: str, noise: Floats | None = None
) -> None:
    """Seal a complete ensemble: fix the reference of its decibels and its noise floor.

    In: noise ((E, F) or None).
    """
    loudest = max(float(ensemble.read_pose(int(i)).max()) for i in ensemble.indices("train"))
    if loudest <= 0.0:
        raise NumericalError(silent)
    reference = loudest * 10.0 ** (-RANGE_DB / 20.0)
    floor: dict[str, float | None] = {"noise_floor_mae_db": None, "noise_floor_mae_db_active": None}
    if again:
        first = compress(np.stack([ensemble.read_pose(i) for i in again]), reference)
        second = compress(np.stack(list(again.values())), reference)
        floor["noise_floor_mae_db"] = mae_db(first, second)
        level = active_level(noise, reference)
        floor["noise_floor_mae_db_active"] = mae_db(first, second, active=True, active_db=level)
    if noise is not None:
        ensemble.update_attributes(noise=noise.tolist())
    ensemble.update_attributes(reference=reference, **floor)
