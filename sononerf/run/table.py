# SPDX-License-Identifier: MIT
"""The numbers of several runs as lines of text, and as a CSV file."""

from __future__ import annotations

import csv as csv_format
import io
from collections.abc import Sequence
from pathlib import Path

from sononerf import storage
from sononerf.errors import InputError
from sononerf.report.key_numbers import run_rows
from sononerf.run.build import locked
from sononerf.run.provenance import flat
from sononerf.run.run import Run
from sononerf.tables import aligned


def table(paths: Sequence[Path], *, csv: Path | None = None) -> list[str]:
    """Return the numbers of runs as lines: a row per number, a column per run."""
    runs = [Run(path) for path in paths]
    found = []
    for run in runs:
        run.open()
        found.append(run.read_metrics())
        try:
            run_rows(found[-1:])
        except (TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"{run.metrics_file}: damaged ({error}); remove it and evaluate again"
            ) from None
    names = [run.path.resolve().name for run in runs]
    if len(set(names)) < len(names):
        names = [str(run.path) for run in runs]
    rows = [("", *names), *run_rows(found)]
    if csv is not None:
        values = [flat(metrics) for metrics in found]
        keys = sorted({key for one in values for key in one} - {"schema"})
        text = io.StringIO()
        writer = csv_format.writer(text, lineterminator="\n")
        writer.writerow(["run", *keys])
        for name, one in zip(names, values, strict=True):
            writer.writerow([name, *("" if one.get(key) is None else one[key] for key in keys)])
        with locked(runs, csv):
            storage.commit_text(csv, text.getvalue())
    return aligned(rows, "<" + ">" * len(runs))
