# SPDX-License-Identifier: MIT
from __future__ import annotations

import pytest

from sononerf.echoes.layout import chunk_path
from sononerf.echoes.store import EnsembleStore
from sononerf.progress import Progress
from sononerf.run.build import simulator_of
from sononerf.run.simulate import simulate
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation import accuracy
from sononerf.simulation.accuracy import settle_rays
from sononerf.simulation.simulator import ensemble_poses

QUIET = Progress(quiet=True)
NOISE = {"snr_db": 10}


def settings(noise=None, **simulation):
    return validate_settings(
        {
            "scene": {"name": "torus"},
            "simulation": {"engine": "rays", "noise_floor_poses": 4, **simulation},
            "poses": {"count": 8, "validation": 0, "heldout": 4},
            "noise": noise or {},
        },
        "test",
    )


def settled(wanted, progress=QUIET):
    scene = load_scene(wanted.scene.name, wanted.scene.options)
    simulator, poses = simulator_of(scene, wanted), ensemble_poses(wanted.poses)[0]
    return settle_rays(simulator, poses, wanted.simulation, progress), simulator


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(accuracy, "FIRST", 500)


@pytest.mark.slow
def test_the_accuracy_is_reached_and_costs_rays(few, tmp_path):
    rays = []
    for wanted in (2.0, 1.0):
        store = simulate(settings(accuracy_db=wanted), output=tmp_path / str(wanted), workers=1)
        # At four other poses than those of the trials.
        assert store.attributes["noise_floor_mae_db_active"] < 1.5 * wanted
        rays.append(store.attributes["rays"])
    assert 500 <= rays[0] < rays[1] < accuracy.MOST


@pytest.mark.slow
def test_noise_of_the_ears_asks_for_no_more_rays(few):
    quiet, noisy = (settled(settings(noise, accuracy_db=2.0))[0] for noise in (None, NOISE))
    assert quiet == noisy


def test_a_number_of_rays_is_taken_as_it_is():
    rays, simulator = settled(settings(rays=777))
    assert rays == simulator.rays.rays == 777


@pytest.mark.slow
def test_a_number_that_a_damaged_store_names_is_not_taken(few, tmp_path):
    wanted = settings(accuracy_db=3.0)
    store = simulate(wanted, output=tmp_path / "store", workers=1)
    rays = store.attributes["rays"]
    for damaged in ("many", 10**12, -1):
        chunk_path(store.path, "spectrogram", (3, 0, 0, 0)).unlink()
        EnsembleStore.open(store.path, mode="r+").update_attributes(rays=damaged)
        again = simulate(wanted, output=tmp_path / "store", workers=1)
        assert again.attributes["rays"] == rays
