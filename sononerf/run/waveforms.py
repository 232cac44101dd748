# SPDX-License-Identifier: MIT
"""A simulated ensemble as the recordings that microphones would have made."""

from __future__ import annotations

from pathlib import Path

import yaml

from sononerf import storage
from sononerf.errors import InputError, SettingsError
from sononerf.progress import Progress
from sononerf.recordings.writer import pose_table, wav_bytes
from sononerf.run.build import simulator_of
from sononerf.run.understand import OWN_SETTINGS
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.schema import HEAD_SECTIONS, Settings
from sononerf.simulation.ensemble import pose_seed
from sononerf.simulation.simulator import ensemble_poses


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
