# SPDX-License-Identifier: MIT
"""From settings to a sealed ensemble of echoes, or to what microphones would have recorded."""

from __future__ import annotations

import glob
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sononerf import __version__, storage
from sononerf.echoes.echoes import SubtractedStore
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.head.call import call_content
from sononerf.head.ears import directivity_content
from sononerf.head.reception import warn_of_call
from sononerf.progress import Progress
from sononerf.recordings.audio import pose_table, wav_bytes
from sononerf.run.build import attach, complete_store, head_of, simulator_of
from sononerf.run.understand import OWN_SETTINGS
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.schema import HEAD_SECTIONS, Settings
from sononerf.simulation.accuracy import settle_rays
from sononerf.simulation.ensemble import check_poses, check_reach
from sononerf.simulation.ensemble import simulate as simulate_poses
from sononerf.simulation.simulator import VERSION, Simulator, ensemble_poses, pose_seed

SHARD = ".shard-"
"""What follows the name of an ensemble's store in those of its shards."""


@dataclass(frozen=True)
class Shard:
    """Some poses of an ensemble: every ``count``-th, from the ``number``-th on.

    Attributes:
        number: From 1 on.
        count: How many there are.
    """

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise SettingsError(
                f"--shard: found {self.number}/{self.count}; give I/N with I from 1 to N"
            )

    @classmethod
    def of(cls, text: str) -> Shard:
        """Return the shard of a text ``I/N``."""
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal()):
            raise SettingsError(f"--shard: found {text!r}; give I/N, such as 3/16")
        return cls(int(number), int(count))

    def path(self, whole: Path) -> Path:
        """Return the shard's store beside that of the whole ensemble."""
        return whole.with_name(f"{whole.name}{SHARD}{self.number}-of-{self.count}")


HASHED_SECTIONS = ("simulation", "air", "ears", "call", "noise", "spectrogram")


def echo_hash(settings: Settings, scene: Scene) -> str:
    """Return a hash of all that the echoes depend on.

    Poses count as what they are, not as how they were asked for: a changed table at the same
    place is another ensemble, the same table at another place is not.
    """
    plain = _heard_settings(settings)
    digest = hashlib.sha256(f"simulator {VERSION}".encode())
    digest.update(json.dumps([plain[name] for name in HASHED_SECTIONS], sort_keys=True).encode())
    poses, split = ensemble_poses(settings.poses)
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


def _heard_settings(settings: Settings) -> dict[str, Any]:
    """Return the settings that the echoes depend on, without optional keys that do not apply."""
    plain = {**settings.plain(), "call": call_content(settings.call)}
    ears, air, analysis = plain["ears"], plain["air"], plain["spectrogram"]
    if analysis["kind"] == "stft":
        for key in ("kind", "channels", "q"):
            del analysis[key]
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
        # A measured directivity counts as what it is, not as where it lies.
        ears["file"] = directivity_content(settings.ears)
    return plain


def scene_of(settings: Settings) -> Scene:
    """Return the scene that settings name.

    Raises:
        SettingsError: If they name none: their echoes come from a store.
        InputError: If the scene is unknown or broken.
    """
    if settings.scene is None:
        raise SettingsError("scene: missing; set scene.name to simulate echoes")
    return load_scene(settings.scene.name, settings.scene.options, source=settings.source)


def store_path(settings: Settings, scene: Scene | None, output: Path | None) -> Path:
    """Return where the ensemble lies: as asked for, as set, or by its hash under ``data/``."""
    chosen = output or settings.data.store
    if chosen is not None:
        return chosen
    return default_store(settings, echo_hash(settings, scene or scene_of(settings)))


def default_store(settings: Settings, echoes: str) -> Path:
    """Return where the ensemble of a hash lies when nobody says where."""
    name = "recorded" if settings.scene is None else settings.scene.name
    return Path("data") / f"{name}-{echoes[:12]}"


def background_path(settings: Settings) -> Path | None:
    """Return where the ensemble of the surroundings alone lies; None where none is taken off.

    Raises:
        SettingsError: If the scene's own are asked for, and it marks none.
    """
    chosen = settings.data.background
    return _own_background(settings)[0] if chosen == "scene" else chosen


def _own_background(settings: Settings) -> tuple[Path, Scene]:
    alone = scene_of(settings).surroundings()
    name = settings.scene.name if settings.scene else ""
    if alone is None:
        raise SettingsError(
            f"data.background: the scene {name!r} marks no background; give the "
            "ensemble of the surroundings alone, or leave it out"
        )
    path = default_store(settings, echo_hash(settings, alone))
    return path.with_name(f"{path.name}-background"), alone


def open_ensemble(settings: Settings, path: Path) -> EnsembleStore:
    """Open a simulated ensemble, less its surroundings where that is asked for."""
    background = background_path(settings)
    return EnsembleStore.open(path) if background is None else SubtractedStore(path, background)


def ensemble(
    settings: Settings, *, workers: int | None = None, progress: Progress | None = None
) -> EnsembleStore:
    """Open or simulate the echoes, and take the surroundings off where that is asked for.

    As :func:`simulate`, whose errors it raises.
    """
    # What is wrong with the background is told before minutes of simulation.
    background = background_path(settings)
    if background is not None and settings.data.background != "scene":
        EnsembleStore.open(background)
    if settings.scene is None and settings.data.store is not None:
        store = complete_store(settings.data.store)
    else:
        store = simulate(settings, workers=workers, progress=progress)
    if settings.data.background == "scene":
        alone = _own_background(settings)[1]
        simulate(settings, scene=alone, output=background, workers=workers, progress=progress)
    return store if background is None else SubtractedStore(store.path, background)


def simulate(
    settings: Settings,
    *,
    scene: Scene | None = None,
    output: Path | None = None,
    shard: Shard | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> EnsembleStore:
    """Simulate what is missing of an ensemble, and seal it.

    Shards are stores beside the ensemble's, each with some of its poses. They can be simulated on
    different machines at once. The same call without a shard takes the poses from there, simulates
    what is missing, and seals.

    Args:
        settings: The experiment.
        scene: Another one than the settings'.
        output: The store; ``data/<scene>-<hash>`` where None.
        shard: Which of how many; the whole ensemble where None.
        workers: Processes; as many as there are cores, at most 8, where None.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Where to show it.

    Returns:
        store: Complete, or the shard; opened for reading.

    Raises:
        InputError: If scene or poses are no good.
        NumericalError: If no pose hears anything.
        StorageError: If the store cannot be written.
        IncompatibleError: If the folder holds another ensemble.
    """
    progress = progress or Progress(quiet=True)
    if scene is None:
        scene = scene_of(settings)
    path = store_path(settings, scene, output)
    whole, path = path, path if shard is None else shard.path(path)
    wanted = echo_hash(settings, scene)
    if (path / "zarr.json").is_file():
        store = EnsembleStore.open(path)
        if store.attributes.get("echo_hash") != wanted:
            raise IncompatibleError(
                f"{path}: holds echoes of other settings; choose another --output, or leave the "
                "scene out of the settings to take the echoes as they are"
            )
        if "reference" in store.attributes and not store.missing():
            return store
    poses, split = ensemble_poses(settings.poses)
    warn_of_call(settings.call, settings.spectrogram)
    head = head_of(settings)
    simulator = Simulator.of(scene, head, settings.simulation)
    check_poses(scene, poses, offsets=np.vstack((head.emitter, head.receivers)))
    check_reach(
        scene,
        poses,
        bounces=settings.simulation.bounces,
        range_min=settings.spectrogram.range_min,
        range_max=settings.spectrogram.range_max,
    )
    storage.probe_writable(path)
    if simulator.engine.note:
        progress.say(f"echoes: {simulator.engine.note}")
    with storage.lock(path):
        store = EnsembleStore.create(
            path,
            poses_positions=poses.positions,
            poses_rotations=poses.rotations,
            split=split,
            range=head.range,
            frequency=head.frequency,
            attributes=_attributes(settings, wanted, simulator),
            receivers=len(head.receivers),
        )
        attach(settings, path)
        if shard is None:
            _take_shards(store, whole)
        simulate_poses(
            simulator,
            poses,
            store,
            settings.simulation,
            only=None if shard is None else range(shard.number - 1, len(poses), shard.count),
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
    return EnsembleStore.open(path)


def _take_shards(store: EnsembleStore, path: Path) -> None:
    """Take what is missing of an ensemble from its shards.

    Raises:
        InputError: If a shard is damaged.
        IncompatibleError: If a shard is of other settings, or was traced with other rays.
    """
    for folder in sorted(path.parent.glob(f"{glob.escape(path.name)}{SHARD}*")):
        shard = EnsembleStore.open(folder)
        there = set(range(len(shard))) - set(shard.missing())
        if not there:  # it was stopped before its first pose
            continue
        rays = shard.attributes.get("rays")
        for key, known in (
            ("echo_hash", store.attributes.get("echo_hash")),
            ("rays", store.attributes.get("rays", rays)),
        ):
            if shard.attributes.get(key) != known:
                raise IncompatibleError(
                    f"{folder}: is a shard of other echoes ({key} differs); remove it, or simulate "
                    "it anew"
                )
        store.update_attributes(rays=rays)
        for index in sorted(there & set(store.missing())):
            store.write_pose(index, shard.read_pose(index))


def _attributes(settings: Settings, wanted: str, simulator: Simulator) -> dict[str, object]:
    plain = settings.plain()
    return {
        "echo_hash": wanted,
        "origin": "simulated",
        "scene": plain["scene"],
        "settings": {name: plain[name] for name in ("poses", *HASHED_SECTIONS)},
        "speed_of_sound": simulator.head.speed_of_sound,
        "units": {
            "spectrogram": "linear magnitude, sound pressure over that of the call at 1 m",
            "position": "m",
            "range": "m",
            "frequency": "Hz",
        },
        "sononerf": __version__,
    }


def write_waveforms(
    settings: Settings,
    folder: Path,
    *,
    scene: Scene | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Simulate what the receivers hear at every pose, and write it as WAV files with a table.

    The folder is what ``sononerf import recordings`` reads: a WAV file per pose (32-bit floats),
    ``poses.csv``, and ``import.yaml`` with air, ears, call and analysis. Poses, echoes and noise
    are those of :func:`sononerf.run.simulate.simulate`.

    Args:
        settings: The experiment; its scene is needed.
        folder: Empty, or not there.
        scene: Another one than the settings'.
        progress: Where to show it.

    Returns:
        written: Table, settings, and the first WAV file.

    Raises:
        SettingsError: If there is no scene, or a WAV file cannot hold the sampling rate.
        InputError: If the folder is not empty.
        StorageError: If it cannot be written.
    """
    progress = progress or Progress(quiet=True)
    if scene is None:
        if settings.scene is None:
            raise SettingsError("scene: missing; set scene.name to simulate recordings")
        scene = load_scene(settings.scene.name, settings.scene.options, source=settings.source)
    rate = settings.spectrogram.sampling_rate
    if rate != round(rate):
        raise SettingsError(f"spectrogram.sampling_rate: a WAV file cannot hold {rate} Hz")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty; choose another folder for the recordings")
    simulator = simulator_of(scene, settings)
    poses, split = ensemble_poses(settings.poses)
    simulator.prepare(poses.positions, poses.rotations, progress)
    settle_rays(simulator, poses, settings.simulation, progress)
    digits = max(4, len(str(len(poses) - 1)))
    names = [f"ping_{index:0{digits}d}.wav" for index in range(len(poses))]
    with progress.task("recording", len(poses)) as task:
        for index, name in enumerate(names):
            waveform, _ = simulator.receive(
                poses.positions[index],
                poses.rotations[index],
                seed=pose_seed(settings.simulation.seed, index),
            )
            storage.commit_bytes(folder / name, wav_bytes(waveform, rate))
            task.advance()
    plain = settings.plain()
    told = {name: plain[name] for name in HEAD_SECTIONS}
    told["import"] = {"source": f"simulated, scene {settings.scene.name}" if settings.scene else ""}
    storage.commit_text(folder / OWN_SETTINGS, str(yaml.safe_dump(told, sort_keys=False)))
    # The table comes last: without it the folder is none to import.
    storage.commit_text(folder / "poses.csv", pose_table(poses, names, split))
    return [folder / "poses.csv", folder / OWN_SETTINGS, folder / names[0]]
