# SPDX-License-Identifier: MIT
"""The command line as people use it: the whole way, and every way in which it refuses."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
import typer
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sononerf import __version__, callbacks, storage
from sononerf.cli import __main__ as command
from sononerf.cli import app as application
from sononerf.evaluation import baseline
from sononerf.evaluation import numbers as geometry_module
from sononerf.field.checkpoint_io import load_weights, save_weights
from sononerf.run import fit as fit_module
from sononerf.settings.loading import read_yaml
from tests.small_views import draw_small

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
SMOKE = str(CONFIGS / "smoke.yaml")
COMMANDS = (
    "scenes new-plugin simulate import fit predict next reconstruct evaluate "
    "export calibrate compare report table doctor view".split()
)
SHORT = [  # of the smoke settings, so that a fit takes a second
    "poses.count=6",
    "poses.validation=1",
    "poses.heldout=1",
    "simulation.rays=500",
    "simulation.noise_floor_poses=1",
    "field.options.finest=0.02",
    "fit.epochs=2",
    "fit.steps_per_epoch=3",
    "preview.voxels=8",
]


def run(*arguments):
    """Give a command in this process; return its exit code, output and messages."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sononerf", *map(str, arguments)])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            with pytest.raises(SystemExit) as caught:
                command.main()
    return SimpleNamespace(code=caught.value.code or 0, out=out.getvalue(), err=err.getvalue())


def done(*arguments):
    result = run(*arguments)
    assert result.code == 0, result.err
    assert "Traceback" not in result.err
    return result


def refused(code, *arguments):
    """Give a command that must fail cleanly; return its message."""
    result = run(*arguments)
    assert result.code == code, result.err
    assert result.out == ""
    assert "Traceback" not in result.err
    lines = [line for line in result.err.splitlines() if not line.startswith("warning: ")]
    assert 1 <= len(lines) <= 10
    # A stop by a signal is the user's wish and no error.
    assert all(line.startswith("error: ") == (code < 128) for line in lines), result.err
    return "\n".join(lines)


def tree(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
        if path.name != ".lock"
    }


@pytest.fixture(scope="module")
def quick():
    """Fewer samples of surfaces, and no previews: both have tests of their own."""
    with pytest.MonkeyPatch.context() as patch:
        metrics = functools.partial(geometry_module.geometry_metrics, samples=3000)
        patch.setattr(geometry_module, "geometry_metrics", metrics)
        patch.setattr(geometry_module, "BASELINE_VOXELS", 24)
        patch.setattr(baseline, "LEVEL_SAMPLES", 500)
        draw_small(patch)
        yield


@pytest.fixture(scope="module")
def smoke(tmp_path_factory, quick):
    """The smoke settings, simulated and fitted by the commands of the README."""
    home = tmp_path_factory.mktemp("smoke")
    with contextlib.chdir(home):
        simulated = done("simulate", SMOKE, "--preview", "pictures")
        fitted = done("fit", SMOKE, "--accelerator", "cpu")
    return SimpleNamespace(home=home, run=home / "runs" / "smoke", simulated=simulated, fit=fitted)


@pytest.fixture
def at_home(smoke, monkeypatch):
    monkeypatch.chdir(smoke.home)
    return smoke


def test_every_promised_file_is_there(smoke):
    found = {str(path.relative_to(smoke.run)) for path in smoke.run.rglob("*") if path.is_file()}
    promised = {
        "config.yaml",
        "provenance.json",
        "metrics.json",
        "model.safetensors",
        "model.json",
        "traced.safetensors",
        "checkpoints/last.ckpt",
        "prediction/spectrograms.npz",
        *(f"prediction/pose_{number:04d}.png" for number in (52, 53, 54)),
        *(f"reconstruction/mesh.{kind}" for kind in ("ply", "stl", "glb")),
        "reconstruction/volume.vti",
        "reconstruction/view.png",
        "report.html",
        *(f"reconstruction/mip_{axis}.png" for axis in "xyz"),
        *(f"epochs/{epoch:04d}/metrics.json" for epoch in (1, 2, 3)),
        *(f"epochs/0003/mip_{axis}.png" for axis in "xyz"),
        "epochs/0003/mesh.ply",
    }
    assert promised <= found
    assert any(name.startswith("tensorboard/smoke/events") for name in found)
    hidden = {name for name in found if Path(name).name.startswith(".")}
    assert hidden <= {".lock"}  # nothing half-written
    assert (smoke.home / "pictures" / "scene.png").is_file()


def test_every_file_can_be_read(smoke):
    import pyvista
    import safetensors.torch

    for picture in smoke.home.rglob("*.png"):
        with Image.open(picture) as image:
            image.load()
            assert min(image.size) > (8 if "epochs" in picture.parts else 50), picture
    for path in smoke.run.rglob("mesh.*"):
        mesh = trimesh.load_mesh(path)
        assert len(mesh.faces) > 100, path
        assert np.abs(mesh.bounds).max() < 0.2, path  # metres
    assert pyvista.read(smoke.run / "reconstruction" / "volume.vti").n_points > 1000
    with np.load(smoke.run / "prediction" / "spectrograms.npz", allow_pickle=False) as arrays:
        assert arrays["predicted"].shape == arrays["measured"].shape
        assert len(arrays["predicted"]) == 3
    assert safetensors.torch.load_file(smoke.run / "model.safetensors")
    settings = read_yaml(smoke.run / "config.yaml")
    assert settings["fit"]["steps_per_epoch"] == 40
    assert settings["fit"]["seed"] == 0  # the defaults are there too


def finite_or_null(values):
    for value in values.values():
        if isinstance(value, dict):
            finite_or_null(value)
        elif isinstance(value, float):
            assert np.isfinite(value)


def test_the_numbers_are_those_of_schema_one(smoke):
    metrics = json.loads((smoke.run / "metrics.json").read_text())
    assert metrics["schema"] == 1
    assert metrics.keys() == {"schema", "prediction", "geometry", "baseline", "cost"}
    both = ("mae_db", "mean_predictor_mae_db", "noise_floor_mae_db")
    assert metrics["prediction"].keys() == {
        *("split", "poses", "log_spectral_distance_db", "psnr_db", "ssim", "pearson"),
        *("rendered_mae_db", "rendered_mae_db_active", "traced_weight", "traced_fault"),
        *("noise_floor_of", "interval_coverage"),
        *both,
        *(f"{name}_active" for name in both),
    }
    geometry = {
        *("chamfer_m", "fscore", "thickness_bias_m", "volume_ratio", "iou"),
        *("normal_consistency", "components", "components_true", "level"),
    }
    assert metrics["geometry"].keys() == geometry
    assert metrics["geometry"]["fscore"].keys() == {"0.001", "0.002", "0.005"}
    assert metrics["baseline"]["backprojection"].keys() == geometry
    assert metrics["baseline"]["voxels"].keys() == geometry
    assert metrics["cost"].keys() == {
        *("simulate_s", "fit_s", "reconstruct_s", "steps", "points_evaluated"),
        *("peak_memory_bytes", "device", "parameters"),
    }
    assert metrics["cost"]["steps"] == 120
    finite_or_null(metrics)
    assert 0 <= metrics["prediction"]["traced_weight"] <= 1


def test_it_learns(smoke):
    events = EventAccumulator(str(smoke.run / "tensorboard" / "smoke"))
    events.Reload()
    losses = [scalar.value for scalar in events.Scalars("training/loss")]
    # For three quarters of the fit the loss hears the loud echoes alone, then the faint ones too.
    early = losses[: len(losses) * 3 // 4]
    assert np.mean(early[-3:]) < 0.6 * np.mean(early[:3])
    errors = [scalar.value for scalar in events.Scalars("validation_error_dB/all_cells")]
    assert errors == sorted(errors, reverse=True)
    tags = events.Tags()
    assert {"spectrogram/validation_pose_0", "projections"} <= set(tags["images"])
    assert "mesh/field_VERTEX" in tags["tensors"]
    assert "final/Chamfer_mm" in tags["scalars"]
    metrics = json.loads((smoke.run / "metrics.json").read_text())
    prediction = metrics["prediction"]
    assert prediction["mae_db"] < 0.75 * prediction["mean_predictor_mae_db"]
    assert prediction["mae_db_active"] < 0.75 * prediction["mean_predictor_mae_db_active"]
    assert metrics["geometry"]["components_true"] == 3
    assert metrics["geometry"]["fscore"]["0.005"] > 0.9
    baseline_metrics = metrics["baseline"]["backprojection"]
    assert metrics["geometry"]["chamfer_m"] < 0.5 * baseline_metrics["chamfer_m"]


def test_what_is_printed(smoke):
    assert smoke.simulated.out == ""
    assert "wrote data/three_spheres-" in smoke.simulated.err
    assert "region " in smoke.fit.err
    text = smoke.fit.out  # results, with --quiet too
    for words in (
        "prediction of 3 held-out poses: ",
        "geometry: Chamfer ",
        "parts (true: 3)",
        "backprojection instead: ",
        "report:      runs/smoke/report.html",
        "mesh:        runs/smoke/reconstruction/mesh.ply",
        "numbers:     runs/smoke/metrics.json",
        "tensorboard --logdir runs/smoke",
    ):
        assert words in text
    # Plain lines where there is no terminal; nothing of the libraries' own talk.
    for noise in ("\x1b", "\r", "━", "LeafSpec", "GPU available", "lightning.pytorch", "Tip:"):
        assert noise not in text + smoke.fit.err
    assert len(list((smoke.home / "data").iterdir())) == 1  # the fit took what was simulated


def test_a_finished_run_is_left_as_it_is_and_says_so(at_home):
    before = tree(at_home.run)
    result = done("fit", SMOKE, "--accelerator", "cpu")
    assert "runs/smoke: is finished; --overwrite fits it anew" in result.err
    assert "geometry: Chamfer" in result.out
    assert tree(at_home.run) == before
    assert done("fit", SMOKE, "--accelerator", "cpu", "--quiet").out == result.out


def test_the_error_is_told_and_what_twice_as_many_poses_would_change(at_home):
    file = at_home.run / "reconstruction" / "read_out.json"
    known = file.read_text()
    errors = {"median_error_m": 5e-4, "median_error_from_twice_m": 4e-4}
    file.write_text(json.dumps(json.loads(known) | errors))
    try:
        said = done("fit", SMOKE, "--accelerator", "cpu").out
    finally:
        file.write_text(known)
    assert "error of the surface: 0.50 mm" in said
    assert "twice as many poses it would be about 0.40 mm" in said


def test_all_settings_are_printed_and_make_the_same(at_home, tmp_path):
    call = ["call.kind=linear", "call.duration=3e-3", "call.frequency_end=30e3"]
    text = done("fit", SMOKE, *call, "--print-config").out
    (tmp_path / "all.yaml").write_text(text)
    assert done("fit", tmp_path / "all.yaml", "--print-config").out == text
    analysis = read_yaml(tmp_path / "all.yaml")["spectrogram"]
    assert (analysis["frequency_min"], analysis["frequency_max"]) == (30e3, 150e3)
    assert analysis["hop"] == analysis["window"] // 16 > 4


def test_a_precision_that_lightning_refuses_is_one_line(at_home, tmp_path):
    output = ["--output", tmp_path / "run"]
    assert "Lightning: Precision '15'" in refused(2, "fit", SMOKE, *output, "--precision", "15")


def test_other_settings_in_the_same_folder_are_refused(at_home):
    before = tree(at_home.home)
    message = refused(8, "fit", SMOKE, "fit.learning_rate=0.1", "--seed", 3)
    assert "(fit.learning_rate, fit.seed)" in message
    assert "--overwrite" in message
    assert tree(at_home.home) == before


def test_evaluate_prints_one_json_object(at_home):
    result = done("evaluate", "runs/smoke", "--json")
    assert json.loads(result.out) == json.loads((at_home.run / "metrics.json").read_text())
    assert result.err == ""


def test_predict_poses_of_ones_own(at_home, tmp_path):
    csv = tmp_path / "mine.csv"
    csv.write_text("x,y,z,yaw,pitch,roll\n-0.4,0,0,0,0,0\n")
    elsewhere = tmp_path / "only"
    elsewhere.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(at_home.run / name, elsewhere)
    with contextlib.chdir(tmp_path):  # no ensemble here
        done("predict", "only", "--poses", csv, "--output", "there", "--accelerator", "cpu")
        assert "sononerf simulate" in refused(3, "predict", "only")
    with np.load(tmp_path / "there" / "spectrograms.npz", allow_pickle=False) as arrays:
        assert len(arrays["predicted"]) == 1
    assert sorted(p.name for p in elsewhere.iterdir()) == ["model.json", "model.safetensors"]


@pytest.mark.slow
def test_reconstruct_with_spacing_and_level(at_home, tmp_path):
    before = tree(at_home.run)
    options = ("--spacing", "0.012", "--level", "0.4", "--output", tmp_path / "coarse")
    assert f"wrote {tmp_path / 'coarse'}" in done("reconstruct", "runs/smoke", *options).err
    said = json.loads((tmp_path / "coarse" / "read_out.json").read_text())
    assert (said["spacing_m"], said["level"]) == (pytest.approx(0.012), pytest.approx(0.4))
    assert said["method"] == "isosurface"
    done("reconstruct", "runs/smoke", "--no-refine", "--output", tmp_path / "start")
    said = json.loads((tmp_path / "start" / "read_out.json").read_text())
    assert (said["method"], said["level"], said["refined"]) == ("levels", None, False)
    assert tree(at_home.run) == before


def test_the_options_of_one_scene_are_told():
    assert "curl" in done("scenes", "leaf").out
    found = json.loads(done("scenes", "leaf", "--json").out)
    assert {"name": "curl", "default": 60.0}.items() <= found["options"][3].items()
    assert "did you mean leaf?" in refused(2, "scenes", "lef")
    assert "leave NAME out" in refused(2, "scenes", "leaf", "--preview", "there")


@pytest.mark.slow
def test_two_runs_are_compared(at_home, tmp_path):
    state, description = load_weights(at_home.run)
    state["renderer.log_gain"] -= 0.5
    (tmp_path / "quiet").mkdir()
    save_weights(tmp_path / "quiet", state, description)
    before = tree(at_home.run)
    output = ("--output", tmp_path / "c", "--accelerator", "cpu")
    said = done("compare", "runs/smoke", tmp_path / "quiet", *output).err
    assert f"wrote {tmp_path / 'c'}" in said
    assert "strongest difference at (" in said
    said = done("compare", tmp_path / "quiet", "runs/smoke", *output).err
    assert f"nothing is stronger in {tmp_path / 'quiet'} than in runs/smoke" in said
    assert "strongest" not in said
    assert "are the same run" in refused(2, "compare", "runs/smoke", "runs/smoke", *output)
    assert tree(at_home.run) == before


@pytest.fixture
def fit_alone(monkeypatch):
    """Let `fit` leave out what follows the fit; return of what it would have followed."""
    called = []
    monkeypatch.setattr(
        fit_module, "finish", lambda run, *, accelerator, progress: called.append(run) or {}
    )
    monkeypatch.setattr(callbacks.SpectrogramImages, "on_train_epoch_end", lambda *given: None)
    return called


@pytest.mark.slow
def test_overwrite_moves_the_old_run_aside(fit_alone, clean):
    command = ("fit", SMOKE, *SHORT, "--accelerator", "cpu", "--output", "run")
    done(*command)
    first = (clean / "run" / "model.safetensors").read_bytes()
    result = done(*command, "--overwrite", "--seed", "7")
    assert "moved the old run to" in result.err
    assert (clean / "run.old-1" / "model.safetensors").read_bytes() == first
    assert (clean / "run" / "model.safetensors").read_bytes() != first


@pytest.mark.slow
def test_a_plugins_scene_goes_the_whole_way(plugin, quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    listed = {row["name"]: row for row in json.loads(done("scenes", "--json").out)["scenes"]}
    assert listed["fixture_bar"]["distribution"] == "sononerf-fixture"
    overrides = ["scene.name=fixture_bar", "scene.options={length: 0.05}", "preview.every_epochs=9"]
    done("fit", SMOKE, *overrides, "--accelerator", "cpu", "--output", "bar")
    metrics = json.loads((tmp_path / "bar" / "metrics.json").read_text())
    assert metrics["geometry"]["chamfer_m"] < 0.01
    mesh = trimesh.load_mesh(tmp_path / "bar" / "reconstruction" / "mesh.ply")
    assert mesh.extents[2] == max(mesh.extents)  # it stands
    assert (tmp_path / "bar" / "reconstruction" / "view.png").is_file()


@pytest.mark.slow
def test_scenes_are_listed_for_people_and_for_programs():
    text = done("scenes")
    assert text.err == ""
    assert text.out.splitlines()[0].split() == ["name", "from", "size", "(mm)", "triangles"]
    (line,) = (line for line in text.out.splitlines() if line.startswith("box "))
    assert line.split()[:9] == ["box", "sononerf", __version__, "80", "x", "60", "x", "50", "12"]
    rows = json.loads(done("scenes", "--json").out)["scenes"]
    assert rows[0].keys() == {
        *("name", "distribution", "version", "broken", "options", "needs", "size_m"),
        *("triangles", "summary"),
    }
    assert not any(row["broken"] for row in rows)


def test_a_new_scene_is_written_and_what_to_do_next_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = done("new-plugin", "scene", "tin-drum")
    assert text.err.splitlines() == [
        *(f"wrote tin-drum/{name}" for name in ("pyproject.toml", "tin_drum.py")),
        "wrote tin-drum/test_tin_drum.py",
        "next:",
        "  python -m pip install -e ./tin-drum",
        "  python -m pytest tin-drum",
        "  sononerf fit scene.name=tin_drum",
    ]
    assert "field.kind=net" in done("new-plugin", "field", "net").err
    assert "renderer.kind=ears" in done("new-plugin", "renderer", "ears").err
    assert "--output" in refused(2, "new-plugin", "scene", "tin-drum")
    assert "sphere" in refused(2, "new-plugin", "scene", "sphere", "--output", "other")
    assert not Path("other").exists()
    assert "a part of the path is a file" in refused(
        4, "new-plugin", "scene", "tin", "--output", "tin-drum/pyproject.toml/bar"
    )


# How it refuses.


@pytest.fixture
def clean(tmp_path, monkeypatch):
    """An empty working directory, in which a refused command must leave nothing."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    return home


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["poses.cuont=3"], ["poses.cuont", "unknown key", "did you mean count?"]),
        (["fitt.epochs=3"], ["fitt", "unknown key", "did you mean fit?"]),
        (["fit.epochs=many"], ["fit.epochs", "'many'"]),
        (["poses.radius=-0.4"], ["poses.radius", "-0.4", "greater than 0"]),
        (["poses.count=0"], ["poses.count", "greater than or equal to 1"]),
        (["spectrogram.range_min=0.6"], ["range_min must lie below range_max"]),
        (["poses.radius=.nan"], ["poses.radius"]),
        (["fit.epochs=3", "fit.epochs"], ["'fit.epochs'", "expected KEY=VALUE"]),
        (["scene.name.x=1"], ["scene.name.x", "is a value, not a section"]),
        (["scene.name=sphree", "scene.options={}"], ["unknown scene 'sphree'", "sphere"]),
        (["field.kind=gird"], ["unknown field 'gird'", "did you mean grid"]),
        (["renderer.kind=x"], ["unknown renderer 'x'", "profile, shell"]),
        (["scene.options.radius=-1"], ["scene.options", "radius", "greater than 0"]),
        (["field.options.fines=1"], ["field.options", "fines", "did you mean finest?"]),
        (["renderer.options.points=0"], ["renderer.options", "points"]),
        (["--seed", "4294967296"], ["fit.seed", "less than 4294967296"]),
        (["--frobnicate"], ["no such option", "--frobnicate", "sononerf fit --help"]),
        (["--devices", "0"], ["--devices", "greater than or equal to 1"]),
        (["--accelerator", "abacus"], ["--accelerator", "abacus"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_wrong_settings_and_options(clean, arguments, words):
    message = refused(2, "fit", SMOKE, *arguments, "--output", "run")
    for word in words:
        assert word in message
    assert tree(clean) == {}


@pytest.mark.parametrize("command", ["fit", "simulate"])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ["mine.yaml", "no such settings file"]),
        ("scene: [", ["mine.yaml:1"]),
        ("scene:\n  name: sphere\nscene:\n  name: ua\n", ["mine.yaml:3", "duplicate key"]),
        ("- a\n", ["mine.yaml", "holds list"]),
        ("", ["mine.yaml", "scene: missing"]),
        ("scene: {name: sphere}\nfit: {epochs: !!python/name:os.system x}\n", ["mine.yaml:2"]),
        ("scene: {name: sphere}\nposes: {cuont: 1, radius: far}\n", ["count?", "poses.radius"]),
        ("\x00", ["mine.yaml"]),
    ],
)
def test_settings_files_that_are_none(clean, command, content, words):
    if content is not None:
        Path("mine.yaml").write_text(content)
    before = tree(clean)
    message = refused(2, command, "mine.yaml", "--output", "out")
    for word in words:
        assert word in message
    assert tree(clean) == before


def test_faults_of_a_scenes_options_name_the_file(clean):
    Path("mine.yaml").write_text("scene: {name: sphere, options: {radios: 1}}\n")
    message = refused(2, "simulate", "mine.yaml", "--output", "out")
    assert message.startswith("error: mine.yaml: scene.options.radios: unknown key; did you mean ")


def test_several_faults_are_told_at_once(clean):
    message = refused(2, "fit", SMOKE, "poses.count=0", "fit.epochs=0")
    assert len(message.splitlines()) == 2


STL = trimesh.creation.box((0.05, 0.05, 0.05)).export(file_type="stl")


def test_a_mesh_needs_its_unit(clean):
    Path("mine.stl").write_bytes(STL)
    scene = ["scene.name=mesh", "scene.options={path: mine.stl}"]
    assert "scene.options.unit" in refused(3, "fit", SMOKE, *scene, "--output", "out")
    scene = ["scene.name=mesh", "scene.options={path: mine.stl, unit: inch}"]
    assert "unit" in refused(2, "fit", SMOKE, *scene, "--output", "out")


def test_poses_inside_the_scene(clean):
    message = refused(3, "fit", SMOKE, "poses.radius=0.03", "--output", "out")
    assert "pose" in message
    assert tree(clean) == {}


@pytest.mark.slow
def test_a_broken_plugin_hurts_only_who_asks_for_it(clean, tmp_path, monkeypatch):
    folder = tmp_path / "plugins"
    info = folder / "broken-2.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text("[sononerf.scenes]\nbroken = no_such_module:make\n")
    monkeypatch.syspath_prepend(folder)
    wanted = ["scene.name=broken", "scene.options={}"]
    assert "broken 2.0 cannot be loaded" in refused(3, "fit", SMOKE, *wanted, "--output", "out")
    assert tree(clean) == {}
    assert "broken: " in done("scenes").out


@pytest.mark.parametrize("command", ["fit", "simulate"])
def test_a_scene_that_no_pose_hears(clean, command):
    limits = ["spectrogram.range_min=1.0", "spectrogram.range_max=1.1"]
    message = refused(5, command, SMOKE, *limits, "--output", "out")
    assert "no pose received an echo between 1.0 and 1.1 m" in message
    assert {path for path in tree(clean) if path.startswith("out")} == set()


@pytest.mark.parametrize("output", ["file", "file/run", "/dev/null/x", "/proc/nowhere/x"])
@pytest.mark.parametrize("command", ["fit", "simulate"])
def test_folders_that_cannot_be_written(clean, command, output):
    Path("file").write_text("mine")
    before = tree(clean)
    message = refused(4, command, SMOKE, *SHORT, "--output", output)
    assert output.split("/x")[0] in message
    assert tree(clean) == before


def test_pictures_of_scenes_need_a_folder(clean):
    Path("file").write_text("x")
    assert "file" in refused(4, "scenes", "--preview", "file")


def test_pictures_of_an_ensemble_need_a_folder_before_it_is_simulated(clean):
    Path("file").write_text("x")
    before = tree(clean)
    assert "file" in refused(4, "simulate", SMOKE, *SHORT, "--preview", "file")
    assert tree(clean) == before


def test_a_folder_that_is_no_run(clean):
    Path("thesis").mkdir()
    Path("thesis/chapter.tex").write_text("mine")
    before = tree(clean)
    assert "is no run" in refused(3, "fit", SMOKE, "--output", "thesis")
    assert "is no run" in refused(3, "fit", SMOKE, "--output", "thesis", "--overwrite")
    assert tree(clean) == before


def test_a_folder_in_use(clean):
    with storage.lock(Path("run")):
        message = refused(7, "fit", SMOKE, "--output", "run")
        assert "in use by another process" in message
        assert "in use" in refused(7, "fit", SMOKE, "--output", "run", "--overwrite")
    assert [path for path in tree(clean) if path != "run"] == []


@pytest.mark.parametrize("command", ["predict", "reconstruct", "evaluate"])
def test_runs_that_are_not_there_or_not_finished(clean, command):
    assert "nowhere: no fitted run" in refused(3, command, "nowhere")
    Path("empty").mkdir()
    assert "sononerf fit" in refused(3, command, "empty")
    assert tree(clean) == {"empty": None}


@pytest.mark.parametrize("command", ["predict", "reconstruct", "evaluate"])
@pytest.mark.parametrize("name", ["model.safetensors", "model.json"])
def test_runs_that_are_damaged(smoke, clean, command, name):
    Path("run").mkdir()
    for file in ("model.safetensors", "model.json"):
        shutil.copy(smoke.run / file, "run")
    data = bytearray((clean / "run" / name).read_bytes())
    del data[len(data) // 2 :]
    (clean / "run" / name).write_bytes(data)
    before = tree(clean)
    assert name in refused(3, command, "run")
    assert tree(clean) == before


def test_a_damaged_surface_to_trace_echoes_off(smoke, clean):
    Path("run").mkdir()
    for file in ("model.safetensors", "model.json"):
        shutil.copy(smoke.run / file, "run")
    data = (smoke.run / "traced.safetensors").read_bytes()
    (clean / "run" / "traced.safetensors").write_bytes(data[: len(data) // 2])
    Path("mine.csv").write_text("x,y,z,yaw,pitch,roll\n-0.4,0,0,0,0,0\n")
    message = refused(3, "predict", "run", "--poses", "mine.csv", "--output", "out")
    assert len(message.splitlines()) == 1
    assert "run/traced.safetensors: damaged" in message
    assert "sononerf fit" in message
    assert not Path("out/spectrograms.npz").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ["mine.csv", "cannot be read"]),
        ("", ["mine.csv", "header"]),
        ("x,y,z\n0,0,0\n", ["x,y,z,yaw,pitch,roll"]),
        ("x,y,z,yaw,pitch,roll\n", ["no poses"]),
        ("x,y,z,yaw,pitch,roll\n0,0,far,0,0,0\n", ["mine.csv:2", "z"]),
        ("x,y,z,yaw,pitch,roll\n0,0,nan,0,0,0\n", ["mine.csv:2", "z"]),
        ("x,y,z,yaw,pitch,roll\n0,0,0\n", ["mine.csv:2"]),
    ],
)
def test_tables_of_poses_that_are_none(smoke, clean, content, words):
    if content is not None:
        Path("mine.csv").write_text(content)
    before = tree(clean)
    message = refused(3, "predict", smoke.run, "--poses", "mine.csv", "--output", "out")
    for word in words:
        assert word in message
    assert tree(clean) == before


@pytest.mark.parametrize(
    "options",
    [
        ("--level", "high"),
        ("--level", "nan"),
        ("--level", "-1"),
        ("--spacing", "0"),
        ("--spacing", "nan"),
        ("--spacing", "wide"),
        ("--method", "oriented"),
    ],
)
def test_wrong_options_of_the_read_out(smoke, clean, options):
    assert options[0] in refused(2, "reconstruct", smoke.run, *options, "--output", "out")
    assert tree(clean) == {}


@pytest.mark.slow
def test_a_run_has_a_page(at_home, tmp_path):
    before = tree(at_home.run)
    for extra in ([], ["--paper"]):
        target = tmp_path / "page.html"
        said = done("report", "runs/smoke", "--output", target, *extra).err
        assert f"wrote {target}" in said
        page = target.read_text()
        assert "<h1>smoke</h1>" in page
        assert ("As in the paper" in page) == bool(extra)
    assert tree(at_home.run) == before


def test_only_an_isosurface_has_a_level(smoke, clean):
    options = ("--method", "levels", "--level", "0.4", "--output", "out")
    assert "method levels has no level" in refused(2, "reconstruct", smoke.run, *options)
    assert tree(clean) == {}


def test_a_surface_that_is_not_there(smoke, clean):
    refused(5, "reconstruct", smoke.run, "--level", "1e9", "--output", "there/out")
    assert tree(clean) == {}


@pytest.mark.parametrize("command", ["predict", "reconstruct", "compare"])
def test_results_do_not_go_into_a_runs_own_folder(at_home, tmp_path, command):
    before, given = tree(at_home.run), ["runs/smoke"]
    if command == "compare":
        shutil.copytree(at_home.run, tmp_path / "other")
        given.append(tmp_path / "other")
    message = refused(3, command, *given, "--output", "runs/smoke")
    assert "runs/smoke: is the folder of a run; give --output" in message
    assert tree(at_home.run) == before


def test_split_and_poses_exclude_each_other(smoke, clean):
    message = refused(2, "predict", smoke.run, "--split", "test", "--poses", "mine.csv")
    assert "exclude each other" in message


def test_workers_and_scheduler_exclude_each_other(clean):
    message = refused(2, "simulate", SMOKE, "--workers", "1", "--scheduler", "tcp://x:1")
    assert "exclude each other" in message
    assert tree(clean) == {}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("command", ["fit", "predict"])
def test_a_gpu_that_is_not_there(smoke, clean, command, monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    if command == "fit":
        arguments = [SMOKE, "--output", "out"]
    else:
        Path("mine.csv").write_text("x,y,z,yaw,pitch,roll\n-0.4,0,0,0,0,0\n")
        arguments = [smoke.run, "--poses", "mine.csv", "--output", "out"]
    assert "--accelerator cpu" in refused(6, command, *arguments, "--accelerator", "gpu")
    assert not Path("out/spectrograms.npz").exists()


def test_a_fault_of_ours_is_one_line_and_a_file_with_its_traceback(monkeypatch, tmp_path):
    def broken():
        raise ZeroDivisionError("ours\nand more")

    from sononerf.run import scenes

    monkeypatch.setattr(scenes, "describe_scenes", broken)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    line = refused(1, "scenes")
    assert line.startswith(
        "error: unforeseen: ZeroDivisionError: ours; this is a fault of sononerf"
    )
    kept = Path(line.rpartition(" ")[2])
    assert kept.is_relative_to(tmp_path)
    assert "in broken" in kept.read_text()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    assert refused(1, "scenes").endswith("or of a plugin")


# Help.


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)], ids=" ".join)
def test_help(command):
    result = done(*command, "--help")
    assert result.out.startswith("Usage: ")
    assert result.err == ""


def test_all_commands_are_here():
    assert sorted(typer.main.get_command(application.complete()).commands) == sorted(COMMANDS)


def test_nothing_and_nonsense_are_wrong_usage():
    result = run()
    assert result.code == 2
    assert "Commands:" in result.err
    assert "no such command 'frobnicate'" in refused(2, "frobnicate")
    assert "did you mean 'fit'" in refused(2, "fti")
    assert "missing argument" in refused(2, "fit")
    assert done("--version").out.startswith("sononerf ")


def test_quiet_leaves_results_and_errors(clean):
    assert done("--quiet", "new-plugin", "scene", "my_bar").err == ""
    assert (clean / "my_bar").is_dir()
    assert done("--quiet", "--version").out.startswith("sononerf ")
    assert "my_bar" in refused(2, "--quiet", "new-plugin", "scene", "my_bar")
    assert "wrote" in done("new-plugin", "scene", "my_bat").err


# Signals.


@pytest.mark.parametrize("place", ["typer", "sononerf.cli.files"])
def test_sigterm_while_the_command_line_is_imported_is_told(tmp_path, place):
    """A signal comes as a module is imported that the command line needs from the first."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {place!r}:\n"
        "            os.kill(os.getpid(), 15)\n"
        "sys.meta_path.insert(0, Finder())\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "sononerf.cli", "simulate", "smoke"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert done.returncode == 143
    assert done.stderr == "stopped; the same command goes on where it stopped\n"


@pytest.mark.slow
def test_sigterm_stops_a_fit_in_time_and_the_same_command_goes_on(clean, fit_alone, monkeypatch):
    arguments = [
        *("fit", SMOKE, *SHORT, "fit.epochs=20", "fit.steps_per_epoch=10"),
        *("preview.every_epochs=100", "--accelerator", "cpu", "--output", "run"),
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "sononerf.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    checkpoint = clean / "run" / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 90
    while not checkpoint.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    asked = time.monotonic()
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert time.monotonic() - asked < 5
    assert (process.returncode, out) == (143, "")
    last = err.strip().splitlines()[-1]
    assert last.startswith("stopped at step ")
    assert last.endswith(" of 200; the same command goes on")
    stopped = int(last.split()[3])
    assert 10 <= stopped < 200
    for noise in ("Traceback", "LeafSpec", "\x1b"):
        assert noise not in err
    assert not storage.is_held(clean / "run")

    steps = []

    def count(self, trainer, pl_module, *rest):
        steps.append(pl_module.global_step)

    monkeypatch.setattr(callbacks.PreviewCallback, "on_train_batch_end", count)
    done(*arguments)
    assert steps == list(range(stopped + 1, 201))
    assert json.loads((clean / "run" / "metrics.json").read_text())["cost"]["steps"] == 200


def test_an_argument_that_is_no_utf_8_is_refused_at_once(tmp_path):
    name = os.fsencode(tmp_path) + b"/run\xe9"
    command = [sys.executable, "-m", "sononerf.cli", "simulate", "sphere", "--output", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "holds bytes that are no UTF-8" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_deleted_working_folder_is_one_line(tmp_path):
    command = ["sh", "-c", f'rmdir "$PWD"; exec {sys.executable} -m sononerf.cli scenes']
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 4
    assert done.stderr == "error: the working folder was deleted; change to another one\n"


def test_what_a_sweep_cannot_tell_is_said(at_home, tmp_path):
    options = ["fit.max_steps=2", "reconstruction.refine=false", "--output", tmp_path / "run"]
    said = done("fit", SMOKE, "call.preset=fm_3ms", *options).err
    assert "the echo of a point is 53 mm long in range; that of an impulse is 6 mm" in said
    assert "wrong by about 8 mm" in said
