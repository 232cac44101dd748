# SPDX-License-Identifier: MIT
"""Whole experiments, one after the other, and the table of what came of them."""

from __future__ import annotations

import json
import os
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from sononerf import __version__, storage
from sononerf.errors import SonoNerfError
from sononerf.run.run import Run
from sononerf.run.simulate import default_store, echo_hash
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from sononerf.settings.schema import Settings

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "configs" / "three_spheres.yaml"
"""Settings file with defaults alone; the scene overrides it."""
STOPPED = tuple(
    code
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
    for code in (128 + number, -number)  # a command that saved its work, and one that had none
)
"""Exit codes of a command that was stopped on purpose."""

Row = dict[str, Any]


def rows_of(file: Path) -> list[Row]:
    """Return the rows of a table; of rows with the same name, seed and calls the last one."""
    rows: dict[tuple[Any, ...], Row] = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue  # a crash tore it
        rows[row["name"], row.get("seed"), row.get("calls")] = row
    return list(rows.values())


def append_line(path: Path, text: str) -> None:
    """Append a line to a file; one that was torn before is ended first."""
    with path.open("a+b") as file:
        torn = file.tell() and path.read_bytes()[-1:] != b"\n"
        file.write((("\n" if torn else "") + text + "\n").encode())


@dataclass(frozen=True)
class Column:
    """One column of the table: how a value is shown, and what makes it a bad one."""

    key: str
    title: str
    form: str = ""
    scale: float = 1.0
    badness: Callable[[float], float] | None = None  # none: no median, no worst


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

    Args:
        folder: Folder of the run; a finished one is left as it is. Standard error goes to
            ``<folder>.log``.
        data: Folder of the ensembles, each by its hash, so that runs of the same echoes share one.
        settings: ``KEY=VALUE``, laid over the file.
        config: The settings file; the defaults' where none is given.
        enough: The section of ``metrics.json`` that is asked for: a command that wrote it has not
            failed, whatever came after, as where a short fit holds no surface yet.
        store: The ensemble, where it is not one of those in ``data``.

    Returns:
        metrics: All of ``metrics.json``.

    Raises:
        SonoNerfError: If the settings are wrong, or the folder holds a run of others.
        RuntimeError: If the command failed; with its last line.
        KeyboardInterrupt: If it was stopped.
    """
    chosen = load_settings(config, settings)
    run = Run(folder)
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
    cores, threads = os.cpu_count(), torch.get_num_threads()
    machine = f"{platform.system()} {platform.machine()}, {cores} cores, {threads} threads"
    command = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return {"sononerf": __version__, "commit": done.stdout.strip(), "machine": machine}


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


def device_name(accelerator: str) -> str:
    """Return what torch calls the device that an accelerator stands for: ``cpu`` or ``cuda``."""
    return "cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu"


def keep(output: Path, what: str, device: str, found: dict[str, Any]) -> Path:
    """Write figures to ``WHAT-VERSION-MACHINE-DEVICE.json``.

    Returns:
        path: Path of the file.
    """
    chip = torch.cuda.get_device_name() if device == "cuda" else device
    parts = (what, __version__, platform.node() or platform.machine(), chip)
    name = "-".join(re.sub(r"[^A-Za-z0-9.]+", "_", part) for part in parts)
    path = output / f"{name}.json"
    storage.make_folder(output)
    storage.commit_json(path, {**origin(), "device": chip, **found})
    return path


def ratios(old: Path, found: dict[str, Any]) -> str:
    """Return what each number is over that of an older file, by its dotted name."""
    before = dict(_numbers(storage.read_json(old)))
    lines = [["figure", "before", "now", "ratio"]]
    for name, now in _numbers(json.loads(json.dumps(found))):
        then = before.get(name)
        if then:
            lines.append([name, f"{then:.4g}", f"{now:.4g}", f"{now / then:.2f}"])
    return "\n".join(aligned(lines))


def _numbers(data: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield numbers with their dotted names; of rows, by what they are called."""
    if isinstance(data, bool):
        return
    if isinstance(data, int | float):
        yield name, float(data)
    elif isinstance(data, dict):
        for key, value in data.items():
            yield from _numbers(value, f"{name}.{key}" if name else key)
    elif isinstance(data, list):
        for item in data:
            if isinstance(item, dict) and "name" in item:
                yield from _numbers(item, f"{name}.{item['name']}")
