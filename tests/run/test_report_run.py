# SPDX-License-Identifier: MIT
"""One page of a run: what is there is shown, what is not is named with its command."""

from __future__ import annotations

import json
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError, NumericalError
from sononerf.run import report_run as report_module
from sononerf.run.report_run import report

METRICS = {
    "schema": 1,
    "cost": {"steps": 12, "fit_s": 61.4, "device": "cpu", "peak_memory_bytes": 7.2e8},
    "prediction": {
        "split": "test",
        "poses": 5,
        "mae_db": 0.287,
        "mae_db_active": 1.277,
        "mean_predictor_mae_db": 2.217,
        "mean_predictor_mae_db_active": 9.219,
        "noise_floor_mae_db": None,
        "rendered_mae_db": 0.825,
    },
    "geometry": {
        "chamfer_m": 0.00314,
        "fscore": {"0.001": 0.9, "0.005": 0.95},
        "thickness_bias_m": -0.00072,
        "components": 2,
        "components_true": 3,
        "target": {"fscore": {"0.005": 0.61}},
    },
    "baseline": {"backprojection": {"chamfer_m": 0.0046, "fscore": {"0.005": 0.74}}},
}
MEASURED = 0.5
# Louder than measured by more from the first to the last, but not in this order.
FACTORS = (1.4, 1.0, 3.0, 1.1, 1.2)
NUMBERS = (40, 41, 42, 43, 44)


@pytest.fixture
def run(fitted_run, tmp_path):
    path = tmp_path / "leaf-7"
    path.mkdir()
    for name in ("model.safetensors", "model.json", "config.yaml"):
        shutil.copy(fitted_run / name, path)
    return path


@pytest.fixture
def finished(run):
    (run / "metrics.json").write_text(json.dumps(METRICS))
    (run / "prediction").mkdir()
    measured = np.full((5, 2, 3, 4), MEASURED)
    np.savez(
        run / "prediction" / "spectrograms.npz",
        measured=measured,
        predicted=measured * np.reshape(FACTORS, (5, 1, 1, 1)),
        pose=np.array(NUMBERS),
        reference=np.asarray(1e-3),
    )
    for number in NUMBERS:
        (run / "prediction" / f"pose_{number:04d}.png").write_bytes(b"pose %d" % number)
    (run / "reconstruction").mkdir()
    for name in ("view", "mip_x", "mip_y", "mip_z"):
        (run / "reconstruction" / f"{name}.png").write_bytes(name.encode())
    return run


def rows_of(page):
    """The page's tables by the name of their rows."""
    lines = [line for line in page.read_text().splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: rest for first, *rest in cells}


def pictures_of(page):
    return re.findall(r"!\[[^]]*\]\(([^)]*)\)", page.read_text())


def test_numbers_stand_beside_those_of_the_baselines(finished):
    page = report(finished)
    assert page == finished / "report" / "report.md"
    rows = rows_of(page)
    assert rows["all cells"] == ["0.29", "2.22", "-", "0.82"]
    assert rows["active cells"] == ["1.28", "9.22", "-", "-"]
    assert rows["F-score at 5 mm"] == ["0.95", "0.74", "-"]
    assert rows["F-score at 1 mm"] == ["0.90", "-", "-"]
    assert rows["Chamfer distance, mm"] == ["3.14", "4.60", "-"]
    assert rows["thickness bias, mm"] == ["-0.72", "-", "-"]
    assert rows["parts"] == ["2", "-", "-"]
    text = page.read_text()
    assert text.startswith("# leaf-7\n")
    assert "12 steps, 61 s of fit on cpu, 0.7 GB of memory" in text
    assert "Mean over 5 poses that were never trained on" in text
    assert "F-score of the target alone, without its background: 0.61 at 5 mm." in text
    assert "In truth there are 3 parts." in text
    assert "radius: 0.02" in text  # the settings


def test_best_median_and_worst_pose_are_shown(finished):
    page = report(finished)
    found = re.findall(r"Pose (\d+), the (\w+) of 5: ([\d.]+) dB", page.read_text())
    assert [(int(n), name) for n, name, _ in found] == [(41, "best"), (44, "median"), (42, "worst")]
    # 20 log10 of the factor, for all is far above the reference.
    expected = [0.0, 20 * np.log10(1.2), 20 * np.log10(3.0)]
    np.testing.assert_allclose([float(db) for *_, db in found], expected, atol=0.03)
    assert (page.parent / "pose_0042.png").read_bytes() == b"pose 42"


def test_the_page_can_be_moved_with_its_pictures(finished, tmp_path):
    page = report(finished, output=tmp_path / "page")
    shown = pictures_of(page)
    assert len(shown) == 7
    assert {p.name for p in page.parent.iterdir()} == {"report.md", *shown}
    assert (page.parent / "mip_y.png").read_bytes() == b"mip_y"


def test_what_is_not_there_yet_is_named_with_its_command(run):
    text = report(run).read_text()
    for command in ("predict", "evaluate", "reconstruct"):
        assert f"`sononerf {command} {run}`" in text
    assert not pictures_of(run / "report" / "report.md")


def test_a_missing_picture_is_named(finished):
    (finished / "reconstruction" / "mip_y.png").unlink()
    page = report(finished)
    assert f"mip_y.png is missing; `sononerf reconstruct {finished}` makes it" in page.read_text()
    assert "mip_y.png" not in pictures_of(page)


def test_without_held_out_poses_nothing_is_asked_for(run):
    description = json.loads((run / "model.json").read_text())
    description["settings"]["poses"]["heldout"] = 0
    (run / "model.json").write_text(json.dumps(description))
    text = report(run).read_text()
    assert "No pose was held out" in text
    assert "sononerf predict" not in text


@pytest.mark.thorough
def test_the_papers_figures_have_their_counterparts(finished, monkeypatch):
    other = finished / "compare-empty"
    other.mkdir()
    told = {"second": "empty", "score": 0.553, "distance_m": 0.0063}
    (other / "comparison.json").write_text(json.dumps(told))
    (other / "mip_x.png").write_bytes(b"difference")
    drawn = []
    plain = report_module.scene_png

    def scene_png(mesh, positions, forward, *, split):
        drawn.append((len(positions), np.bincount(split).tolist()))
        return plain(mesh, positions, forward, split=split)

    monkeypatch.setattr(report_module, "scene_png", scene_png)
    page = report(finished, paper=True)
    assert drawn == [(12, [8, 2, 2])]
    shown = pictures_of(page)
    assert shown[-3:] == ["scene.png", "isosurface.png", "compare-empty-mip_x.png"]
    for name in ("scene.png", "isosurface.png"):
        assert (page.parent / name).read_bytes().startswith(b"\x89PNG")
    assert (page.parent / "compare-empty-mip_x.png").read_bytes() == b"difference"
    text = page.read_text()
    assert "Beside `empty` the strongest difference is 0.55 of the common maximum, 6.3 mm" in text
    assert "Sum over 100 directions" in text


def test_without_a_surface_the_page_says_so(finished, monkeypatch):
    def nothing(*given, **options):
        raise NumericalError("no surface: the field is silent everywhere")

    monkeypatch.setattr(report_module, "read_isosurface", nothing)
    text = report(finished, paper=True).read_text()
    assert "None: no surface: the field is silent everywhere." in text
    assert f"`sononerf compare {finished} OTHER`" in text


def test_a_damaged_prediction_is_named(finished):
    (finished / "prediction" / "spectrograms.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(InputError, match=r"spectrograms\.npz: damaged .*sononerf predict"):
        report(finished)
    assert not (finished / "report").exists()


@pytest.mark.parametrize(
    ("section", "holds"),
    [
        ("cost", {"fit_s": "long"}),
        ("prediction", {"mae_db": "x"}),
        ("geometry", [1]),
        ("geometry", {"fscore": {"a": 1}}),
        ("geometry", {"fscore": {}, "components": "three"}),
        ("baseline", "no"),
    ],
)
def test_numbers_that_are_none_are_named(finished, section, holds):
    (finished / "metrics.json").write_text(json.dumps({**METRICS, section: holds}))
    with pytest.raises(InputError, match=r"metrics\.json: damaged .*; remove it and repeat"):
        report(finished)


@pytest.mark.parametrize("text", ["[]", '{"score": "x"}', '{"score": 0.'])
def test_a_damaged_comparison_is_told_before_the_long_work(finished, monkeypatch, text):
    (finished / "compare-a").mkdir()
    (finished / "compare-a" / "comparison.json").write_text(text)
    monkeypatch.setattr(
        report_module, "read_isosurface", lambda *given, **more: pytest.fail("read out")
    )
    with pytest.raises(InputError, match=r"comparison\.json"):
        report(finished, paper=True)
    assert not (finished / "report").exists()  # nor pictures without a page


@pytest.mark.parametrize(
    ("method", "level", "said"),
    [
        ("isosurface", 2.5, "level as set: 2.5"),
        ("auto", 2.5, "level as set: 2.5"),
        ("filled", "auto", "level by Otsu's rule"),
    ],
)
def test_the_isosurface_is_drawn_as_the_settings_say(finished, monkeypatch, method, level, said):
    description = json.loads((finished / "model.json").read_text())
    own = {"method": method, "level": level, "spacing": 0.005, "directions": 12}
    own |= {"smoothing": 0.045} if method == "isosurface" else {}
    description["settings"]["reconstruction"] = own
    (finished / "model.json").write_text(json.dumps(description))
    asked = {}

    def read_out(field, **options):
        asked.update(options)
        mesh = trimesh.creation.icosphere()
        volume = SimpleNamespace(spacing=options["spacing"])
        return mesh, volume, 2.5

    monkeypatch.setattr(report_module, "read_isosurface", read_out)
    assert said in report(finished, paper=True).read_text()
    assert asked["level"] == level
    assert (asked["spacing"], asked["directions"]) == (0.005, 12)
    assert asked["smoothing"] == own.get("smoothing", 0.0)


def test_commands_can_be_copied_whatever_the_run_is_called(run):
    odd = run.rename(run.with_name("my leaf"))
    assert f"`sononerf predict '{odd}'`" in report(odd).read_text()


def test_a_run_is_no_place_for_a_page(finished):
    with pytest.raises(InputError, match="is the folder of a run"):
        report(finished, output=finished)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="no fitted run"):
        report(tmp_path)
