# SPDX-License-Identifier: MIT
"""Predictions need two files and run no code; where echoes were measured they are compared."""

from __future__ import annotations

import io
import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError
from sononerf.head.decibels import compress
from sononerf.run import predict as predict_module
from sononerf.run.fit import fit
from sononerf.run.predict import predict
from sononerf.run.run import Run

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
    monkeypatch.setattr(predict_module, "spectrogram_picture", lambda *given: b"")


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


@pytest.mark.parametrize(
    ("pictures", "drawn"),
    [("all", 8), (0, 0), (3, 3), pytest.param(100, 8, marks=pytest.mark.slow)],
)
def test_as_many_poses_are_drawn_as_wanted(run, pictures, drawn):
    folder = predict(run, split="train", pictures=pictures, accelerator="cpu")
    assert len(list(folder.glob("pose_*.png"))) == drawn


def test_best_median_and_worst_are_drawn(run):
    folder = predict(run, split="train", accelerator="cpu")
    arrays = arrays_of(folder)
    measured, predicted = (
        compress(arrays[k], arrays["reference"]) for k in ("measured", "predicted")
    )
    order = np.argsort(np.abs(measured - predicted).mean(axis=(1, 2, 3)))
    expected = {f"pose_{arrays['pose'][order[i]]:04d}.png" for i in (0, 4, 7)}
    assert {path.name for path in folder.glob("pose_*.png")} == expected


@pytest.mark.parametrize("pose", ["9,0,0,180,0,0", "0.4,0,-300,0,0,0", "1e200,0,0,180,0,0"])
def test_poses_that_can_hear_nothing_of_the_region_are_refused(run, tmp_path, pose):
    csv = tmp_path / "poses.csv"
    csv.write_text(f"{CSV}{pose}\n")
    with pytest.raises(InputError, match=r"poses\.csv: from pose 2 .* positions are in metres"):
        predict(run, poses_csv=csv, output=tmp_path / "out", accelerator="cpu")
    assert not (tmp_path / "out").exists()


def test_poses_within_the_region_are_told(run, tmp_path, no_pictures, caplog):
    csv = tmp_path / "poses.csv"
    lower, upper = Run(run).model.field.region.double().numpy()
    x, y, z = lower + 0.01 * (upper - lower)
    csv.write_text(f"{CSV}{x},{y},{z},0,0,0\n")
    within = Run(run)
    within.model.renderer.range[0] = 0.0
    predict(within, poses_csv=csv, accelerator="cpu")
    (told,) = caplog.messages
    assert told == "poses 2 lie within the fitted region, where none was trained"


def test_that_tracing_is_missing_is_told(run, no_pictures, caplog):
    predict(run, accelerator="cpu")
    predict(run, accelerator="cpu")  # nothing was traced
    Run(run).write_metrics("prediction", None)
    predict(run, accelerator="cpu")
    assert caplog.messages == []
    Run(run).write_metrics("prediction", {"traced_weight": 0.3})
    predict(run, accelerator="cpu")
    (told,) = caplog.messages
    assert f"{run / 'traced.safetensors'} is missing" in told
    assert "0.30" in told


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"reference": "loud"}, InputError, "incomplete"),
        ({"echo_hash": "0" * 64}, IncompatibleError, "other echoes"),
    ],
)
def test_what_cannot_be_predicted_leaves_no_folder(run, change, error, message):
    description = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps({**description, **change}))
    with pytest.raises(error, match=message):
        predict(run, accelerator="cpu")
    assert not (run / "prediction").exists()
