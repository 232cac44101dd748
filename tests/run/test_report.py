# SPDX-License-Identifier: MIT
"""One page of runs: what is there is shown, what is not is named with its command."""

from __future__ import annotations

import base64
import html
import io
import json
import re
import shutil
import time

import numpy as np
import pytest
import trimesh
from PIL import Image

from sononerf.errors import InputError
from sononerf.report.mesh_picture import SurfaceViews
from sononerf.run import report as report_module
from sononerf.run.evaluate import table
from sononerf.run.report import report as write_report
from sononerf.start.surface import mesh_bytes
from tests.browser import CHROMIUM, browser

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
POSES = ("pose_0041", "pose_0042", "pose_0044")  # best, worst and median


@pytest.fixture
def run(fitted_run, tmp_path):
    path = tmp_path / "leaf-7"
    path.mkdir()
    for name in ("model.safetensors", "model.json", "config.yaml"):
        shutil.copy(fitted_run / name, path)
    return path


@pytest.fixture
def finished(run, monkeypatch):
    (run / "metrics.json").write_text(json.dumps(METRICS))
    (run / "prediction").mkdir()
    measured = np.full((5, 2, 3, 4), MEASURED)
    np.savez(
        run / "prediction" / "spectrograms.npz",
        measured=measured,
        predicted=measured * np.reshape(FACTORS, (5, 1, 1, 1)),
        pose=np.array(NUMBERS),
        range_m=np.array([0.3, 0.31, 0.32]),
        frequency_hz=np.array([2e4, 4e4, 6e4, 8e4]),
        reference=np.asarray(1e-3),
    )
    for number in NUMBERS:
        (run / "prediction" / f"pose_{number:04d}.png").write_bytes(b"pose %d" % number)
    (run / "reconstruction").mkdir()
    for name in ("view", "mip_x", "mip_y", "mip_z"):
        (run / "reconstruction" / f"{name}.png").write_bytes(name.encode())
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.021)
    mesh.apply_scale([1.0, 1.0, 1.5])
    data = mesh_bytes(mesh, "ply", confidence=np.arange(len(mesh.vertices)))
    (run / "reconstruction" / "mesh.ply").write_bytes(data)
    (run / "reconstruction" / "read_out.json").write_text("{}")
    monkeypatch.setattr(report_module, "SIDES", (90, 80))
    return run


def report(run, **options):
    return write_report(run, **options)


def plain(page):
    """The page's text, without pictures and scripts."""
    text = re.sub(r"<(script|style).*?</\1>", "", page.read_text(), flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]*>", "", text))


def rows_of(page):
    """The page's tables by the name of their rows."""
    rows = re.findall(r"<tr>(.*?)</tr>", page.read_text())
    cells = [re.findall(r"<t[dh]>(.*?)</t[dh]>", row) for row in rows]
    return {first: rest for first, *rest in cells}


def pictures_of(page):
    """The page's pictures by their captions."""
    found = re.findall(r'<img src="data:image/png;base64,([^"]*)" alt="([^"]*)"', page.read_text())
    return {html.unescape(caption): base64.b64decode(data) for data, caption in found}


def test_numbers_stand_beside_those_of_the_baselines(finished):
    page = report(finished)
    assert page == finished / "report.html"
    rows = rows_of(page)
    assert rows["held-out error, all cells, dB"] == ["0.29"]
    assert rows["field alone, all cells, dB"] == ["0.82"]
    assert rows["mean spectrogram, active cells, dB"] == ["9.22"]
    assert rows["F-score at 5 mm"] == ["0.95"]
    assert rows["backprojection: F-score at 5 mm"] == ["0.74"]
    assert rows["F-score at 1 mm"] == ["0.90"]
    assert rows["backprojection: Chamfer distance, mm"] == ["4.60"]
    assert rows["thickness bias, mm"] == ["-0.72"]
    assert rows["parts"] == ["2"]
    assert rows["parts in truth"] == ["3"]
    assert rows["fit, s"] == ["61"]
    text = plain(page)
    assert "<title>leaf-7</title>" in page.read_text()
    assert "12 steps, 61 s of fit on cpu, 0.7 GB of memory" in text
    assert "mean over 5 poses that were never trained on" in text
    assert rows["target alone: F-score at 5 mm"] == ["0.61"]
    assert "radius: 0.02" in text  # the settings


def test_best_median_and_worst_pose_are_shown(finished):
    page = report(finished)
    found = re.findall(r"Pose (\d+), the (\w+) of 5: ([\d.]+) dB", plain(page))
    assert [(int(n), name) for n, name, _ in found] == [(41, "best"), (44, "median"), (42, "worst")]
    # 20 log10 of the factor, for all is far above the reference.
    expected = [0.0, 20 * np.log10(1.2), 20 * np.log10(3.0)]
    np.testing.assert_allclose([float(db) for *_, db in found], expected, atol=0.03)
    shown = {caption[:8]: picture for caption, picture in pictures_of(page).items()}
    assert shown["Pose 42,"] == b"pose 42"


def test_the_page_holds_all_that_it_shows(finished, tmp_path):
    page = report(finished, output=tmp_path / "elsewhere" / "page.html")
    assert [p.name for p in page.parent.iterdir()] == ["page.html"]
    assert pictures_of(page)["Reflectivity, the largest along y."] == b"mip_y"
    # Nothing is asked for: neither sources nor links lead out of the page.
    outside = re.findall(r"""(?:src|href)=["'](?!data:)[^"']*""", page.read_text())
    assert not outside


def test_the_mesh_stands_beside_the_truth_and_can_be_turned(finished):
    text = report(finished).read_text()
    assert re.findall(r'<option value="([^"]*)"', text) == [
        "reconstruction, coloured by its distance from the truth",
        "reconstruction, coloured by how many poses heard it",
        "truth",
    ]
    shapes = json.loads(re.search(r"shapes = (\{.*?\});", text).group(1))
    for data in shapes.values():
        assert base64.b64decode(data).startswith(b"glTF")
    assert text.count("<iframe") == text.count("$SHAPE") - 1 == 1  # one viewer for all shapes
    sides = pictures_of(finished / "report.html")["Four sides; colours are explained at the left."]
    assert sides.startswith(b"\x89PNG")


def test_colours_tell_outside_from_inside(finished):
    """A mesh moved along x is red where it sticks out of the truth and blue at the other end."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    truth = mesh.copy()
    mesh.apply_translation([0.002, 0.0, 0.0])
    shown = SurfaceViews(mesh, None, None, truth, limit=0.002).meshes()
    coloured = shown["reconstruction, coloured by its distance from the truth"]
    red, _, blue, _ = coloured.visual.vertex_colors.T.astype(int)
    out = coloured.vertices[:, 0] - 0.002
    assert (red > blue + 50)[out > 0.015].all()
    assert (blue > red + 50)[out < -0.015].all()


@pytest.mark.parametrize("kind", ["svg", pytest.param("pdf", marks=pytest.mark.slow)])
def test_figures_for_a_paper_are_vectors(finished, kind):
    (finished / "epochs" / "0001").mkdir(parents=True)
    told = {"epoch": 1, "step": 10, "val/mae_db": 1.5}
    (finished / "epochs" / "0001" / "metrics.json").write_text(json.dumps(told))
    report(finished, figures=kind)
    files = {file.name: file.read_bytes() for file in (finished / "figures").iterdir()}
    assert files.keys() == {f"{name}.{kind}" for name in ("curves", *POSES)}
    assert all(data.startswith((b"<?xml", b"%PDF")) for data in files.values())


def test_the_figures_of_the_paper_are_named_by_their_numbers(finished):
    text = report(finished, paper=True).read_text(encoding="utf-8")
    assert "Iso-surface of the summed reflectivity (figures 4 to 6)" in text
    assert "Not compared with another run yet" in text


def test_an_interrupted_fit_has_a_page_of_what_it_has(run):
    (run / "model.json").unlink()
    (run / "metrics.json").write_text(json.dumps({"schema": 1, "cost": {"simulate_s": 3.0}}))
    for epoch in (1, 2):
        (run / "epochs" / f"{epoch:04d}").mkdir(parents=True)
        told = {"epoch": epoch, "step": 10 * epoch, "val/mae_db": 1.0 / epoch}
        (run / "epochs" / f"{epoch:04d}" / "metrics.json").write_text(json.dumps(told))
    page = report(run)
    assert "The fit has not come to its end; sononerf fit" in plain(page)
    assert list(pictures_of(page)) == ["The field alone on validation poses."]


def test_a_table_has_a_column_per_run_and_a_line_of_csv(finished, tmp_path):
    other = shutil.copytree(finished, tmp_path / "other")
    (other / "metrics.json").write_text(json.dumps({"schema": 1}))
    lines = table([finished, other], csv=tmp_path / "t.csv")
    assert lines[0].split() == ["leaf-7", "other"]
    (chamfer,) = (line for line in lines if line.startswith("Chamfer"))
    assert chamfer.split()[-2:] == ["3.14", "-"]
    first, *rest = (tmp_path / "t.csv").read_text().splitlines()
    values = dict(zip(first.split(","), rest[0].split(","), strict=True))
    assert (values["run"], values["geometry.chamfer_m"]) == ("leaf-7", "0.00314")
    assert rest[1].startswith("other,,")
    (other / "metrics.json").write_text(json.dumps({"prediction": {"mae_db": "much"}}))
    with pytest.raises(InputError, match=r"metrics\.json: damaged"):
        table([finished, other])


@pytest.mark.slow  # a browser
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.parametrize("width", [1400, 400])
def test_the_page_opens_offline_and_its_mesh_turns(finished, tmp_path, width):
    page_file = report(finished)
    with browser(tmp_path / "profile") as page:
        page.size(width, 900)
        page.call("Network.emulateNetworkConditions", offline=True, latency=0,
                  downloadThroughput=0, uploadThroughput=0)  # fmt: skip
        page.open(page_file.as_uri())
        page.until("document.querySelector('#view') !== null")
        assert page.value("document.documentElement.scrollWidth") <= width
        page.value("document.querySelector('#view').scrollIntoView()")
        box = page.value(
            "(r => [r.x, r.y, r.width, r.height])"
            "(document.querySelector('#view').getBoundingClientRect())"
        )
        middle = box[0] + box[2] / 2, box[1] + box[3] / 2

        def pixels():
            x, y, width, height = box
            with Image.open(io.BytesIO(page.picture())) as picture:
                part = picture.convert("RGB").crop((x + 2, y + 2, x + width - 2, y + height - 2))
            return np.asarray(part).astype(int)

        def coloured():
            """The fraction of the view that is neither white nor grey."""
            return np.mean(np.ptp(pixels(), axis=2) > 8)

        end = time.monotonic() + 30
        while coloured() < 0.02:
            assert time.monotonic() < end
            time.sleep(0.2)
        before = pixels()
        assert coloured() < 0.9
        page.drag(middle, (middle[0] + 80, middle[1] + 40))
        time.sleep(1)
        assert np.mean(np.abs(pixels() - before).max(axis=2) > 8) > 0.01
        page.value("document.querySelector('#shape').value = 'truth'")
        page.value("document.querySelector('#shape').dispatchEvent(new Event('change'))")
        time.sleep(3)
        assert np.mean(np.abs(pixels() - before).max(axis=2) > 8) > 0.01
        assert not page.faults
        assert not page.outside()


def test_what_is_not_there_yet_is_named_with_its_command(run):
    text = plain(report(run))
    for command in ("predict", "evaluate", "reconstruct"):
        assert f"sononerf {command} {run}" in text
    assert not pictures_of(run / "report.html")


def test_without_held_out_poses_nothing_is_asked_for(run):
    description = json.loads((run / "model.json").read_text())
    description["settings"]["poses"]["heldout"] = 0
    (run / "model.json").write_text(json.dumps(description))
    text = plain(report(run))
    assert "No pose was held out" in text
    assert "sononerf predict" not in text


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


def test_commands_can_be_copied_whatever_the_run_is_called(run):
    odd = run.rename(run.with_name("my leaf"))
    assert f"sononerf predict '{odd}'" in plain(report(odd))


def test_a_page_needs_the_name_of_a_page(finished):
    with pytest.raises(InputError, match=r"expected a file whose name ends in \.html"):
        report(finished, output=finished)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="no run"):
        report(tmp_path)
