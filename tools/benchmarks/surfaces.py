# SPDX-License-Identifier: MIT
"""How good the surfaces are: the scenes, changed conditions and seeds of the table of results."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sononerf import storage
from tools.benchmarks.experiment import (
    CONFIG,
    Column,
    Row,
    aligned,
    append_line,
    ending,
    origin,
    rows_of,
    run_experiment,
    shown,
)
from tools.benchmarks.foreign import foreign
from tools.benchmarks.results_page import write_page

SPHERES = "scene.name=three_spheres"
PROCEDURAL = range(100, 120)
"""Seeds of shapes on which nothing was settled."""
NEW = ("beaker", "cone", "rings", "tower", "blob", "stool", "helix", "box", "star")

ABOVE = ("poses.arrangement=cap", "poses.axis=[0,0,1]", "poses.half_angle_deg=70")
"""Poses as a hand or a robot reaches above a table."""
STANDING = {"sphere": -0.015, "cone": -0.045, "rabbit": -0.0603}
"""Scenes that are heard on a table and without it, and the height of their lowest point, m."""


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Attributes:
        name: Name of the row, and of its folder up to the seed.
        settings: ``KEY=VALUE``, laid over the defaults.
        repeated: Whether it is fitted with every seed, and not with the first alone.
        config: File of ``configs/`` that the settings are laid over.
    """

    name: str
    settings: tuple[str, ...]
    repeated: bool = False
    config: str = "three_spheres"


CASES = (
    *(
        Case(name, (f"scene.name={name}",), repeated=True)
        for name in ("three_spheres", "ua", "leaf")
    ),
    *(
        Case(f"procedural-{n}", ("scene.name=procedural", f"scene.options.seed={n}"))
        for n in PROCEDURAL
    ),
    Case("25-calls", (SPHERES, "poses.count=25")),
    Case("three-times-as-large", (SPHERES, "scene.options.radius=0.045")),
    Case("noisy-rays", (SPHERES, "simulation.engine=rays", "noise.snr_db=20")),
    Case("exact", (SPHERES, "poses.count=100", "spectrogram.frequency_max=80e3")),
    *(Case(name, (f"scene.name={name}",)) for name in NEW),
    Case("control", (), config="rabbit"),
    *(
        Case(f"{name}-{where}", (f"scene.name={name}", *ABOVE, *support))
        for name, lowest in STANDING.items()
        for where, support in (("free", ()), ("on-table", (f"support.point=[0,0,{lowest}]",)))
    ),
)


def surfaces(arguments: argparse.Namespace) -> str:
    """Fit scenes, changed conditions and seeds; one line of JSON for each."""
    output = arguments.output or Path("runs") / "surfaces"
    if arguments.page:
        return write_page(output)
    if arguments.foreign is not None:
        return foreign(arguments, output)
    file = output / "surfaces.jsonl"
    for case, seed in chosen_cases(arguments.only, arguments.seeds, arguments.exact is not None):
        experiment = _Experiment(case, seed, output, arguments)
        if any(
            "failed" not in row and experiment.head.items() <= row.items() for row in rows_of(file)
        ):
            continue
        with ending(output):
            line = storage.to_json(experiment.row())
            storage.make_folder(output)
            append_line(file, line)
            print(line, file=sys.stderr, flush=True)
    return f"{table(rows_of(file))}\nwrote {file}"


def chosen_cases(
    only: Sequence[str] | None, seeds: Sequence[int], exact: bool
) -> Iterator[tuple[Case, int]]:
    """Yield cases and the seeds of their fits; the exact echoes only where they are given."""
    for case in CASES:
        if case.name in only if only else exact or case.name != "exact":
            if case.name == "exact" and not exact:
                raise SystemExit("error: exact: give the ensemble with --exact STORE")
            for seed in seeds if case.repeated else seeds[:1]:
                yield case, seed


class _Experiment:
    """One case with one seed."""

    def __init__(self, case: Case, seed: int, output: Path, arguments: argparse.Namespace) -> None:
        self.case = case
        self.store = Path(arguments.exact) if case.name == "exact" else None
        self.data = arguments.data or output / "data"
        self.folder = output / f"{case.name}-{seed}"
        self.settings = [*case.settings, *arguments.set, f"fit.seed={seed}"]
        self.head: Row = {"name": case.name, "seed": seed, "settings": self.settings}

    def row(self) -> Row:
        """Run it, unless it has been run, and return its line."""
        try:
            metrics = run_experiment(
                self.folder,
                self.data,
                self.settings,
                config=CONFIG.with_name(f"{self.case.config}.yaml"),
                enough="prediction",
                store=self.store,
            )
        except RuntimeError as error:
            return {**self.head, **origin(), "failed": str(error)}
        row = {**self.head, **origin(), **measured(metrics)}
        return row if metrics.get("geometry") else {**row, "failed": "no surface"}


def measured(metrics: Mapping[str, Any]) -> Row:
    """Return what a line tells of one run; None for what it does not have.

    ``seconds`` are those of all but the simulation, ``rendered_mae_db_active`` is the error of the
    field's own rendering on active cells, ``heldout_mae_db_active`` that of all that predicts.
    """
    cost, prediction, geometry = (
        metrics.get(name) or {} for name in ("cost", "prediction", "geometry")
    )
    scores = geometry.get("fscore", {})
    spent = [
        value
        for key, value in cost.items()
        if key.endswith("_s") and key != "simulate_s" and value is not None
    ]
    return {
        **{key: geometry.get(key) for key in ("chamfer_m", "thickness_bias_m")},
        **{f"fscore_{mm}mm": scores.get(f"0.00{mm}") for mm in (1, 2, 5)},
        "parts": geometry.get("components"),
        "parts_true": geometry.get("components_true"),
        "heldout_mae_db_active": prediction.get("mae_db_active"),
        "heldout_mae_db": prediction.get("mae_db"),
        "rendered_mae_db_active": prediction.get("rendered_mae_db_active"),
        "seconds": sum(spent) if spent else None,
        "simulate_s": cost.get("simulate_s"),
    }


def _low(value: float) -> float:
    return -value


COLUMNS = (
    Column("name", "name"),
    Column("seed", "seed"),
    Column("chamfer_m", "Chamfer/mm", ".3f", 1e3, badness=float),
    *(Column(f"fscore_{mm}mm", f"F {mm}mm", ".2f", badness=_low) for mm in (1, 2, 5)),
    Column("parts", "parts"),
    Column("parts_true", "true"),
    Column("rendered_mae_db_active", "rendered/dB", ".2f", badness=float),
    Column("heldout_mae_db_active", "all/dB", ".2f", badness=float),
    Column("seconds", "seconds", ".0f", badness=float),
)
GROUPS = {"procedural": [f"procedural-{seed}" for seed in PROCEDURAL], "new scenes": list(NEW)}


def table(rows: Sequence[Row]) -> str:
    """Return rows as lines of text, and medians and worst values of those that belong together.

    Args:
        rows: As :func:`surfaces` writes them.

    Returns:
        text: A worst value of one column may be of another run than that of the next.
    """
    order = {case.name: number for number, case in enumerate(CASES)}
    listed = sorted(rows, key=lambda row: (order.get(row["name"], len(order)), row["seed"]))
    lines = [[column.title for column in COLUMNS]]
    lines += [[shown(column, row) for column in COLUMNS] for row in listed]
    for title, names in GROUPS.items():
        group = [row for row in listed if row["name"] in names]
        median: Row = {"name": f"{title}, median"}
        worst: Row = {"name": f"{title}, worst"}
        for column in COLUMNS:
            values = [row[column.key] for row in group if row.get(column.key) is not None]
            if column.badness is not None and values:
                median[column.key] = statistics.median(values)
                worst[column.key] = max(values, key=column.badness)
        if group:
            lines += [[shown(column, row, "") for column in COLUMNS] for row in (median, worst)]
    text = aligned(lines)
    for number, row in enumerate(listed, start=1):
        text[number] += f"  failed: {row['failed']}" if "failed" in row else ""
    return "\n".join(text)
