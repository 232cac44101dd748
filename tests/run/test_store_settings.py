# SPDX-License-Identifier: MIT
"""A store alone is enough to fit: it says how its echoes were heard."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.run.finish import finish
from sononerf.run.fit import fit
from sononerf.run.simulate import simulate
from sononerf.run.store_settings import with_store
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import HEAD_SECTIONS


@pytest.fixture
def alone(tiny_settings, echoes):
    """Settings of the tiny experiment that name nothing but the store."""

    def settings(**sections):
        plain = tiny_settings().plain()
        kept = {
            k: v
            for k, v in plain.items()
            if k not in (*HEAD_SECTIONS, "scene", "poses", "simulation")
        }
        for name, values in sections.items():
            kept[name] = {**kept.get(name, {}), **values}
        return validate_settings(kept, "alone")

    return settings


def test_settings_without_a_scene_take_the_store_s(alone, tiny_settings):
    found = with_store(alone())
    for section in HEAD_SECTIONS:
        assert getattr(found, section) == getattr(tiny_settings(), section)
    assert found.scene is None


def test_settings_with_a_scene_are_left_alone(tiny_settings):
    assert with_store(tiny_settings()) == tiny_settings()


def test_what_contradicts_the_store_is_refused_and_what_agrees_is_not(alone):
    assert with_store(alone(spectrogram={"range_min": 0.34}))
    with pytest.raises(IncompatibleError, match=r"air\.temperature_c: found 30") as raised:
        with_store(alone(air={"temperature_c": 30.0}))
    assert "\n" not in str(raised.value)
    wider = with_store(alone(spectrogram={"dynamic_range_db": 50.0}))
    assert wider.spectrogram.dynamic_range_db == 50.0


def test_a_fit_of_a_store_needs_no_scene(alone, tmp_path):
    run = tmp_path / "run"
    fit(alone(), run, accelerator="cpu")
    metrics = finish(run, accelerator="cpu")
    assert metrics["prediction"]["poses"] == 2
    assert metrics["geometry"] is None
    assert (run / "reconstruction" / "mesh.ply").is_file()
    again = fit(alone(evaluation={"registration": "rigid"}), run, accelerator="cpu")
    assert again.is_done("fit")


def test_an_unfinished_or_silent_store_is_refused(alone, echoes, tmp_path):
    copy = tmp_path / "store"
    shutil.copytree(echoes, copy)
    EnsembleStore.open(copy)._chunk(3).unlink()
    with pytest.raises(InputError, match="1 poses are missing"):
        fit(alone(data={"store": str(copy)}), tmp_path / "run", accelerator="cpu")
    EnsembleStore.open(echoes)
    bare = tmp_path / "bare"
    store = EnsembleStore.create(
        bare,
        poses_positions=np.zeros((1, 3)),
        poses_rotations=np.eye(3)[None],
        split=[0],
        range=[0.1, 0.2],
        frequency=[1e4],
        attributes={},
    )
    assert store.receivers == 2
    with pytest.raises(InputError, match="does not state its head"):
        with_store(alone(data={"store": str(bare)}))


def test_neither_scene_nor_store_is_a_fault_of_the_settings(alone):
    with pytest.raises(SettingsError, match=r"set scene\.name, or data\.store"):
        alone(data={"store": None})
    with pytest.raises(SettingsError, match=r"scene: missing; set scene\.name"):
        simulate(alone())


def test_a_run_of_a_store_knows_its_settings(alone, tmp_path):
    run = tmp_path / "run"
    fit(alone(), run, accelerator="cpu")
    saved = json.loads((run / "model.json").read_text())["settings"]
    assert saved["scene"] is None
    assert saved["spectrogram"]["range_max"] == 0.45
