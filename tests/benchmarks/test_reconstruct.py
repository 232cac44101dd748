# SPDX-License-Identifier: MIT
"""The clock around a read-out that does nothing."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sononerf.settings.loading import validate_settings
from tools.benchmarks import reconstruct as module

pytestmark = pytest.mark.thorough


@pytest.fixture
def asked(monkeypatch):
    """What was read out, each taking longer than the one before: 1, 2, 3, ... s."""
    given, clock = [], [0.0]

    def read_field(field, hull, **options):
        given.append({"hull": hull, **options})
        clock[0] += len(given)
        return SimpleNamespace(volume=SimpleNamespace(values=np.zeros((10, 20, 6))))

    settings = validate_settings({"scene": {"name": "ua"}}, "test")
    field = SimpleNamespace(resolution=0.004)
    fitted = SimpleNamespace(
        settings=settings,
        hull="the hull",
        head=SimpleNamespace(resolution=0.005),
        model=SimpleNamespace(field=field),
    )
    monkeypatch.setattr(module, "read_field", read_field)
    monkeypatch.setattr(module, "start_surfaces", lambda reading, methods: [])
    monkeypatch.setattr(module, "Run", lambda run: fitted)
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    return given


def go(output, **other):
    chosen = {"runs": [Path("runs/a")], "spacings": None, "output": output, "compare": None}
    text = module.reconstruct(Namespace(**{**chosen, **other}))
    (file,) = output.glob("reconstruct-*-cpu.json")
    return text, json.loads(file.read_text())


def test_the_median_of_five(asked, tmp_path):
    text, found = go(tmp_path)
    assert len(asked) == 5
    assert all(options["spacing"] == 0.002 for options in asked)
    assert all(options["hull"] == "the hull" for options in asked)
    (row,) = found["rows"]
    # Of 1, 2, 3, 4 and 5 s; 1,200 voxels.
    assert (row["reconstruct_s"], row["voxels"], row["voxels_per_s"]) == (3.0, 1200, 400.0)
    assert (row["name"], row["method"]) == ("a, 2 mm", "filled")
    assert text.splitlines()[1].split() == ["a,", "2", "mm", "filled", "1,200", "3.00", "400"]


def test_a_run_with_a_voxel_size_of_its_own_is_read_by_that(asked, tmp_path, monkeypatch):
    given = {"scene": {"name": "ua"}, "reconstruction": {"spacing": 0.005}}
    monkeypatch.setattr(module.Run("any"), "settings", validate_settings(given, "test"))
    _, found = go(tmp_path)
    assert [row["name"] for row in found["rows"]] == ["a, 5 mm"]
    assert all(options["spacing"] == 0.005 for options in asked)


def test_each_run_at_each_voxel_size(asked, tmp_path):
    runs = [Path("runs/a"), Path("runs/b")]
    _, found = go(tmp_path, runs=runs, spacings=[0.004, 0.001])
    names = ["a, 4 mm", "a, 1 mm", "b, 4 mm", "b, 1 mm"]
    assert [row["name"] for row in found["rows"]] == names
    assert [options["spacing"] for options in asked[::5]] == [0.004, 0.001, 0.004, 0.001]


def test_what_is_no_run_is_one_line(tmp_path):
    with pytest.raises(SystemExit, match="no fitted run"):
        go(tmp_path, runs=[tmp_path / "nothing"])
