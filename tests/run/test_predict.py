# SPDX-License-Identifier: MIT
"""Predictions need two files and run no code; where echoes were measured they are compared."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError
from sononerf.head.call import attach
from sononerf.head.directivity_files import write_sofa
from sononerf.head.front_end import compress
from sononerf.run import predict as predict_module
from sononerf.run.build import with_attached
from sononerf.run.fit import fit
from sononerf.run.predict import predict
from sononerf.run.run import Run
from sononerf.settings.loading import validate_settings
from tests.command import succeed
from tests.head.directivity.patterns import FREQUENCY, pair, sononerf_fields, write_v5

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
    ("pictures", "drawn"), [(0, 0), (3, 3), pytest.param("all", 8, marks=pytest.mark.slow)]
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


@pytest.fixture
def settings(tmp_path):
    ears, call = tmp_path / "bat.sofa", tmp_path / "call.wav"
    ears.write_bytes(b"an ear")
    call.write_bytes(b"a call")
    sections = {
        "scene": {"name": "three_spheres"},
        "ears": {"directivity": "file", "file": str(ears)},
        "call": {"kind": "file", "file": str(call)},
    }
    return validate_settings(sections, "test")


def test_copies_are_used_when_the_files_are_gone(settings, tmp_path):
    attach(settings, tmp_path / "run")
    settings.ears.file.unlink()
    settings.call.file.unlink()
    found = with_attached(settings, tmp_path / "run")
    assert found.ears.file.read_bytes() == b"an ear"
    assert found.call.file.read_bytes() == b"a call"
    assert found.ears.file.suffix == ".sofa"
    assert found.spectrogram == settings.spectrogram


def test_a_copy_is_not_replaced(settings, tmp_path):
    attach(settings, tmp_path / "run")
    settings.call.file.write_bytes(b"another")
    attach(settings, tmp_path / "run")
    assert with_attached(settings, tmp_path / "run").call.file.read_bytes() == b"a call"


def test_without_copies_the_settings_stay(settings, tmp_path):
    assert with_attached(settings, tmp_path / "elsewhere") is settings
    plain = validate_settings({"scene": {"name": "ua"}}, "test")
    attach(plain, tmp_path / "plain")
    assert not (tmp_path / "plain").exists()


def test_a_missing_file_is_named_and_nothing_is_written(settings, tmp_path):
    settings.ears.file.unlink()
    with pytest.raises(InputError, match=r"bat\.sofa: cannot be read \(No such file"):
        attach(settings, tmp_path / "run")
    assert not Path(tmp_path / "run").exists()


SHARPER = 4


def write_csv(path, ears, order=(0, 1)):
    """Write a table of gains; an order of (1, 0) gives each ear the other one's."""
    x, y, z = ears.directions.T
    azimuth = np.degrees(np.arctan2(y, x)).round(6)
    elevation = np.degrees(np.arcsin(z)).round(6)
    lines = ["receiver,azimuth_deg,elevation_deg,frequency_hz,gain"]
    for number, ear in enumerate(order):
        for m in range(len(x)):
            lines += [
                f"{number},{azimuth[m]},{elevation[m]},{frequency},{ears.gains[ear, m, f]:.9f}"
                for f, frequency in enumerate(FREQUENCY)
            ]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.slow
def test_the_right_ear_fits_better(tmp_path):
    ears = pair(beam=False)
    # Narrow lobes, so that much depends on them.
    ears = replace(ears, gains=ears.gains**SHARPER)
    sides = sononerf_fields()["array_struct"]
    for side in ("left_struct", "right_struct"):
        table = sides[side]["hrtf_gridded_array"]
        sides[side] = {**sides[side], "hrtf_gridded_array": table**SHARPER}
    write_sofa(tmp_path / "right.sofa", ears)
    write_v5(tmp_path / "right.mat", {"array_struct": sides})
    write_csv(tmp_path / "right.csv", ears)
    write_csv(tmp_path / "wrong.csv", ears, (1, 0))

    run = partial(succeed, tmp_path)
    places = "ears.receivers=[[0, 0.01, 0.002], [0, -0.01, 0.002]]"
    run(
        *("simulate", "scene.name=three_spheres", "poses.count=40", "simulation.rays=5000"),
        *("simulation.noise_floor_poses=0", "ears.directivity=file", "ears.file=right.sofa"),
        *(places, "--output", "direct", "--waveforms", "recordings"),
    )
    error = {}
    for name in ("right.sofa", "right.mat", "right.csv", "wrong.csv"):
        run("import", "recordings", "recordings", f"ears.file={name}", "--output", f"s-{name}")
        run(
            *("fit", f"data.store=s-{name}", "fit.epochs=3", "prediction.traced=off"),
            *("reconstruction.refine=false", "--output", f"r-{name}"),
        )
        metrics = json.loads((tmp_path / f"r-{name}/metrics.json").read_text())
        error[name] = metrics["prediction"]["mae_db_active"]
    right = max(error[name] for name in error if name.startswith("right"))
    assert right < 0.9 * error["wrong.csv"]
    assert right < 1.1 * error["right.sofa"]
