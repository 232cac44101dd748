# SPDX-License-Identifier: MIT
"""Commands that are killed at random moments: the same command ends as if nothing had been."""

from __future__ import annotations

import random
import subprocess
import sys
import time

import pytest

TINY = (
    *("scene.name=sphere", "scene.options.radius=0.02"),
    *("poses.count=8", "poses.validation=2", "poses.heldout=2"),
    *("simulation.rays=500", "simulation.sources=60", "simulation.noise_floor_poses=1"),
    *("spectrogram.range_min=0.34", "spectrogram.range_max=0.45"),
    *("field.options.finest=0.01", "field.options.levels=2", "renderer.options.points=30"),
    *("fit.epochs=3", "fit.steps_per_epoch=4", "fit.batch_poses=2", "fit.batch_frequencies=2"),
    *("fit.checkpoint_seconds=0.05", "preview.voxels=8", "reconstruction.refine=false"),
    "prediction.traced=off",
)
"""An experiment that goes through everything in some seconds: a sphere heard from eight poses."""
SIMULATE = ("simulate", *TINY, "--output", "made", "--workers", "1")
FIT = ("fit", *TINY, "data.store=../store", "--output", "made", "--accelerator", "cpu")
TIMES = ("tensorboard", "report.html", "checkpoints", "provenance.json", ".lock", "metrics.json")
"""Parts of a run that depend on its time, or on the number of its parts."""


def give(words, folder, *, after=None):
    """Give a command; kill it after some seconds. Return its exit code and its duration."""
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "sononerf.cli", *words]
    began = time.monotonic()
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE) as process:
        try:
            _, said = process.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            process.kill()
            return -9, time.monotonic() - began
    assert process.returncode == 0, said.decode()
    return 0, time.monotonic() - began


def contents(folder):
    files = sorted(path for path in (folder / "made").rglob("*") if path.is_file())
    names = {str(path.relative_to(folder / "made")): path for path in files}
    assert not [name for name in names if name.endswith(".tmp")]
    return {n: path.read_bytes() for n, path in names.items() if not n.startswith(TIMES)}


@pytest.mark.slow
@pytest.mark.parametrize("words", [SIMULATE, FIT], ids=["simulate", "fit"])
def test_a_command_that_is_killed_ends_as_if_nothing_had_been(tmp_path, words):
    if words is FIT:
        give((*SIMULATE[:-4], "--output", "../store"), tmp_path / "simulated")
    _, whole = give(words, tmp_path / "once")
    rng = random.Random(0)
    kills = 0
    for trial in range(4):
        place = tmp_path / f"{trial}"
        while give(words, place, after=rng.uniform(0.4, 1.1) * whole)[0]:
            kills += 1
            assert kills < 40
        assert contents(place) == contents(tmp_path / "once")
    assert kills
