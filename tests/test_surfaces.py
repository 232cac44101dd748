# SPDX-License-Identifier: MIT
"""Surfaces that whole runs must give: minutes each, run by hand."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sononerf.scene.scene import load_scene

ROOT = Path(__file__).resolve().parent.parent


def fitted(folder, *arguments):
    """Run ``sononerf fit`` and return its geometry and its mesh."""
    command = [sys.executable, "-m", "sononerf.cli", "fit", *map(str, arguments)]
    done = subprocess.run(
        [*command, "--output", "run"], cwd=folder, capture_output=True, text=True, timeout=3000
    )
    assert done.returncode == 0, done.stderr[-2000:]
    numbers = json.loads((folder / "run" / "metrics.json").read_text())
    mesh = trimesh.load_mesh(folder / "run" / "reconstruction" / "mesh.ply")
    return numbers["geometry"], mesh


@pytest.mark.slow  # five minutes
def test_the_control_is_a_rabbit_with_two_ears(tmp_path):
    geometry, mesh = fitted(tmp_path, ROOT / "configs" / "rabbit.yaml")
    assert geometry["fscore"]["0.005"] > 0.70
    points, _ = trimesh.sample.sample_surface(load_scene("rabbit").mesh, 20_000, seed=0)
    near = cKDTree(trimesh.sample.sample_surface(mesh, 100_000, seed=0)[0]).query(points)[0] < 5e-3
    high = points[:, 2] > 0.02  # the ears, above the head
    for side in (1.0, -1.0):
        ear = high & (side * points[:, 1] > 0)
        assert np.mean(near[ear]) > 0.5


@pytest.mark.slow  # six minutes
def test_a_sphere_on_a_table_comes_out_as_well_as_without(tmp_path):
    found = {}
    for name, support in (("free", ()), ("table", ("support.point=[0,0,-0.015]",))):
        (tmp_path / name).mkdir()
        above = "poses.arrangement=cap", "poses.axis=[0,0,1]", "poses.half_angle_deg=70"
        common = "scene.name=sphere", *above, "poses.count=200", "simulation.accuracy_db=0.4"
        found[name], _ = fitted(tmp_path / name, *common, *support)
    assert found["table"]["fscore"]["0.002"] > found["free"]["fscore"]["0.002"] - 0.05
