# SPDX-License-Identifier: MIT
"""Predictions need two files and run no code; where echoes were measured they are compared."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from sononerf.data.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, ResourceError
from sononerf.experiment import predict as predict_module
from sononerf.experiment.build import echo_hull
from sononerf.experiment.fit import fit
from sononerf.experiment.fitted import load_fitted, store_of
from sononerf.experiment.predict import predict
from sononerf.weights import load_weights, save_weights

CSV = "x,y,z,yaw,pitch,roll\n-0.4,0,0,0,0,0\n0,0,0.4,0,90,0\n"
AXES = {"range_m", "frequency_hz", "reference", "pose", "position", "rotation"}


@pytest.fixture(scope="module")
def fitted(tiny_settings, without_pictures, tmp_path_factory):
    path = tmp_path_factory.mktemp("fitted") / "run"
    fit(tiny_settings(), path, accelerator="cpu", workers=1)
    return path


@pytest.fixture
def run(fitted, tmp_path):
    """The run with nothing but its two files, somewhere else."""
    path = tmp_path / "elsewhere"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted / name, path)
    return path


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr(predict_module, "spectrogram_png", lambda *given: b"")


def arrays_of(folder):
    with np.load(folder / "spectrograms.npz", allow_pickle=False) as file:
        return dict(file)


def test_measured_predicted_and_numbered_as_in_the_store(run, echoes):
    folder = predict(run, accelerator="cpu")
    store = EnsembleStore.open(echoes)
    numbers = store.indices("test").tolist()
    assert folder == run / "prediction"
    assert sorted(p.name for p in folder.iterdir()) == [
        *(f"pose_{number:04d}.png" for number in numbers),
        "spectrograms.npz",
    ]
    arrays = arrays_of(folder)
    assert arrays.keys() == {"measured", "predicted"} | AXES
    shape = (len(numbers), 2, len(store.range), len(store.frequency))
    assert arrays["predicted"].shape == arrays["measured"].shape == shape
    assert np.isfinite(arrays["predicted"]).all()
    assert (arrays["predicted"] >= 0).all()
    np.testing.assert_array_equal(arrays["pose"], numbers)
    np.testing.assert_array_equal(arrays["measured"][1], store.read_pose(numbers[1]))
    np.testing.assert_allclose(arrays["position"], store.positions[numbers], rtol=1e-6)
    np.testing.assert_allclose(arrays["range_m"], store.range, rtol=1e-6)
    with Image.open(io.BytesIO((folder / f"pose_{numbers[0]:04d}.png").read_bytes())) as image:
        assert min(image.size) > 100


def test_the_numbers_are_those_of_the_arrays(run, echoes, no_pictures):
    arrays = arrays_of(predict(run, accelerator="cpu"))
    numbers = json.loads((run / "metrics.json").read_text())["prediction"]
    store = EnsembleStore.open(echoes)
    assert float(arrays["reference"]) == store.attributes["reference"]

    def db(values):
        return 20 * np.log10(1 + values / store.attributes["reference"])

    measured, predicted = (
        db(arrays["measured"].astype(float)),
        db(arrays["predicted"].astype(float)),
    )
    mean = np.mean([db(store.read_pose(int(i)).astype(float)) for i in store.indices("train")], 0)
    assert numbers["mae_db"] == pytest.approx(np.abs(measured - predicted).mean(), rel=1e-5)
    assert numbers["mean_predictor_mae_db"] == pytest.approx(
        np.abs(measured - mean).mean(), rel=1e-5
    )
    assert (numbers["split"], numbers["poses"]) == ("test", 2)
    assert numbers["noise_floor_mae_db"] == store.attributes["noise_floor_mae_db"]


@pytest.mark.parametrize(("split", "count"), [("train", 8), ("val", 2)])
def test_other_splits_have_their_own_folder_and_no_numbers(run, split, count, no_pictures):
    folder = predict(run, split=split, accelerator="cpu")
    assert folder == run / f"prediction-{split}"
    assert len(arrays_of(folder)["pose"]) == count
    assert not (run / "metrics.json").exists()


def test_poses_of_ones_own_need_neither_store_nor_scene(run, tmp_path, monkeypatch):
    def gone(*given):
        raise AssertionError("asked for the ensemble")

    monkeypatch.setattr(predict_module, "store_of", gone)
    (tmp_path / "poses.csv").write_text(CSV)
    folder = predict(run, poses_csv=tmp_path / "poses.csv", accelerator="cpu")
    assert folder == run / "prediction-poses"
    arrays = arrays_of(folder)
    assert arrays.keys() == {"predicted"} | AXES
    assert len(arrays["predicted"]) == 2
    np.testing.assert_allclose(arrays["position"][0], [-0.4, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(arrays["rotation"][1][:, 0], [0, 0, -1], atol=1e-6)  # looks down
    assert len(list(folder.glob("pose_*.png"))) == 2
    assert not (run / "metrics.json").exists()


def test_the_same_field_predicts_the_same_bits_wherever_it_lies(run, fitted, tmp_path, no_pictures):
    (tmp_path / "poses.csv").write_text(CSV)
    first, second = (
        arrays_of(
            predict(p, poses_csv=tmp_path / "poses.csv", output=tmp_path / o, accelerator="cpu")
        )
        for p, o in ((run, "a"), (fitted, "b"))
    )
    np.testing.assert_array_equal(first["predicted"], second["predicted"])


def test_loading_runs_no_code_and_leaves_evaluation_mode(run):
    found = load_fitted(run)
    assert not found.module.training
    assert found.settings.scene.name == "sphere"


def damage(path, change):
    description = json.loads((path / "model.json").read_text())
    change(description)
    (path / "model.json").write_text(json.dumps(description))


def other_field(description):
    description["settings"]["field"] = {"kind": "fourier", "options": {}}


def unknown_key(description):
    description["settings"]["fit"]["speed"] = 3


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda d: d.pop("reference"), InputError, "incomplete"),
        (lambda d: d.pop("settings"), InputError, "incomplete"),
        (lambda d: d.update(reference="loud"), InputError, "incomplete"),
        (lambda d: d.update(schema_version=99), IncompatibleError, "newer sononerf"),
        (other_field, IncompatibleError, "does not fit fourier and profile"),
        (unknown_key, IncompatibleError, r"settings of another version: .*fit\.speed"),
    ],
)
def test_a_wrong_description_is_told(run, change, error, message):
    damage(run, change)
    with pytest.raises(error, match=message) as caught:
        predict(run, accelerator="cpu")
    assert "\n" not in str(caught.value)
    assert not (run / "prediction").exists()


HULL = ["hull.emitters", "hull.receivers", "hull.first", "hull.axes", "hull.within"]


@pytest.mark.parametrize("name", [*HULL, "field.region"])
def test_weights_without_what_is_needed_are_told(run, name):
    state, description = load_weights(run)
    del state[name]
    save_weights(run, state, description)
    with pytest.raises(InputError, match=rf"incomplete \('{name}'\); repeat the fit") as caught:
        load_fitted(run)
    assert "\n" not in str(caught.value)
    assert "model.json" not in str(caught.value)  # which is whole


def test_what_is_loaded_knows_where_it_was_heard_from(run, echoes):
    store = EnsembleStore.open(echoes)
    heads = load_fitted(run).hull.sources
    # A head is some centimetres large.
    np.testing.assert_allclose(heads, store.positions[store.indices("train")], atol=0.03)


def test_what_is_loaded_knows_what_first_echoes_leave(run, echoes, tiny):
    """An ear that heard nothing goes with the weights like all others."""
    hull = echo_hull(tiny(), EnsembleStore.open(echoes))
    state, description = load_weights(run)
    state["hull.first"][3, 1] = -torch.inf
    save_weights(run, state, description)
    loaded = load_fitted(run).hull
    assert loaded.within == hull.within
    assert isinstance(loaded.within, float)
    for name in ("emitters", "receivers", "axes"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(hull, name))
    assert loaded.first[3, 1] == -np.inf
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))
    heard = hull.first.copy()
    heard[3, 1] = -np.inf
    expected = dataclasses.replace(hull, first=heard).clearance(points)
    np.testing.assert_array_equal(loaded.clearance(points), expected)


def test_damaged_or_missing_weights_are_told(run, tmp_path):
    data = bytearray((run / "model.safetensors").read_bytes())
    data[-5] ^= 1
    (run / "model.safetensors").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        predict(run, accelerator="cpu")
    with pytest.raises(InputError, match="no fitted run"):
        predict(tmp_path / "nowhere", accelerator="cpu")


def test_the_ensemble_that_is_gone_or_another(run, tiny, echoes, tmp_path):
    damage(run, lambda d: d["settings"]["data"].update(store=str(tmp_path / "gone")))
    with pytest.raises(InputError, match=r"is not there.*sononerf simulate.*--poses"):
        predict(run, accelerator="cpu")
    assert not (run / "prediction").exists()
    damage(run, lambda d: d["settings"]["data"].update(store=str(echoes)))
    damage(run, lambda d: d.update(echo_hash="0" * 64))
    with pytest.raises(IncompatibleError, match="other echoes"):
        store_of(load_fitted(run))


def test_a_gpu_that_is_not_there(run, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(ResourceError):
        predict(run, accelerator="gpu")
