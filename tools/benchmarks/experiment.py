# SPDX-License-Identifier: MIT
"""Whole experiments, one after the other, and the table of what came of them."""

from __future__ import annotations

import os
import platform
import signal
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sononerf import __version__, storage
from sononerf.errors import SonoNerfError
from sononerf.run.run_folder import RunFolder
from sononerf.run.simulate import default_store, echo_hash
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from sononerf.settings.schema import Settings

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "three_spheres.yaml"
"""Nothing but defaults; the scene is laid over it."""
STOPPED = tuple(
    code
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
    for code in (128 + number, -number)  # a command that saved its work, and one that had none
)
"""Exit codes of a command that was stopped on purpose."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """One column of the table: how a value is shown, and what makes it a bad one."""

    key: str
    title: str
    form: str = ""
    scale: float = 1.0
    badness: Callable[[float], float] | None = None  # none: no median, no worst


COLUMNS = (
    Column("seed", "seed"),
    Column("kind", "kind"),
    Column("extent_m", "extent/cm", ".1f", 1e2),
    Column("calls", "calls"),
    Column("fit_s", "fit/s", ".0f", badness=float),
    Column("fscore_1mm", "F 1mm", ".2f", badness=lambda value: -value),
    Column("fscore_2mm", "F 2mm", ".2f", badness=lambda value: -value),
    Column("fscore_5mm", "F 5mm", ".2f", badness=lambda value: -value),
    Column("chamfer_m", "Chamfer/mm", ".2f", 1e3, badness=float),
    Column("thickness_bias_m", "bias/mm", "+.2f", 1e3, badness=abs),
    Column("volume_ratio", "volume", ".2f", badness=lambda value: abs(value - 1.0)),
    Column("parts", "parts"),
    Column("parts_true", "true"),
    Column("heldout_mae_db_active", "held-out/dB", ".2f", badness=float),
    Column("backprojection_fscore_5mm", "backpr. F 5mm", ".2f", badness=lambda value: -value),
)


def run_experiment(
    folder: Path,
    data: Path,
    settings: Sequence[str],
    *,
    config: Path = CONFIG,
    enough: str | None = None,
    store: Path | None = None,
) -> dict[str, Any]:
    """Run an experiment as a user would, in a process of its own.

    Parameters
    ----------
    folder : Path
        Of the run; a finished one is left as it is. What was said goes to ``<folder>.log``.
    data : Path
        Of the ensembles, each by its hash, so that runs of the same echoes share one.
    settings : sequence of str
        ``KEY=VALUE``, laid over the file.
    config : Path
        The settings file; the defaults' where none is given.
    enough : str or None
        The section of ``metrics.json`` that is asked for: a command that wrote it has not failed,
        whatever came after, as where a short fit holds no surface yet.
    store : Path or None
        The ensemble, where it is not one of those in ``data``.

    Returns
    -------
    metrics : dict
        All of ``metrics.json``.

    Raises
    ------
    SonoNerfError
        If the settings are wrong, or the folder holds a run of others.
    RuntimeError
        If the command failed; with its last line.
    KeyboardInterrupt
        If it was stopped.
    """
    chosen = load_settings(config, settings)
    run = RunFolder(folder)
    if run.config.is_file():
        run.check(chosen)
        metrics = run.read_metrics()
        if "baseline" in metrics:  # what is written last
            return metrics
    store = store or data / ensemble_name(chosen)
    log = folder.with_name(f"{folder.name}.log")
    storage.make_folder(folder.parent)
    command = [sys.executable, "-m", "sononerf.cli", "fit", str(config), *settings]
    command += [f"data.store={store}", "--output", str(folder)]
    # The child saves what it has when it is interrupted; it is waited for.
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:  # what is ignored, as by a shell's &, the child ignores too
        signal.signal(signal.SIGINT, lambda *_: None)
    try:
        with log.open("w", encoding="utf-8") as said:
            code = subprocess.run(command, stdout=said, stderr=said, check=False).returncode
    finally:
        signal.signal(signal.SIGINT, before)
    if code in STOPPED:
        raise KeyboardInterrupt
    if code and (enough is None or enough not in run.read_metrics()):
        lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "nothing was said")
        raise RuntimeError(f"exit code {code}: {last.strip()}")
    return run.read_metrics()


def ensemble_name(settings: Settings) -> str:
    """Return the name of the folder that holds the ensemble of these settings."""
    scene = load_scene(settings.scene.name, settings.scene.options)
    return default_store(settings, echo_hash(settings, scene)).name


@contextmanager
def ending(output: Path) -> Iterator[None]:
    """End a series with one line where its runs cannot go on; its finished runs are kept."""
    try:
        yield
    except (SonoNerfError, RuntimeError) as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit(f"{output}: stopped; the same command goes on") from None


def origin() -> dict[str, str]:
    """Return what a table was made with."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return {"sononerf": __version__, "machine": machine}


def row_of(metrics: Mapping[str, Any]) -> Row:
    """Return what the table shows of one run; None for what it does not have."""
    cost, prediction, geometry, baseline = (
        metrics.get(name) or {} for name in ("cost", "prediction", "geometry", "baseline")
    )
    scores = geometry.get("fscore", {})
    other = (baseline.get("backprojection") or {}).get("fscore", {})
    return {
        "fit_s": cost.get("fit_s"),
        **{f"fscore_{mm}mm": scores.get(f"0.00{mm}") for mm in (1, 2, 5)},
        **{key: geometry.get(key) for key in ("chamfer_m", "thickness_bias_m", "volume_ratio")},
        "parts": geometry.get("components"),
        "parts_true": geometry.get("components_true"),
        "heldout_mae_db_active": prediction.get("mae_db_active"),
        "backprojection_fscore_5mm": other.get("0.005"),
    }


def run_series(
    output: Path,
    file: str,
    experiments: Iterable[tuple[str, Row, Sequence[str]]],
    *,
    data: Path | None,
    seconds: float,
    after: Callable[[list[Row]], None] = lambda _: None,
) -> str:
    """Run experiments in turn, and keep their table as JSON after each of them.

    Parameters
    ----------
    output : Path
        Holds a folder for each run, and the table.
    file : str
        Name of the table.
    experiments : iterable of (str, dict, sequence of str)
        Name of the run's folder, what its row begins with, and its settings.
    data : Path or None
        Of the ensembles; ``data`` in the output where None.
    seconds : float
        A fit that took longer is marked ``over``.
    after : callable
        Is given all rows so far after each run.

    Returns
    -------
    text : str
        The table for people.
    """
    rows: list[Row] = []
    for name, head, settings in experiments:
        with ending(output):  # wrong settings would be so for all, and cost a table that is there
            try:
                metrics = run_experiment(output / name, data or output / "data", settings)
                row = {**head, **row_of(metrics)}
                row["over"] = row["fit_s"] is not None and row["fit_s"] > seconds
            except RuntimeError as error:
                row = {**head, "failed": str(error), "over": False}
        rows.append({**row, "settings": list(settings)})
        print(f"{output / name}: {row.get('failed', 'done')}", file=sys.stderr, flush=True)
        storage.commit_json(
            output / file,
            {**origin(), "seconds": seconds, **summary(rows), "rows": rows},
        )
        after(rows)
    return f"{table(rows)}\nwrote {output / file}"


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Return medians and worst values of the runs that came to an end, and counts."""
    median, worst = {}, {}
    for column in COLUMNS:
        values = [row[column.key] for row in rows if row.get(column.key) is not None]
        if column.badness is not None and values:
            median[column.key] = statistics.median(values)
            worst[column.key] = max(values, key=column.badness)
    return {
        "median": median,
        "worst": worst,
        "runs": len(rows),
        "failed": sum("failed" in row for row in rows),
        "over": sum(row["over"] for row in rows),
        "parts_as_true": sum(
            row.get("parts") is not None and row["parts"] == row["parts_true"] for row in rows
        ),
    }


def table(rows: Sequence[Row]) -> str:
    """Return the rows, their medians and their worst values as lines of text."""
    columns = [column for column in COLUMNS if any(column.key in row for row in rows)]
    found = summary(rows)
    lines = [[column.title for column in columns]]
    lines += [[shown(column, row) for column in columns] for row in rows]
    for name in ("median", "worst"):
        lines.append([shown(column, found[name], "") for column in columns])
        lines[-1][0] = name
    text = aligned(lines)
    for number, row in enumerate(rows, start=1):
        text[number] += f"  failed: {row['failed']}" if "failed" in row else ""
        text[number] += "  over" if row["over"] else ""
    text.append(
        f"{found['parts_as_true']} of {found['runs']} with as many parts as in truth; "
        f"{found['over']} over the time, {found['failed']} failed"
    )
    return "\n".join(text)


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of words as lines of text, each column at the right of its place."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        "  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]


def shown(column: Column, row: Mapping[str, Any], absent: str = "-") -> str:
    """Return a row's value as its column shows it."""
    value = row.get(column.key)
    if value is None:
        return absent
    return f"{value * column.scale:{column.form}}" if column.form else str(value)
