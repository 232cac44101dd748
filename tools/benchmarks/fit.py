# SPDX-License-Identifier: MIT
"""How long the default takes to a given held-out error.

Every figure is that of a whole ``sononerf fit``: ``fit_s`` and the held-out error of its
``metrics.json``. Fits of 1, 2, 3, 5, ... epochs, each cooling down within its own, are made until
one has the error or less; that one is made again with other seeds, and the median is reported.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path
from typing import Any

from sononerf import storage
from tools.benchmarks.experiment import (
    Row,
    aligned,
    device_name,
    ending,
    keep,
    ratios,
    run_experiment,
)

REPEATS = 5
EPOCHS = (1, 2, 3, 5, 10, 20)
"""Numbers of epochs that are tried in turn until a fit reaches the error."""


def fit(arguments: argparse.Namespace) -> str:
    """Time the default to a held-out error (all cells, dB); table and median of five fits."""
    output = arguments.output or Path("runs") / f"fit-{arguments.scene}"
    data = arguments.data or output / "data"

    def run(epochs: int, seed: int) -> Row:
        own = [f"scene.name={arguments.scene}", f"fit.epochs={epochs}", f"fit.seed={seed}"]
        name = f"{epochs}-epochs-seed-{seed}"
        metrics = run_experiment(output / name, data, [*own, *arguments.set], enough="prediction")
        cost, prediction = (metrics.get(part) or {} for part in ("cost", "prediction"))
        if "mae_db" not in prediction:
            raise RuntimeError("a run without a held-out error; poses.heldout must be above 0")
        row = {"name": name, "epochs": epochs, "steps": cost["steps"], "fit_s": cost["fit_s"]}
        print(f"{output / name}: {prediction['mae_db']:.2f} dB", file=sys.stderr, flush=True)
        return {**row, "mae_db": prediction["mae_db"], "device": cost.get("device")}

    with ending(output):
        if arguments.compare is not None:
            storage.read_json(arguments.compare)
        rows: list[Row] = []
        for epochs in EPOCHS:
            rows.append(run(epochs, 0))
            if rows[-1]["mae_db"] <= arguments.error:
                rows += [run(epochs, seed) for seed in range(1, REPEATS)]
                break
        found = {"scene": arguments.scene, **reached(rows, arguments.error), "rows": rows}
        path = keep(output, "fit", device_name("auto"), found)
        text = f"{table(rows)}\n{sentence(found)}\nwrote {path}"
        return text if arguments.compare is None else f"{text}\n{ratios(arguments.compare, found)}"


def reached(rows: list[Row], error: float) -> dict[str, Any]:
    """Return the medians of the repeated fits; None where the error was not reached."""
    last = [row for row in rows if row["epochs"] == rows[-1]["epochs"]]
    there = last[0]["mae_db"] <= error
    return {
        "error_db": error,
        "epochs": last[0]["epochs"] if there else None,
        "fit_s": statistics.median(row["fit_s"] for row in last) if there else None,
        "mae_db": statistics.median(row["mae_db"] for row in last) if there else None,
    }


def table(rows: list[Row]) -> str:
    """Return one line for each fit."""
    lines = [["run", "steps", "fit/s", "held-out/dB"]]
    for row in rows:
        shown = (f"{row['fit_s']:.1f}", f"{row['mae_db']:.2f}")
        lines.append([row["name"], str(row["steps"]), *shown])
    return "\n".join(aligned(lines))


def sentence(found: dict[str, Any]) -> str:
    """Return what the table comes to."""
    if found["fit_s"] is None:
        return f"{found['error_db']:g} dB: not reached"
    return (
        f"{found['error_db']:g} dB: {found['fit_s']:.1f} s, {found['epochs']} epochs, "
        f"{found['mae_db']:.2f} dB (medians of {REPEATS} seeds)"
    )
