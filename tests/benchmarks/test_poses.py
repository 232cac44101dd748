# SPDX-License-Identifier: MIT
from __future__ import annotations

import io
from argparse import Namespace
from pathlib import Path

import numpy as np
from PIL import Image

from tools.benchmarks import poses as module
from tools.benchmarks.poses import curve_png


def row(calls, scores=None):
    if scores is None:
        return {"calls": calls, "failed": "no echo", "over": False}
    return {
        "calls": calls,
        **dict(zip(("fscore_1mm", "fscore_2mm", "fscore_5mm"), scores, strict=True)),
    }


def pixels(rows):
    with Image.open(io.BytesIO(curve_png(rows, "ua"))) as image:
        return np.array(image.convert("RGB")).astype(int)


def height_of(rows, colour):
    """Mean height above the bottom of what has a colour, left of the legend."""
    picture = pixels(rows)
    found = np.abs(picture - colour).max(axis=-1) < 30
    found[:, int(0.8 * found.shape[1]) :] = False
    return picture.shape[0] - np.nonzero(found)[0].mean()


def test_the_curve_is_drawn_from_the_scores():
    dark_blue = (0, 63, 92)
    good = [row(12, (0.1, 0.2, 0.9)), row(400, (0.1, 0.2, 0.9)), row(50)]
    bad = [row(12, (0.1, 0.2, 0.4)), row(400, (0.1, 0.2, 0.4)), row(50)]
    assert height_of(good, dark_blue) > height_of(bad, dark_blue) + 100


def test_a_curve_of_failed_runs_is_empty_but_drawn():
    assert min(pixels([row(12)]).shape[:2]) > 100


def test_each_number_of_calls_is_one_experiment(monkeypatch, tmp_path):
    given = {}

    def keep(output, file, experiments, after, **named):
        given.update(output=output, file=file, experiments=list(experiments), **named)
        after([row(12, (0.1, 0.2, 0.3))])
        return "text"

    monkeypatch.setattr(module, "run_series", keep)
    monkeypatch.chdir(tmp_path)
    chosen = {"counts": [12, 25], "scene": "ua", "set": ["fit.epochs=1"], "output": None}
    text = module.poses(Namespace(**chosen, data=Path("d"), seconds=60.0))
    assert text == "text\nwrote runs/poses-ua/poses.png"
    assert (tmp_path / "runs" / "poses-ua" / "poses.png").is_file()
    assert (given["file"], given["data"]) == ("poses.json", Path("d"))
    assert given["experiments"][1] == (
        "25",
        {"calls": 25},
        ["scene.name=ua", "poses.count=25", "fit.epochs=1"],
    )
