# SPDX-License-Identifier: MIT
"""Runs in TensorBoard: their names, scalars with units, settings beside results."""

from __future__ import annotations

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from sononerf.callbacks import event_folder, log_results


def events_of(run):
    (folder,) = (run / "tensorboard").iterdir()
    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def test_a_fit_has_scalars_with_units(training, tmp_path):
    training(logger=True).train()
    events = events_of(tmp_path)
    scalars = set(events.Tags()["scalars"])
    assert scalars == {
        "training/loss",
        "validation_error_dB/all_cells",
        "validation_error_dB/active_cells",
    }
    assert [one.step for one in events.Scalars("validation_error_dB/all_cells")] == [3, 7]
    assert len(events.Scalars("training/loss")) == 8


def test_a_run_has_its_own_name_and_keeps_it(tmp_path):
    run = tmp_path / "leaf-7"
    run.mkdir()
    assert event_folder(run) == run / "tensorboard" / "leaf-7"
    event_folder(run).mkdir(parents=True)
    moved = run.rename(tmp_path / "other")
    assert event_folder(moved) == moved / "tensorboard" / "leaf-7"


def test_settings_stand_beside_the_results(tmp_path):
    settings = {"fit.seed": 3, "scene.name": "leaf", "region.lower": [0, 0, 0], "scene.x": None}
    metrics = {
        "prediction": {"mae_db": 0.5, "mae_db_active": None},
        "geometry": {"chamfer_m": 0.002, "fscore": {"0.005": 0.9}},
        "cost": {},
    }
    log_results(tmp_path, settings, metrics)
    events = events_of(tmp_path)
    found = {tag: events.Scalars(tag)[-1].value for tag in events.Tags()["scalars"]}
    assert found.keys() == {
        "final/held_out_error_all_cells_dB",
        "final/Chamfer_mm",
        "final/F-score_at_5_mm",
    }
    assert round(found["final/Chamfer_mm"], 3) == 2.0
    metadata = events.summary_metadata["_hparams_/session_start_info"]
    content = plugin_data_pb2.HParamsPluginData.FromString(metadata.plugin_data.content)
    assert dict(content.session_start_info.hparams).keys() == {"fit.seed", "scene.name"}
