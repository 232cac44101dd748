# SPDX-License-Identifier: MIT
"""A world that is scaled hears the same at scaled ranges and frequencies."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.store import EnsembleStore
from sononerf.head.air import air_absorption
from sononerf.head.ears import analysed_ears
from sononerf.head.spectrogram import frequency_axis, range_axis
from sononerf.run.build import simulator_of
from sononerf.run.simulate import echo_hash, simulate
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from sononerf.simulation.simulator import ensemble_poses
from tools.benchmarks.experiment import CONFIG
from tools.benchmarks.scaled import UNSCALED, scaled_settings, scaled_store

pytestmark = pytest.mark.thorough

PLAIN = [*UNSCALED, "poses.count=3", "poses.validation=0", "poses.heldout=1"]
PLAIN += ["spectrogram.range_min=0.3", "spectrogram.range_max=0.35", "simulation.engine=rays"]


@pytest.fixture(scope="module")
def worlds():
    plain = load_settings(CONFIG, PLAIN)
    return plain, load_settings(CONFIG, [*PLAIN, *scaled_settings(plain, 3.0)])


def test_scene_poses_and_analysis_are_three_times_as_large(worlds):
    plain, large = worlds
    small, big = (load_scene(world.scene.name, world.scene.options).mesh for world in worlds)
    np.testing.assert_allclose(big.vertices, 3.0 * small.vertices, atol=1e-8)
    poses, more = ensemble_poses(plain.poses)[0], ensemble_poses(large.poses)[0]
    np.testing.assert_allclose(more.positions, 3.0 * poses.positions, rtol=1e-12)
    np.testing.assert_allclose(more.rotations, poses.rotations, atol=1e-12)
    one, other = (frequency_axis(world.spectrogram) for world in worlds)
    np.testing.assert_allclose(other, one / 3.0, rtol=1e-12)
    one, other = (range_axis(world.spectrogram, 343.0) for world in worlds)
    np.testing.assert_allclose(other, 3.0 * one, rtol=1e-12)


def test_head_and_air_are_heard_alike(worlds):
    heads = [analysed_ears(world.ears, world.call, world.spectrogram)[0] for world in worlds]
    for name in ("beam", "ears"):
        one, other = (getattr(head, name) for head in heads)
        assert np.ptp(one) > 0.1
        np.testing.assert_allclose(other, one, atol=2e-6)
    np.testing.assert_allclose(heads[1].positions, 3.0 * heads[0].positions)
    losses = [
        air_absorption(
            frequency_axis(world.spectrogram),
            relative_humidity=world.air.relative_humidity,
            pressure=world.air.pressure_pa,
        )
        for world in worlds
    ]
    np.testing.assert_allclose(3.0 * losses[1], losses[0], rtol=1e-9)


def test_echoes_are_those_of_the_unscaled_world(worlds, tmp_path):
    plain, large = worlds
    scene, (poses, split) = load_scene("three_spheres"), ensemble_poses(plain.poses)
    simulator = simulator_of(scene, plain)
    old = EnsembleStore.create(
        tmp_path / "old",
        poses_positions=poses.positions,
        poses_rotations=poses.rotations,
        split=split,
        range=simulator.head.range,
        frequency=simulator.head.frequency,
        attributes={
            "echo_hash": echo_hash(plain, scene),
            "speed_of_sound": simulator.head.speed_of_sound,
        },
    )
    random = np.random.default_rng(0)
    shape = (2, len(simulator.head.range), len(simulator.head.frequency))
    heard = random.uniform(size=(len(split), *shape)).astype(np.float32)
    for index, spectrogram in enumerate(heard):
        old.write_pose(index, spectrogram)
    old.update_attributes(reference=0.003, noise_floor_mae_db=0.5)
    for _ in range(2):  # one that is complete is left as it is
        scaled_store(tmp_path / "old", tmp_path / "new", large, 3.0)
    # It is taken for the ensemble of the scaled settings: nothing is simulated.
    new = simulate(large, output=tmp_path / "new")
    assert new.missing() == []
    assert new.attributes["reference"] == pytest.approx(0.001)
    np.testing.assert_allclose(new.range, 3.0 * old.range)
    for index, spectrogram in enumerate(heard):
        np.testing.assert_allclose(new.read_pose(index), spectrogram / 3.0, rtol=1e-6)
