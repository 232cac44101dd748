# SPDX-License-Identifier: MIT
"""Echoes: what was heard at many poses, and what follows from it before anything is learned.

In: a store or arrays, with a head. Out: magnitudes (P, E, R, F), poses, splits, and, each at first
use, onsets, free space, region and levels over range. Sections 1 and 2 of ``docs/method.md``.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from sononerf import storage
from sononerf.display import NotebookRepr, Picture, picture_of
from sononerf.echoes.detection import (
    Onsets,
    RangeLevels,
    evenly_chosen,
    find_onsets,
    poses_in_use,
    seal_recorded,
)
from sononerf.echoes.free_space import EchoHull, weighted
from sononerf.echoes.memory_ensemble import Ensemble, MemoryEnsemble, repeats, seal, split_of
from sononerf.echoes.region import WITNESS_GAIN, EchoRegion
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, SettingsError, expect
from sononerf.geometry.poses import Poses
from sononerf.head.call import attach, attached
from sononerf.head.front_end import active_level
from sononerf.head.head import Head
from sononerf.numerics import Floats, Ints, Singles
from sononerf.settings.schema import HEAD_SECTIONS

if TYPE_CHECKING:  # simulation starts without it
    from torch import Tensor

KEPT_BYTES = 400_000_000
"""Size of the spectrograms that stay in memory, bytes; further ones are read at each use."""
SAME_POSE = 1e-6
"""Poses are the same if positions (m) and rotations differ by no more."""
Split = Literal["train", "val", "test"]
HELD_BACK = 10
"""Without validation poses, one of this many training poses validates the refinement."""


class Echoes(NotebookRepr):
    """The spectrograms of an ensemble of poses, and the head that heard them.

    Make them with :func:`sononerf.simulate`, :func:`sononerf.read_recordings`,
    :meth:`from_arrays` or :meth:`open`.

    Args:
        store: Poses, splits, axes and spectrograms, in memory or on disk.
        head: The head that heard them.
        hull: The free space, if known; from the onsets by default.
        box ((2, 3), m): Lower and upper corner of where the body must be, see :meth:`within`.

    Attributes:
        positions ((P, 3), m): Places of the head, world frame.
        rotations (P, 3, 3): Head to world.
        training, validation (...,): Poses that a surface is refined on and compared on. Where the
            store has no validation poses, some of its training poses validate.
    """

    def __init__(
        self, store: Ensemble, head: Head, hull: EchoHull | None = None, box: Floats | None = None
    ) -> None:
        self.store, self.head, self.box = store, head, box
        self.positions, self.rotations = store.positions, store.rotations
        training, validation = store.indices("train"), store.indices("val")
        if not len(validation) and len(training) > 1:
            held = np.arange(len(training)) % HELD_BACK == HELD_BACK // 2
            held[len(training) // 2] = True
            training, validation = training[~held], training[held]
        self.training, self.validation = training, validation
        self._kept: dict[int, Tensor] = {}
        self._bytes = 0
        if hull is not None:
            self.hull = hull

    @classmethod
    def from_arrays(
        cls,
        spectrograms: ArrayLike,
        poses: Poses,
        head: Head,
        *,
        split: ArrayLike | None = None,
        calibrated: bool = False,
    ) -> Echoes:
        """Return echoes in memory from spectrograms of your own.

        Args:
            spectrograms (P, E, R, F): Linear magnitude over the ranges ``head.range`` and the
                frequencies ``head.frequency``.
            poses: P of them.
            head: The head that heard them.
            split (P,): Use of each pose: ``"train"``, ``"val"`` or ``"test"``, or 0, 1, 2.
                Where None, a twentieth of the poses validates and a tenth is held out (10 and 20 at
                most), drawn at random with seed 0.
            calibrated: True if magnitudes are sound pressure over that of the call at 1 m. Else one
                gain is learned.

        Raises:
            InputError: If shapes do not fit, or a magnitude is negative.
            NumericalError: If a magnitude is NaN or infinite, or all training poses are silent.
        """
        expect(poses, Poses, "poses")
        expect(head, Head, "head")
        given = np.asarray(spectrograms)
        axes = len(head.receivers), len(head.range), len(head.frequency)
        if given.shape != (len(poses), *axes):
            raise InputError(
                f"spectrograms have shape {given.shape}, expected (poses, receivers, ranges, "
                f"frequencies) {(len(poses), *axes)}, as poses and head say"
            )
        if given.dtype.kind not in "fiub":
            raise InputError(f"spectrograms are {given.dtype}, expected real magnitudes")
        bad = np.flatnonzero((given < 0).any(axis=(1, 2, 3)))
        if len(bad):
            raise InputError(
                f"spectrograms: pose {bad[0]} has magnitudes below 0; give linear magnitude, not "
                "decibels"
            )
        digest = hashlib.sha256(given.astype("<f4").tobytes())
        for part in (poses.positions, poses.rotations):
            digest.update(part.astype("<f8").tobytes())
        purposes = split_of(poses, split)
        store = MemoryEnsemble(
            positions=poses.positions,
            rotations=poses.rotations,
            split=purposes,
            range=head.range,
            frequency=head.frequency,
            receivers=axes[0],
            attributes={
                "echo_hash": digest.hexdigest(),
                "origin": "simulated" if calibrated else "recorded",
                "settings": head.plain(),
                "speed_of_sound": head.speed_of_sound,
            },
        )
        for index, spectrogram in enumerate(given):
            store.write_pose(index, spectrogram)
        silent = "spectrograms: all training poses are silent"
        if calibrated:
            pairs = repeats(poses, purposes)
            again = {index: store.read_pose(other) for index, other in pairs.items()}
            seal(store, again, silent=silent)
        else:
            seal_recorded(store, head, poses, purposes, silent=silent)
        return cls(store, head)

    @classmethod
    def open(cls, path: Path | str) -> Echoes:
        """Open a store of which nothing is missing; spectrograms are read when they are needed.

        Args:
            path: Folder that ``simulate``, ``import`` or :meth:`save` wrote.

        Raises:
            InputError: If there is no store, a pose is missing, or it does not state its head.
            IncompatibleError: If another version of the format wrote it.
        """
        store = complete_store(Path(path))
        sections = stated_head(store)
        try:
            head = Head.from_plain(sections)
            copies = attached(head, store.path)
        except SettingsError as error:
            raise InputError(f"{path}: states a head that cannot be used: {error}") from None
        return cls(store, dataclasses.replace(head, **copies) if copies else head)

    def save(self, path: Path | str) -> None:
        """Write the echoes into a folder that :meth:`open` and every command take.

        Args:
            path: Not there, empty, or a store of the same echoes.

        Raises:
            IncompatibleError: If the folder holds other echoes.
            StorageError: If it cannot be written.
        """
        path, mine = Path(path), self.store
        storage.probe_writable(path)
        with storage.lock(path):
            written = EnsembleStore.create(
                path,
                positions=mine.positions,
                rotations=mine.rotations,
                split=mine.split,
                range=mine.range,
                frequency=mine.frequency,
                attributes=mine.attributes,
                receivers=mine.receivers,
            )
            attach(self.head, path)
            for index in written.missing():
                written.write_pose(index, mine.read_pose(index))

    def within(self, box: ArrayLike) -> Echoes:
        """Return the same echoes of a body that lies within a box.

        Echoes that arrive earlier than any from the box are clutter, not onsets. An onset whose
        origin cannot lie in the box is an outlier.

        Args:
            box ((2, 3), m): Lower and upper corner, world frame.

        Raises:
            InputError: If the corners are not those of a box.
        """
        corners = np.asarray(box, dtype=np.float64)
        if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
            raise InputError(
                f"box: found {corners.tolist()}, expected a lower and an upper corner of three "
                "numbers each, m, the lower one below the upper one on every axis"
            )
        other = copy.copy(self)
        other.box = corners
        for known in ("onsets", "hull", "region"):
            other.__dict__.pop(known, None)
        return other

    def __len__(self) -> int:
        return len(self.store)

    def poses(self, split: Split | None = None) -> Poses:
        """Return the poses of a split; all of them by default."""
        some = slice(None) if split is None else self.store.indices(split)
        return Poses(self.positions[some], self.rotations[some])

    def numbers_of(self, poses: Poses) -> Ints:
        """Return the numbers (P,) of these poses in the ensemble.

        Raises:
            InputError: If one is not among them.
        """
        mine, theirs = (
            np.concatenate((each.positions, each.rotations.reshape(-1, 9)), axis=1)
            for each in (self.poses(), poses)
        )
        distance, number = cKDTree(mine).query(theirs)
        strange = np.flatnonzero(distance > SAME_POSE)
        if len(strange):
            raise InputError(
                f"{self.store.path}: pose {strange[0]} is not among the {len(self)} poses of these "
                "echoes; nothing was measured there"
            )
        return np.asarray(number, dtype=np.int64)

    def spectrogram(self, pose: int) -> Singles:
        """Return the spectrogram of a pose, (E, R, F) linear magnitude.

        The axes are ``head.range`` (m) and ``head.frequency`` (Hz).

        Raises:
            InputError: If there is no such pose, or it is damaged.
        """
        return self.store.read_pose(pose)

    def plot(self, pose: int, prediction: object = None) -> Picture:
        """Return a picture of a pose's spectrogram, in decibels over range and frequency.

        Args:
            pose: Its number.
            prediction: A :class:`sononerf.Prediction` that has this pose; it is drawn beside, with
                the difference.

        Raises:
            InputError: If there is no such pose.
        """
        return picture_of(self, pose=pose, prediction=prediction)

    @property
    def reference(self) -> float:
        """Magnitude m0 that reported decibels refer to."""
        return float(self.store.attributes["reference"])

    @property
    def active_db(self) -> float | Floats:
        """Level from which a cell is active, dB: one number, or (E, 1, F) above noise."""
        return active_level(self.store.attributes.get("noise"), self.reference)

    @property
    def calibrated(self) -> bool:
        """True if levels are absolute; those of a recording depend on its amplifier."""
        return bool(self.store.attributes.get("origin") == "simulated")

    @cached_property
    def onsets(self) -> Onsets:
        """Echoes that are detected at the training poses."""
        nearest = None
        if self.box is not None:
            poses = poses_in_use(self.store)
            emitters, ears = self.head.places(self.positions[poses], self.rotations[poses])
            off = (emitters[:, None], ears)
            distances = [np.linalg.norm(p - p.clip(*self.box), axis=-1) for p in off]
            nearest = sum(distances) / 2.0 - self.head.resolution
        return find_onsets(self.store, self.head.point_echo, nearest=nearest)

    @cached_property
    def hull(self) -> EchoHull:
        """Space that the onsets leave; outliers have weight zero."""
        onsets, head = self.onsets, self.head
        rotations = self.rotations[onsets.poses]
        emitters, receivers = head.places(self.positions[onsets.poses], rotations)
        hull = EchoHull(
            emitters=emitters,
            receivers=receivers,
            first=onsets.first - head.mean_lag,
            axes=rotations[:, :, 0],
            within=head.row_gains.cone(WITNESS_GAIN),
            plane=head.plane,
        )
        return weighted(hull, head.resolution, self.box)

    @cached_property
    def region(self) -> EchoRegion:
        """Places that the echoes leave possible."""
        rotations = self.rotations[self.onsets.poses]
        head = self.head
        return EchoRegion(
            self.onsets, self.hull, head.gains, rotations, head.resolution, head.point_echo.tail
        )

    @cached_property
    def bounds(self) -> Floats:
        """Lower and upper corner of where the body is, (2, 3) m: the box, or that of the region."""
        return self.region.box() if self.box is None else self.box

    @cached_property
    def levels(self) -> RangeLevels:
        """Levels of the training poses over range; of some of them where there are many."""
        head, all_ = self.head, self.onsets.poses
        some = evenly_chosen(len(all_), len(head.receivers))
        poses = all_[some]
        emitters, receivers = head.places(self.positions[poses], self.rotations[poses])
        return RangeLevels.of(
            (self.store.read_pose(int(pose)) for pose in poses),
            some,
            emitters,
            receivers,
            first=float(head.range[0]) - head.mean_lag,
            spacing=float(head.range[1] - head.range[0]),
            resolution=head.resolution,
        )

    def magnitude(self, number: int) -> Tensor:
        """Return the spectrogram of a pose as a tensor that is kept, (E, R, F) float32."""
        if number not in self._kept:
            import torch

            heard = torch.as_tensor(self.store.read_pose(number))
            size = heard.numel() * heard.element_size()
            if self._bytes + size > KEPT_BYTES:
                return heard
            self._kept[number] = heard
            self._bytes += size
        return self._kept[number]

    def batch(self, seed: int, step: int, size: int) -> Ints:
        """Return the training poses of a step: all in turn, in an order drawn from the seed."""
        count = len(self.training)
        size = min(size, count)
        uses = []
        for place in range(step * size, (step + 1) * size):
            order = np.random.default_rng([seed, place // count]).permutation(count)
            uses.append(self.training[order[place % count]])
        return np.array(uses, dtype=np.int64)


def complete_store(path: Path) -> EnsembleStore:
    """Open a store of which nothing is missing."""
    store = EnsembleStore.open(path)
    missing = store.missing()
    if missing or "reference" not in store.attributes:
        what = f"{len(missing)} poses are missing" if missing else "it is not finished"
        raise InputError(f"{path}: {what}; give the same simulate or import command again")
    return store


def stated_head(store: EnsembleStore) -> dict[str, dict[str, Any]]:
    """Return the sections of settings that describe the head of a store, plain data."""
    settings = store.attributes.get("settings")
    if isinstance(settings, dict):
        settings = {"support": {}, **settings}  # older stores know of no support
    if not isinstance(settings, dict) or not all(
        isinstance(settings.get(k), dict) for k in HEAD_SECTIONS
    ):
        raise InputError(
            f"{store.path}: does not state its head (settings of {', '.join(HEAD_SECTIONS)}); "
            "import the recordings again"
        )
    return {name: settings[name] for name in HEAD_SECTIONS}
