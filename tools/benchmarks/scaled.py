# SPDX-License-Identifier: MIT
"""A world with all lengths and times times a factor, and all frequencies over it."""

from __future__ import annotations

import math
from pathlib import Path

from sononerf.echoes.store import EnsembleStore
from sononerf.head.spectrogram import frequency_axis, range_axis
from sononerf.run.simulate import echo_hash
from sononerf.scene.scene import load_scene
from sononerf.settings.schema import Settings
from sononerf.simulation.ensemble import HASHED_SECTIONS
from sononerf.simulation.simulator import ensemble_poses

UNSCALED = ("ears.notch_depth=0",)
"""The ears' notch is at frequencies that no setting changes, so neither world has it."""


def scaled_settings(plain: Settings, factor: float) -> list[str]:
    """Return what is laid over the settings of a world of round bodies to scale it.

    Air of a lower pressure and with the same share of water takes as much of an echo on the longer
    way. The ears' lobes widen with the root of the wavelength, so they are set narrower.

    Args:
        plain: Settings of a scene whose ``radius`` scales all of it, without a notch in its ears.
        factor: Scale of all lengths and times.

    Returns:
        assignments: ``KEY=VALUE``.
    """
    radius = load_scene(plain.scene.name).mesh.extents.min() / 2.0
    analysis, ears, air = plain.spectrogram, plain.ears, plain.air
    values = {
        "scene.options.radius": factor * round(float(radius), 9),
        "poses.radius": factor * plain.poses.radius,
        "ears.emitter": [factor * part for part in ears.emitter],
        "ears.left": [factor * part for part in ears.left],
        "ears.beam_radius": factor * ears.beam_radius,
        "ears.width_deg": ears.width_deg / math.sqrt(factor),
        "air.pressure_pa": air.pressure_pa / factor,
        "air.relative_humidity": air.relative_humidity / factor,
        "spectrogram.range_min": factor * analysis.range_min,
        "spectrogram.range_max": factor * analysis.range_max,
        "spectrogram.sampling_rate": analysis.sampling_rate / factor,
        "spectrogram.frequency_min": analysis.frequency_min / factor,
        "spectrogram.frequency_max": analysis.frequency_max / factor,
    }
    return [f"{key}={value!r}" for key, value in values.items()]


def scaled_store(source: Path, target: Path, settings: Settings, factor: float) -> None:
    """Write the echoes of a scaled world from those of the unscaled one.

    The simulator's own constants, such as the frequencies of its nodes, have no part in it.

    Args:
        source: The finished ensemble of the unscaled world.
        target: Path of the new store; a complete one is left as it is.
        settings: Settings of the scaled world.
        factor: Scale of all lengths and times.
    """
    old = EnsembleStore.open(source)
    scene = load_scene(settings.scene.name, settings.scene.options)
    poses, split = ensemble_poses(settings.poses)
    plain = settings.plain()
    attributes = {
        **old.attributes,
        "echo_hash": echo_hash(settings, scene),
        "scene": plain["scene"],
        "settings": {name: plain[name] for name in ("poses", *HASHED_SECTIONS)},
        # Pressure is told over that of the call at 1 m, and falls with distance.
        "reference": old.attributes["reference"] / factor,
    }
    new = EnsembleStore.create(
        target,
        poses_positions=poses.positions,
        poses_rotations=poses.rotations,
        split=split,
        range=range_axis(settings.spectrogram, old.attributes["speed_of_sound"]),
        frequency=frequency_axis(settings.spectrogram),
        attributes=attributes,
    )
    for index in new.missing():
        new.write_pose(index, old.read_pose(index) / factor)
