# SPDX-License-Identifier: MIT
"""Simulation from settings: a sealed ensemble of echoes, or the recordings of microphones."""

from __future__ import annotations

from pathlib import Path

from sononerf import storage
from sononerf.echoes.echoes import Echoes, complete_store
from sononerf.echoes.store import EnsembleStore, SubtractedStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.head.head import Head
from sononerf.progress import Progress
from sononerf.recordings.recording import pose_table, wav_bytes
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.loading import to_yaml
from sononerf.settings.schema import HEAD_SECTIONS, Settings
from sononerf.simulation import ensemble
from sononerf.simulation.simulator import Simulator, ensemble_poses, pose_seed, settle_rays

OWN_SETTINGS = "import.yaml"
"""Settings of an import that lie beside its recordings."""


def head_of(settings: Settings) -> Head:
    """Return the head that settings describe."""
    return Head(
        ears=settings.ears,
        call=settings.call,
        air=settings.air,
        spectrogram=settings.spectrogram,
        noise=settings.noise,
        support=settings.support,
    )


def simulator_of(scene: Scene, settings: Settings) -> Simulator:
    """Return the simulator of a scene that settings describe; see :class:`Simulator`."""
    return Simulator(scene, head_of(settings), settings.simulation)


def echo_hash(settings: Settings, scene: Scene) -> str:
    """Return a hash of all that the echoes of settings depend on."""
    poses, split = ensemble_poses(settings.poses)
    return ensemble.echo_hash(scene, poses, split, head_of(settings), settings.simulation)


def scene_of(settings: Settings) -> Scene:
    """Return the scene that settings name."""
    if settings.scene is None:
        raise SettingsError("scene: missing; set scene.name to simulate echoes")
    return load_scene(settings.scene.name, settings.scene.options, source=settings.source)


def store_path(settings: Settings, scene: Scene | None, output: Path | None) -> Path:
    """Return the path of the ensemble: as given, as set, or by its hash under ``data/``."""
    chosen = output or settings.data.store
    if chosen is not None:
        return chosen
    return default_store(settings, echo_hash(settings, scene or scene_of(settings)))


def default_store(settings: Settings, echoes: str) -> Path:
    """Return the default path of the ensemble with a hash."""
    name = "recorded" if settings.scene is None else settings.scene.name
    return Path("data") / f"{name}-{echoes[:12]}"


def background_path(settings: Settings) -> Path | None:
    """Return the path of the ensemble of the surroundings alone; None if none is subtracted."""
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
    """Open a simulated ensemble, without its surroundings if the settings say so."""
    background = background_path(settings)
    return EnsembleStore.open(path) if background is None else SubtractedStore(path, background)


def find_ensemble(settings: Settings, echo_hash: str, folder: Path) -> EnsembleStore:
    """Open the ensemble that a run was fitted to."""
    stated = settings.data.store or default_store(settings, echo_hash)
    places = [stated, *(above / stated for above in folder.absolute().parents)]
    stores = [open_ensemble(settings, one) for one in places if (one / "zarr.json").is_file()]
    if not stores:
        again = (
            "import the recordings again"
            if settings.scene is None
            else "make it again with `sononerf simulate RUN/config.yaml`"
        )
        raise InputError(
            f"{stated}: the ensemble of this run is not there; {again}, or predict poses of your "
            "own with --poses"
        )
    for store in stores:
        if store.attributes.get("echo_hash") == echo_hash:
            return store
    raise IncompatibleError(f"{stores[0].path}: holds other echoes than those of this run")


def open_or_simulate(
    settings: Settings, *, workers: int | None = None, progress: Progress | None = None
) -> Echoes:
    """Open or simulate the echoes, and subtract the surroundings if the settings say so.

    As :func:`simulate`, whose errors it raises.
    """
    # A fault of the background is reported before minutes of simulation.
    background = background_path(settings)
    if background is not None and settings.data.background != "scene":
        EnsembleStore.open(background)
    if settings.scene is None and settings.data.store is not None:
        path = complete_store(settings.data.store).path
    else:
        path = simulate(settings, workers=workers, progress=progress).path
    if settings.data.background == "scene":
        alone = _own_background(settings)[1]
        simulate(settings, scene=alone, output=background, workers=workers, progress=progress)
    return Echoes(open_ensemble(settings, path), head_of(settings))


def simulate(
    settings: Settings,
    *,
    scene: Scene | None = None,
    output: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> EnsembleStore:
    """Simulate the missing poses of an ensemble, and seal it.

    Args:
        settings: The experiment.
        scene: Another one than the settings'.
        output: The store; ``data/<scene>-<hash>`` by default.
        workers: Processes; as many as there are cores, at most 8, by default.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Display of progress.

    Returns:
        store: Complete, opened for reading.

    Raises:
        InputError: If scene or poses are no good.
        NumericalError: If no pose hears anything.
        StorageError: If the store cannot be written.
        IncompatibleError: If the folder holds another ensemble.
    """
    if scene is None:
        scene = scene_of(settings)
    poses, split = ensemble_poses(settings.poses)
    plain = settings.plain()
    store = ensemble.simulate(
        scene,
        poses,
        head_of(settings),
        split=split,
        output=store_path(settings, scene, output),
        options=settings.simulation,
        about={"scene": plain["scene"], "settings": {"poses": plain["poses"]}},
        workers=workers,
        scheduler=scheduler,
        progress=progress or Progress(quiet=True),
    ).store
    assert isinstance(store, EnsembleStore)  # its folder was given
    return store


def write_waveforms(
    settings: Settings, folder: Path, *, progress: Progress | None = None
) -> list[Path]:
    """Simulate the sound at the receivers at every pose, and write WAV files with a table.

    The folder is what ``sononerf import recordings`` reads: a WAV file per pose (32-bit floats),
    ``poses.csv``, and ``import.yaml`` with air, ears, call and spectrogram. Poses, echoes and noise
    are those of :func:`sononerf.run.simulate.simulate`.
    """
    progress = progress or Progress(quiet=True)
    scene = scene_of(settings)
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
    plain = simulator.head.plain()
    sections = {name: plain[name] for name in HEAD_SECTIONS}
    source = f"simulated, scene {settings.scene.name}" if settings.scene else ""
    sections["import"] = {"source": source}
    storage.commit_text(folder / OWN_SETTINGS, to_yaml(sections))
    # The table comes last: without it the folder cannot be imported.
    storage.commit_text(folder / "poses.csv", pose_table(poses, names, split))
    return [folder / "poses.csv", folder / OWN_SETTINGS, folder / names[0]]
