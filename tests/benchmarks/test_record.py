# SPDX-License-Identifier: MIT
from __future__ import annotations

import json

import pytest

from sononerf import __version__
from tools.benchmarks.experiment import keep, ratios

pytestmark = pytest.mark.thorough

FOUND = {"copy": 2.0, "rows": [{"name": "a", "step_s": 0.5}, {"name": "b", "step_s": 3.0}]}


def test_a_file_is_named_by_version_and_device_and_says_them(tmp_path):
    path = keep(tmp_path, "step", "cpu", FOUND)
    assert path.name.startswith(f"step-{__version__}-")
    assert path.name.endswith("-cpu.json")
    data = json.loads(path.read_text())
    assert (data["device"], data["sononerf"], data["rows"]) == ("cpu", __version__, FOUND["rows"])


def test_figures_are_put_beside_those_of_the_same_name(tmp_path):
    path = keep(tmp_path, "step", "cpu", FOUND)
    now = {"copy": 3.0, "rows": [{"name": "b", "step_s": 1.5}, {"name": "new", "step_s": 1.0}]}
    lines = [line.split() for line in ratios(path, now).splitlines()]
    assert lines[1:] == [["copy", "2", "3", "1.50"], ["rows.b.step_s", "3", "1.5", "0.50"]]
