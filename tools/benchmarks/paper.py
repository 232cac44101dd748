# SPDX-License-Identifier: MIT
"""How much sooner the default gets to where the paper's own method gets in an hour.

Every figure is that of a whole ``sononerf fit``: the held-out error of its ``metrics.json``, and
``fit_s``, the seconds of fitting alone.

**The paper's run** has a number of steps, found by timing the first steps of a fit that is made
for this alone (or given). The other way is to stop a fit by a signal once its time is up. That
hits the minutes however busy the machine is, but a fit stopped by a signal has no held-out error:
its checkpoint would have to be passed off as the end of another run. A number of steps is a setting
that anybody can repeat, and costs no honesty: the ratio takes the seconds that the run took, not
those it was meant to take, and the paper's learning rate looks at the epochs alone, so that a fit
of N steps is the first N of all hundred epochs. Where its hundred epochs do not fill the minutes
it goes on as it would with more of them.

**The default's runs** are of 1, 2, 3, 5, ... epochs, each a fit of its own that cools down within
its epochs: the beginning of a longer one would be another fit.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sononerf import storage
from tools.benchmarks.experiment import CONFIG, Row, aligned, ending, origin, run_experiment

PAPER = CONFIG.parent / "paper" / "three_spheres.yaml"
PILOT_STEPS = 25
"""Timed from the fifth on, as TensorBoard has them: neither setting up nor validation counts."""
EPOCHS = (1, 2, 3, 5, 10, 20)
ERRORS = {"mae_db": "all cells", "mae_db_active": "active cells"}
CLAIM = 100.0
"""So many times sooner, in both errors."""


def paper(arguments: argparse.Namespace) -> str:
    """Time how soon the default is as good as the paper's method after an hour; table and ratio."""
    output = arguments.output or Path("runs") / f"paper-{arguments.scene}"
    data = arguments.data or output / "data"
    table = output / "paper.json"
    minutes = arguments.minutes if arguments.steps is None else None

    def run(name: str, config: Path, *own: str) -> Row:
        settings = [f"scene.name={arguments.scene}", *arguments.set, *own]
        metrics = run_experiment(output / name, data, settings, config=config, enough="prediction")
        print(f"{output / name}: done", file=sys.stderr, flush=True)
        return {**_row(metrics), "settings": settings}

    def keep(reference: Row, rows: Sequence[Row]) -> dict[str, Any]:
        found = sooner(reference, rows)
        head = {**origin(), "scene": arguments.scene, "minutes": minutes}
        storage.commit_json(table, {**head, **found, "paper": reference, "default": rows})
        return found

    with ending(output):
        steps = arguments.steps
        if minutes is not None:
            run("pilot", PAPER, f"fit.max_steps={PILOT_STEPS}")
            steps = max(1, int(60.0 * minutes / seconds_per_step(output / "pilot")))
        # An epoch has a step at least, so that the steps alone end the fit.
        own = (f"fit.max_steps={steps}", f"fit.epochs={steps}")
        reference = run(f"paper-{steps}", PAPER, *own)
        rows: list[Row] = []
        found = keep(reference, rows)
        for epochs in EPOCHS:
            try:
                row = run(f"default-{epochs}", CONFIG, f"fit.epochs={epochs}")
            except RuntimeError as error:
                row = {"failed": str(error)}
            rows.append({"epochs": epochs, **row})
            found = keep(reference, rows)
            if found["ratio"] is not None:
                break
    return f"{_text(reference, rows, found)}\nwrote {table}"


def seconds_per_step(run: Path) -> float:
    """Return what one step of a fit took: the median over its logged steps, in seconds.

    Parameters
    ----------
    run : Path
        Its folder.

    Returns
    -------
    seconds : float, s
        A fit that was interrupted counts like one that was not.

    Raises
    ------
    RuntimeError
        If fewer than two steps were logged.
    """
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    logged = events.Scalars("train/loss") if "train/loss" in events.Tags()["scalars"] else []
    if len(logged) < 2:
        raise RuntimeError(f"{run}: no step was timed; remove the folder, or give --steps")
    seconds: float = statistics.median(
        (after.wall_time - before.wall_time) / (after.step - before.step)
        for before, after in pairwise(logged)
    )
    return seconds


def sooner(reference: Row, rows: Sequence[Row]) -> dict[str, Any]:
    """Find the first runs that are at least as good as another one, and how much sooner.

    Parameters
    ----------
    reference : dict
        ``fit_s`` in seconds, and the held-out errors ``mae_db`` and ``mae_db_active`` in dB.
    rows : sequence of dict
        The same of each run in turn, with ``epochs``; runs that failed have none of them.

    Returns
    -------
    found : dict
        ``sooner``: for either error epochs, ``fit_s`` and ratio of the first run that has it or
        less, None where no run has; ``ratio``: the smaller of both ratios, None unless both exist;
        ``claim`` and whether it ``holds``.
    """
    found: dict[str, Row | None] = {}
    for key in ERRORS:
        first = next((row for row in rows if _reaches(row, reference, key)), None)
        found[key] = first and {
            "epochs": first["epochs"],
            "fit_s": first["fit_s"],
            "ratio": reference["fit_s"] / first["fit_s"],
        }
    ratios = [one["ratio"] for one in found.values() if one is not None]
    ratio = min(ratios) if len(ratios) == len(ERRORS) else None
    holds = ratio is not None and ratio >= CLAIM
    return {"sooner": found, "ratio": ratio, "claim": CLAIM, "holds": holds}


def _reaches(row: Row, reference: Row, key: str) -> bool:
    there, wanted = row.get(key), reference[key]
    return there is not None and wanted is not None and there <= wanted


def _row(metrics: dict[str, Any]) -> Row:
    cost, prediction = (metrics.get(name) or {} for name in ("cost", "prediction"))
    if "mae_db" not in prediction:
        raise RuntimeError("a run without a held-out error; poses.heldout must be above 0")
    return {
        "steps": cost["steps"],
        "fit_s": cost["fit_s"],
        **{key: prediction[key] for key in ERRORS},
    }


def _text(reference: Row, rows: Sequence[Row], found: dict[str, Any]) -> str:
    lines = [["", "epochs", "steps", "fit/s", *(f"{title}/dB" for title in ERRORS.values())]]
    for name, row in [("paper", reference), *(("default", row) for row in rows)]:
        values = [row.get(key) for key in ("fit_s", *ERRORS)]
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        lines.append([name, *(str(row.get(key, "-")) for key in ("epochs", "steps")), *shown])
    text = aligned(lines)
    for number, row in enumerate(rows, start=2):
        text[number] += f"  failed: {row['failed']}" if "failed" in row else ""
    for key, title in ERRORS.items():
        one = found["sooner"][key]
        text.append(
            f"{title}: not reached"
            if one is None
            else f"{title}: reached in {one['fit_s']:.1f} s, {one['ratio']:.0f} times sooner"
        )
    ratio = "none" if found["ratio"] is None else f"{found['ratio']:.1f}"
    text.append(f"ratio: {ratio}, {'at least' if found['holds'] else 'not'} {CLAIM:.0f}")
    return "\n".join(text)
