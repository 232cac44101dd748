# SPDX-License-Identifier: MIT
"""The echoes of a scene at many poses, in memory or on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf import __version__, storage
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import Ensemble, MemoryEnsemble, seal, split_of
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, expect
from sononerf.geometry.poses import Poses
from sononerf.head.call import attach, call_content
from sononerf.head.ears import directivity_content
from sononerf.head.head import Head
from sononerf.head.reception import warn_of_call
from sononerf.numerics import Floats, Singles
from sononerf.progress import Progress
from sononerf.resources import check_scheduler, require_disk
from sononerf.scene.scene import Scene, check_aim, check_positions, check_reach, deaf
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.simulator import (
    MAX_RAYS,
    VERSION,
    SeedOf,
    Simulator,
    pose_seed,
    settle_rays,
    simulated,
)

Write = Callable[[int, Singles], None]
HASHED_SECTIONS = ("simulation", "air", "ears", "call", "noise", "spectrogram")
"""Sections of the settings that the echoes depend on."""
LEAST_BYTES = 2.0
"""Space of one cell of a spectrogram on disk, bytes: compressed stores have 2.2 to 2.9."""


def simulate(
    scene: Scene,
    poses: Poses,
    head: Head | None = None,
    *,
    split: ArrayLike | None = None,
    output: Path | str | None = None,
    options: SimulationSettings | Mapping[str, Any] | None = None,
    about: Mapping[str, Any] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Echoes:
    """Simulate the echoes of a scene that a head hears at poses.

    The same call resumes an interrupted ensemble on disk, and opens a complete one.

    Args:
        scene: The ensonified scene.
        poses: Poses of the head, P of them.
        head: The head; the default head by default.
        split (P,): Use of each pose: ``"train"``, ``"val"`` or ``"test"``, or 0, 1, 2. Where
            None, a twentieth of the poses validates and a tenth is held out (10 and 20 at most),
            drawn at random with seed 0.
        output: Folder of the store. The echoes are kept in memory by default.
        options: Engine, accuracy and seed: keys of the section ``simulation`` of the settings, such
            as ``{"accuracy_db": 0.4, "bounces": 1, "seed": 1}``.
        about: Further attributes of the ensemble, plain data.
        workers: Processes; as many as there are cores, at most 8, by default.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Display of progress; on stderr by default.

    Returns:
        echoes: Complete.

    Raises:
        InputError: If a pose is inside the scene, the poses are too few to split, or an argument
            is of another kind.
        SettingsError: If an option is not allowed.
        NumericalError: If no pose hears anything.
        StorageError: If the store cannot be written.
        IncompatibleError: If the folder holds another ensemble.
    """
    progress = progress or Progress()
    head = Head() if head is None else head
    expect(scene, Scene, "scene")
    expect(poses, Poses, "poses")
    expect(head, Head, "head")
    settings = checked_section(SimulationSettings, options or {}, "simulation")
    purposes = split_of(poses, split)
    echoes_id = echo_hash(scene, poses, purposes, head, settings)
    path = None if output is None else Path(output)
    if path is not None and (finished := _finished(path, echoes_id)) is not None:
        return Echoes(finished, head)
    if scheduler is not None:
        check_scheduler(scheduler)
    warn_of_call(head.call, head.spectrogram)
    simulator = Simulator(scene, head, settings)
    offsets = np.vstack((head.emitter, head.receivers))
    check_positions(scene, poses, offsets=offsets, plane=head.plane)
    check_aim(scene, poses, is_directional=head.ears.is_directional)
    check_reach(
        scene,
        poses,
        bounces=settings.bounces,
        range_min=head.spectrogram.range_min,
        range_max=head.spectrogram.range_max,
    )
    if path is not None:
        storage.remove_if_empty(storage.probe_writable(path))
        cells = len(poses) * len(head.receivers) * len(head.range) * len(head.frequency)
        require_disk(
            LEAST_BYTES * cells,
            path,
            f"{path}: the echoes of {len(poses):,} poses",
            "lower poses.count, or choose another disk with --output",
        )
    if simulator.note:
        progress.say(f"echoes: {simulator.note}")
    given: dict[str, Any] = {
        "split": purposes,
        "range": head.range,
        "frequency": head.frequency,
        "attributes": _attributes(echoes_id, scene, head, settings, about or {}),
        "receivers": len(head.receivers),
    }
    how: dict[str, Any] = {"workers": workers, "scheduler": scheduler, "progress": progress}
    if path is None:
        kept = MemoryEnsemble(positions=poses.positions, rotations=poses.rotations, **given)
        _fill(kept, simulator, poses, settings, **how)
        return Echoes(kept, head)
    with storage.lock(path):
        store = EnsembleStore.create(
            path, positions=poses.positions, rotations=poses.rotations, **given
        )
        store.remove_damaged()
        attach(head, path)
        _fill(store, simulator, poses, settings, **how)
    return Echoes(EnsembleStore.open(path), head)


def _finished(path: Path, echoes_id: str) -> EnsembleStore | None:
    """Return the store of a folder if it is complete; refuse one of other echoes."""
    if not (path / "zarr.json").is_file():
        return None
    store = EnsembleStore.open(path)
    if store.attributes.get("echo_hash") != echoes_id:
        raise IncompatibleError(
            f"{path}: holds echoes of other settings; choose another --output, or leave the scene "
            "out of the settings to take the echoes as they are"
        )
    if not store.is_sealed or store.damaged():
        return None
    return store


def echo_hash(
    scene: Scene, poses: Poses, split: NDArray[np.int8], head: Head, options: SimulationSettings
) -> str:
    """Return a hash of all inputs of the echoes.

    Poses count by their values: another table with the same poses gives the same ensemble.
    """
    plain = _heard_settings(head, options)
    digest = hashlib.sha256(f"simulator {VERSION}".encode())
    digest.update(json.dumps([plain[name] for name in HASHED_SECTIONS], sort_keys=True).encode())
    if head.plane is not None:
        digest.update(repr(head.plane).encode())
    for values in (poses.positions, poses.rotations):
        # The last bits of a sine are the processor's own; adding zero makes -0 the same as 0.
        digest.update((np.round(values, 9) + 0.0).astype("<f8").tobytes())
    digest.update(split.tobytes())
    digest.update(np.ascontiguousarray(scene.mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(scene.mesh.faces, dtype="<i8").tobytes())
    digest.update(repr(scene.material).encode())
    if scene.part is not None:
        digest.update(scene.part.astype("<i8").tobytes())
    return digest.hexdigest()


def _heard_settings(head: Head, options: SimulationSettings) -> dict[str, Any]:
    """Return the settings that the echoes depend on, without optional keys that do not apply."""
    plain = {**_plain(head, options), "call": call_content(head.call)}
    ears, air, spectrogram = plain["ears"], plain["air"], plain["spectrogram"]
    if spectrogram["kind"] == "stft":
        for key in ("kind", "channels", "q"):
            del spectrogram[key]
    if plain["simulation"]["rays"] is not None:
        del plain["simulation"]["accuracy_db"]
    if ears["directivity"] != "piston":
        del ears["piston_radius"]
    for section, key, default in (
        (air, "speed_of_sound", None),
        (ears, "receivers", None),
        (ears, "file", None),
        (ears, "directivity", "ear"),
    ):
        if section[key] == default:
            del section[key]
    if "file" in ears:
        # A measured directivity counts by its content, not by its path.
        ears["file"] = directivity_content(head.ears)
    return plain


def _plain(head: Head, options: SimulationSettings) -> dict[str, Any]:
    return {"simulation": options.model_dump(mode="json"), **head.plain()}


def _attributes(
    echoes_id: str, scene: Scene, head: Head, options: SimulationSettings, about: Mapping[str, Any]
) -> dict[str, Any]:
    further = dict(about)
    if scene.to_original is not None:
        further["to_original"] = scene.to_original.tolist()
    sections = {**further.pop("settings", {}), **_plain(head, options)}
    return {
        "echo_hash": echoes_id,
        "origin": "simulated",
        "settings": sections,
        "speed_of_sound": head.speed_of_sound,
        "units": {
            "spectrogram": "linear magnitude, sound pressure over that of the call at 1 m",
            "position": "m",
            "range": "m",
            "frequency": "Hz",
        },
        "sononerf": __version__,
        **further,
    }


def _fill(
    store: Ensemble,
    simulator: Simulator,
    poses: Poses,
    options: SimulationSettings,
    *,
    workers: int | None,
    scheduler: str | None,
    progress: Progress,
) -> None:
    """Simulate the missing poses of a store, and seal it.

    The test poses are simulated twice, with other rays, which gives the noise floor.
    """
    missing = store.missing()
    test = store.indices("test")[: options.noise_floor_poses]
    again: dict[int, Singles] = {}
    wanted = [*missing, *test]
    simulator.prepare(poses.positions[wanted], poses.rotations[wanted], progress)
    known = store.attributes.get("rays")
    if options.rays is None and isinstance(known, int) and 0 < known <= MAX_RAYS:
        # An interrupted simulation continues with its initial number of rays.
        options = options.model_copy(update={"rays": known})
    here = 1 if scheduler is not None else workers
    rays = settle_rays(simulator, poses, options, progress, workers=here)
    store.update_attributes(rays=rays)
    if len(test):
        progress.say(
            f"simulating {len(missing)} poses, and {len(test)} held-out ones again with other "
            "rays: the difference is the noise floor"
        )
    with progress.task("simulating", len(missing) + len(test)) as task:
        # The second simulation of the test poses goes first where it can share the processes.
        def keep(index: int, spectrogram: Singles) -> None:
            if index < len(poses):
                store.write_pose(index, spectrogram)
            else:
                again[int(test[index - len(poses)])] = spectrogram
            task.advance()

        both = Poses(
            np.concatenate((poses.positions, poses.positions[test])),
            np.concatenate((poses.rotations, poses.rotations[test])),
        )
        extra = range(len(poses), len(poses) + len(test))
        simulate_ensemble(
            simulator,
            both,
            [*missing, *extra],
            keep,
            # A pose's seed is a function of its number, so the second time has other rays.
            seed_of=partial(pose_seed, options.seed),
            workers=workers,
            scheduler=scheduler,
        )
    limits = simulator.head.spectrogram
    silent = deaf(limits.range_min, limits.range_max)
    seal(store, {int(i): again[int(i)] for i in test}, silent=silent)


def simulate_ensemble(
    simulator: Simulator,
    poses: Poses,
    indices: Iterable[int],
    write: Write,
    *,
    seed_of: SeedOf,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Simulate poses and hand over each spectrogram as it comes.

    The result of a pose depends on its seed alone, not on workers or order.
    """
    wanted = [int(index) for index in indices]
    results = simulated(simulator, poses, wanted, seed_of, workers=workers, scheduler=scheduler)
    # Closed at once if a write fails: processes elsewhere end before the error is reported.
    with closing(results):
        for index, spectrogram in results:
            write(index, spectrogram)


def spectrograms(
    simulator: Simulator,
    positions: Floats,
    rotations: Floats,
    *,
    seed: int,
    done: Callable[[], None] | None = None,
) -> Singles:
    """Return the spectrograms of poses (P, E, R, F), linear magnitude, with the same rays for each.

    In: positions ((P, 3), m), rotations (P, 3, 3).
    """
    by_pose: dict[int, Singles] = {}

    def keep(index: int, spectrogram: Singles) -> None:
        by_pose[index] = spectrogram
        if done is not None:
            done()

    poses = Poses(positions, rotations)
    simulate_ensemble(simulator, poses, range(len(poses)), keep, seed_of=lambda _: seed)
    return np.stack([by_pose[index] for index in range(len(poses))])
