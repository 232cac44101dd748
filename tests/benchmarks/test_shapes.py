# SPDX-License-Identifier: MIT
from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest

from sononerf.scene.scene import load_scene
from tools.benchmarks import shapes as module


def test_each_seed_is_one_experiment(monkeypatch):
    given = {}

    def keep(output, file, experiments, **named):
        given.update(output=output, file=file, experiments=list(experiments), **named)
        return "text"

    monkeypatch.setattr(module, "run_series", keep)
    chosen = {"first": 3, "count": 2, "set": ["fit.epochs=1"], "output": None, "data": None}
    assert module.shapes(Namespace(**chosen, seconds=60.0)) == "text"
    assert (given["output"], given["file"]) == (Path("runs/shapes"), "shapes.json")
    (name, head, settings), (_, other, _) = given["experiments"]
    assert (name, head["seed"], head["kind"], other["kind"]) == ("3", 3, "capsules", "letters")
    mesh = load_scene("procedural", {"seed": 3}).mesh
    assert head["extent_m"] == pytest.approx(mesh.extents.max())
    assert settings == ["scene.name=procedural", "scene.options.seed=3", "fit.epochs=1"]
