# SPDX-License-Identifier: MIT
"""Examples for the start network: levels over range and true signed distance of a body.

A body is stored once, as levels. Poses, noise, orientation and crop are drawn at each step of the
training.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy import ndimage

import sononerf
from sononerf import storage
from sononerf.echoes.detection import RangeLevels
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import SonoNerfError
from sononerf.evaluation.metrics import Solid
from sononerf.geometry.lattice import Lattice
from sononerf.numerics import Floats, Ints, Singles
from sononerf.progress import Progress
from sononerf.start.features import PlaceFeatures, features_of, free_places
from sononerf.start.network import PAIRS, lattice_of
from tools.learning.bodies import body

Axes = tuple[int, ...]
FAR = 6.0
"""Distance at which the true signed distance is clipped, voxels."""
POSES, VALIDATING = 160, 2
"""Number of simulated poses, and how many of them are for validation."""
DB, STEPS = 0.5, 20
"""Step of a stored level, dB, and number of steps of a stored distance per voxel."""
LARGEST = 4_000_000
"""Number of voxels above which a body is left out, because its region was found too large."""
LEAST_DEPTH = 0.7
"""Depth of the true signed distance in the thinnest bodies, voxels: a sheet that is thinner than a
voxel would have no place inside."""
LOWER_BAND = {"frequency_min": 20e3, "frequency_max": 50e3}
"""Band of every third head, Hz; the others have the default one. Lengths are in range resolutions,
so that other bands are bodies of other sizes."""
FEWEST, LEAST = 20, 12
"""Number of poses, at least, where some are drawn at random, and where those of one side are."""


@dataclass(frozen=True, eq=False)
class Example:
    """One body.

    Attributes:
        levels: Levels of the echoes.
        onsets ((P, E), m): Minus infinity without one.
        lattice: The voxels of the truth.
        true ((X, Y, Z), voxels): Signed distance.
        kind: Kind of the body.
        number: Its number.
    """

    levels: RangeLevels
    onsets: Floats
    lattice: Lattice
    true: Singles
    kind: str
    number: int


def make_example(number: int, folder: Path, meshes: Path | None = None) -> str:
    """Make the example of a number, unless it is there; return a line that tells of it.

    Args:
        number: Seed of poses and rays, and of the body; or the number of a mesh.
        folder: Folder of the examples; the file is ``NUMBER.npz``.
        meshes: Folder of closed bodies, m, taken in the order of their names; procedural bodies
            where None.
    """
    file = folder / f"{number}.npz"
    if file.is_file():
        return f"{number}: is there"
    if meshes is None:
        kind, mesh = body(number)
    else:
        source = sorted(meshes.glob("*.ply"))[number]
        kind, mesh = source.stem, trimesh.load_mesh(source)
    try:
        echoes = heard(mesh, number)
        lattice = lattice_of(echoes.hull, echoes.region.box(), echoes.head.resolution)
    except SonoNerfError as error:
        return f"{number}: {kind}: {error}"
    if lattice is None or np.prod(lattice.shape) > LARGEST:
        return f"{number}: {kind}: its region was found too large, or not at all"
    levels = echoes.levels
    stored = {
        "level": np.round(-levels.level / DB).astype(np.uint8),
        "emitters": levels.emitters.astype(np.float32),
        "receivers": levels.receivers.astype(np.float32),
        "onsets": echoes.hull.inlier_onsets[levels.poses].astype(np.float32),
        "axis": np.array([levels.first, levels.spacing, levels.resolution]),
        "lattice": np.array([*lattice.origin, lattice.spacing]),
        "true": np.round(STEPS * true_distance(mesh, lattice)).astype(np.int8),
    }
    storage.make_folder(folder)
    storage.commit(file, lambda opened: np.savez_compressed(opened, kind=kind, **stored))
    return f"{number}: {kind}, {lattice.shape}"


def heard(mesh: trimesh.Trimesh, seed: int) -> sononerf.Echoes:
    """Return the echoes of a body from poses all around it, by few rays, heard by a head."""
    random = np.random.default_rng([75, seed])
    radius = max(0.4, 2.2 * float(mesh.extents.max()))
    poses = sononerf.Poses.sphere(
        POSES, radius=radius, aim_jitter=0.26, generator=np.random.default_rng(seed)
    )
    ears = {}
    if random.random() < 0.4:
        count = int(random.integers(1, 5))
        ears = {"receivers": random.uniform(-0.03, 0.03, (count, 3)).round(4).tolist()}
    spectrogram = {"range_max": radius + 0.2}
    if random.random() < 0.3:
        spectrogram |= LOWER_BAND
    rays = int(random.integers(4000, 9000))
    return sononerf.simulate(
        sononerf.Scene(mesh),
        poses,
        sononerf.Head(ears=ears, spectrogram=spectrogram),
        split=np.where(np.arange(POSES) < VALIDATING, "val", "train"),
        options={"engine": "rays", "rays": rays, "seed": seed, "noise_floor_poses": 0},
        workers=1,
        progress=Progress(quiet=True),
    )


def true_distance(mesh: trimesh.Trimesh, lattice: Lattice) -> Singles:
    """Return the signed distance to a closed mesh, (X, Y, Z) voxels, positive outside.

    A body that is thinner than the voxels show is made ``LEAST_DEPTH`` deep.
    """
    solid, places = Solid(mesh), lattice.points()
    near = solid.nearest.near(places, FAR * lattice.spacing)
    distance = np.full(len(places), FAR)
    distance[near] = np.minimum(solid.nearest.distance(places[near]) / lattice.spacing, FAR)
    signed = np.where(solid.contains(places), -distance, distance).reshape(lattice.shape)
    deepest = ndimage.minimum_filter(signed, 5)
    nearest = ndimage.distance_transform_edt(
        np.abs(signed) > 0.9, return_distances=False, return_indices=True
    )
    missing = (deepest + LEAST_DEPTH).clip(0.0, LEAST_DEPTH)[tuple(nearest)]
    return (signed - missing).astype(np.float32)


def load_example(file: Path) -> Example:
    """Return the example of a file."""
    with np.load(file) as stored:
        found: dict[str, Any] = {name: stored[name] for name in stored.files}
    first, spacing, resolution = (float(number) for number in found["axis"])
    *origin, voxel = (float(number) for number in found["lattice"])
    x, y, z = found["true"].shape
    levels = RangeLevels(
        np.arange(len(found["emitters"])),
        found["emitters"].astype(np.float64),
        found["receivers"].astype(np.float64),
        -DB * found["level"].astype(np.float32),
        first,
        spacing,
        resolution,
    )
    return Example(
        levels,
        found["onsets"].astype(np.float64),
        Lattice(np.array(origin), voxel, (x, y, z)),
        found["true"].astype(np.float32) / STEPS,
        str(found["kind"]),
        int(file.stem),
    )


@dataclass(frozen=True, eq=False)
class Crop:
    """A part of a body.

    Attributes:
        places: Features of its places.
        true ((2X, 2Y, 2Z), voxels): Signed distance, two voxels per place and axis.
    """

    places: PlaceFeatures
    true: Singles

    def turned(self, order: Axes, signs: Axes) -> tuple[Singles, Singles, Singles]:
        """Return features, bound and truth in a turned or mirrored frame.

        Args:
            order: Axis of the crop that becomes each axis of the frame.
            signs: -1 for the axes of the frame that point backwards.
        """
        back = tuple(axis for axis, sign in enumerate(signs) if sign < 0)
        true = np.ascontiguousarray(np.flip(self.true.transpose(order), back))
        return *self.places.in_frame(order, signs), true


def draw(example: Example, random: np.random.Generator, side: int) -> Crop:
    """Return a crop of a body, heard by some of its poses and turned or mirrored at random.

    Args:
        example: The body.
        random: Generator.
        side: Number of places along each axis.
    """
    lattice = example.lattice
    size = lattice.spacing * np.asarray(lattice.shape)
    room = np.maximum(size - 2 * side * lattice.spacing, 0) / 2 + 8 * lattice.spacing
    centre = lattice.origin + size / 2 + 0.7 * room * random.uniform(-1, 1, 3)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]  # some of them mirror
    ears = _ears(example, random)
    some = _poses(example, random)
    if len(some) * len(ears) > PAIRS:
        some = np.sort(random.choice(some, PAIRS // len(ears), replace=False))
    levels = dataclasses.replace(
        example.levels,
        emitters=(example.levels.emitters - centre) @ turn.T,
        receivers=(example.levels.receivers[:, ears] - centre) @ turn.T,
        level=_noisy(example.levels.level[:, ears], random),
    )
    axes = np.zeros((len(example.onsets), 3))
    hull = EchoHull(levels.emitters, levels.receivers, example.onsets[:, ears], axes)
    crop = Lattice(
        np.full(3, -(2 * side - 1) / 2 * lattice.spacing), lattice.spacing, (2 * side,) * 3
    )
    places = features_of(levels, some, hull, crop, free_places(hull, crop))
    at = lattice.coordinates(crop.points() @ turn + centre).T
    true = ndimage.map_coordinates(example.true, at, order=1, mode="constant", cval=FAR)
    return Crop(places, true.reshape(crop.shape))


def _ears(example: Example, random: np.random.Generator) -> Ints:
    """Return all ears, or some of them."""
    count = example.onsets.shape[1]
    some = count if random.random() < 0.7 else int(random.integers(1, count + 1))
    return np.sort(random.choice(count, some, replace=False))


def _poses(example: Example, random: np.random.Generator) -> Ints:
    """Return all poses, few of them, those of one side, or those of a belt."""
    emitters = example.levels.emitters
    count, which = len(emitters), random.random()
    if which < 0.35:
        return np.arange(count)
    if which < 0.65:
        few = min(FEWEST, count)
        few = int(few * (count / few) ** np.sqrt(random.random()))
        return np.sort(random.choice(count, few, replace=False))
    way = random.normal(size=3)
    along = trimesh.unitize(emitters) @ (way / np.linalg.norm(way))
    if which < 0.8:
        some = np.flatnonzero(along > random.uniform(-0.5, 0.6))
    else:
        wide = random.uniform(0.1, 0.5)
        some = np.flatnonzero(np.abs(along - random.uniform(-0.2, 0.5)) < wide)
    return some if len(some) >= LEAST else np.arange(count)


def _noisy(level: Singles, random: np.random.Generator) -> Singles:
    """Return levels with noise of 15 to 40 dB below the loudest one, three times of ten."""
    if random.random() > 0.3:
        return level
    noise = 10 ** random.uniform(-4, -1.5) * random.exponential(size=level.shape)
    return (10 * np.log10(10 ** (level / 10) + noise)).astype(np.float32)
