# SPDX-License-Identifier: MIT
"""Examples for the start network: evidence and true signed distance of procedural bodies.

Each body goes through the whole pipeline: simulated echoes, a short fit, evidence of the field.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import trimesh

import sononerf
from sononerf import storage
from sononerf.array_types import Singles
from sononerf.errors import SonoNerfError
from sononerf.evaluation.solid import Solid
from sononerf.geometry.lattice import Lattice
from sononerf.progress import Progress
from sononerf.surface.start.learned import features, lattice_of
from sononerf.surface.start.read_out import read_field
from tools.learning.bodies import body

FAR = 6.0
"""Distance at which the true signed distance is clipped, voxels."""
EPOCHS = 6
"""Epochs of a fit; a third of the default saves most of the time."""
FEWEST, MOST = 25, 500
"""Number of poses: drawn between these, half of the time above 200, because 400 are usual."""
QUIETEST_DB, LOUDEST_DB = 20.0, 40.0
"""Signal-to-noise ratio of the bodies that are heard in noise, dB."""
NOISY = 0.3
"""Fraction of the bodies that are heard in noise."""
MANY = 1_400_000
"""Number of voxels above which a body is left out, because its region was found too large."""


def make_example(seed: int, folder: Path) -> str:
    """Make the example of a seed, unless it is there; return a line that tells of it.

    Args:
        seed: Seed of body, poses, noise and fit.
        folder: Folder of the examples; the file is ``SEED.npz``.
    """
    file = folder / f"{seed}.npz"
    if file.is_file():
        return f"{seed}: is there"
    random = np.random.default_rng([47, seed])
    kind, mesh = body(seed)
    count = int(FEWEST * (MOST / FEWEST) ** math.sqrt(random.random()))
    noisy = random.random() < NOISY
    snr = random.uniform(QUIETEST_DB, LOUDEST_DB)
    head = sononerf.Head(noise={"snr_db": float(snr)} if noisy else {})
    poses = sononerf.Poses.sphere(
        count, radius=0.4, aim_jitter=0.26, generator=np.random.default_rng(seed)
    )
    options = {"engine": "rays", "rays": int(random.integers(4000, 9000)), "seed": seed}
    quiet = Progress(quiet=True)
    try:
        echoes = sononerf.simulate(
            sononerf.Scene(mesh),
            poses,
            head,
            split=np.where(np.arange(count) < 2, "val", "train"),
            options={**options, "noise_floor_poses": 0},
            workers=1,
            progress=quiet,
        )
        model = sononerf.EchoModule.for_echoes(echoes, options={"epochs": EPOCHS, "seed": seed})
        model = sononerf.fit(echoes, model, accelerator="cpu")
        with torch.inference_mode():
            reading = read_field(
                model.field,
                echoes.hull,
                resolution=echoes.head.resolution,
                levels=echoes.levels,
            )
    except SonoNerfError as error:
        return f"{seed}: {kind}, {count} poses: {error}"
    known = reading.gathered
    lattice = lattice_of(known)
    if lattice is None or np.prod(lattice.shape) > MANY:
        return f"{seed}: {kind}, {count} poses: its region was found too large, or not at all"
    seen = features(known, lattice).astype(np.float16)
    true = true_distance(mesh, lattice).astype(np.float16)

    storage.make_folder(folder)
    storage.commit(file, lambda opened: np.savez(opened, seen=seen, true=true, kind=kind))
    return f"{seed}: {kind}, {count} poses, {len(known.evidence.points)} points, {lattice.shape}"


def true_distance(mesh: trimesh.Trimesh, lattice: Lattice) -> Singles:
    """Return the signed distance to a closed mesh, (X, Y, Z) voxels, positive outside."""
    solid, places = Solid(mesh), lattice.points()
    near = solid.nearest.near(places, FAR * lattice.spacing)
    distance = np.full(len(places), FAR)
    distance[near] = np.minimum(solid.nearest.distance(places[near]) / lattice.spacing, FAR)
    signed = np.where(solid.contains(places), -distance, distance)
    return signed.reshape(lattice.shape).astype(np.float32)
