# SPDX-License-Identifier: MIT
"""The default experiment over shapes that nobody chose."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from sononerf_scenes.procedural import KINDS

from sononerf.scene.scene import load_scene
from tools.benchmarks.experiment import Row, run_series


def shapes(arguments: argparse.Namespace) -> str:
    """Fit procedural shapes, one per seed; table, medians and worst."""
    seeds = range(arguments.first, arguments.first + arguments.count)
    return run_series(
        arguments.output or Path("runs") / "shapes",
        "shapes.json",
        _experiments(seeds, arguments.set),
        data=arguments.data,
        seconds=arguments.seconds,
    )


def _experiments(
    seeds: Sequence[int], settings: Sequence[str]
) -> Iterator[tuple[str, Row, list[str]]]:
    for seed in seeds:
        extent = float(load_scene("procedural", {"seed": seed}).mesh.extents.max())
        head = {"seed": seed, "kind": KINDS[seed % len(KINDS)], "extent_m": extent}
        chosen = ["scene.name=procedural", f"scene.options.seed={seed}", *settings]
        yield str(seed), head, chosen
