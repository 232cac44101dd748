# SPDX-License-Identifier: MIT
"""Commands in forked processes that may be killed, starved or lied to, and what they leave."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from sononerf.report.surface_views import SurfaceViews
from tests.small_views import draw_small

LIMIT_SECONDS = 600.0
"""A command that takes longer hangs, s: alone the longest takes 20 s, beside other work minutes."""
TINY = (
    *("scene.name=sphere", "scene.options.radius=0.02"),
    *("poses.count=8", "poses.validation=2", "poses.heldout=2"),
    *("simulation.rays=500", "simulation.sources=60", "simulation.noise_floor_poses=1"),
    *("spectrogram.range_min=0.34", "spectrogram.range_max=0.45"),
    *("field.options.finest=0.01", "field.options.levels=2"),
    *("renderer.options.prune_every=3", "renderer.options.points=30"),
    *("renderer.options.start=50", "renderer.options.prune_below=0.3"),
    *("fit.epochs=3", "fit.steps_per_epoch=4", "fit.batch_poses=2", "fit.batch_frequencies=2"),
    *("fit.checkpoint_seconds=0.05", "preview.voxels=8", "reconstruction.refine=false"),
    "prediction.traced=off",
)
"""An experiment that goes through everything in some seconds: a sphere heard from eight poses."""
SIMULATE = ("simulate", *TINY, "--output", "store", "--workers", "1")
FIT = ("fit", *TINY, "data.store=store", "--output", "run", "--accelerator", "cpu")
AFTER = {
    "predict": ("predict", "run", "--accelerator", "cpu"),
    "reconstruct": ("reconstruct", "run", "--accelerator", "cpu"),
    "evaluate": ("evaluate", "run"),
    "report": ("report", "run"),
    "export": ("export", "run", "run/mesh.mat", "--what", "points"),
}
"""Commands after a fit, by their names."""
TIMES = ("tensorboard", "report.html", "checkpoints", "provenance.json")
"""Files of a run that depend on its time, or on the number of its parts."""


@dataclass(frozen=True)
class Outcome:
    """What a command came to.

    Attributes:
        code: Exit code; below zero the number of the signal that killed it.
        said: Its standard error.
        seconds: Its duration.
        hung: Whether it was killed because it did not end.
        peak: Greatest resident memory, bytes.
    """

    code: int
    said: str
    seconds: float
    hung: bool
    peak: int

    @property
    def faults(self) -> list[str]:
        """What no command may do, whatever was done to it."""
        lines = [line for line in self.said.splitlines() if line.startswith("error: ")]
        found = []
        if self.hung:
            found.append("hangs")
        if "Traceback" in self.said or any("unforeseen" in line for line in lines):
            found.append("traceback")
        if self.code > 0 and self.code < 128 and not lines:
            found.append(f"exit {self.code} without a line")
        if self.code < 0 and not self.hung:
            found.append(f"dies of signal {-self.code}")
        return found


@dataclass
class Report:
    """What a series of trials found.

    Attributes:
        name: Name of the series.
        seed: Seed of its random choices.
        counts: Number of trials of each kind.
        faults: One line for each fault.
    """

    name: str
    seed: int
    counts: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)

    def count(self, kind: str, number: int = 1) -> None:
        """Count trials of a kind."""
        self.counts[kind] = self.counts.get(kind, 0) + number

    def fault(self, line: str) -> None:
        """Note a fault, and show it at once."""
        self.faults.append(line)
        print(f"  {self.name}: {line}", file=sys.stderr, flush=True)

    def lines(self) -> list[str]:
        """Return the report as text."""
        counts = ", ".join(f"{number} {kind}" for kind, number in self.counts.items())
        seconds = time.monotonic() - self.began
        head = f"{self.name}, seed {self.seed}: {counts}; {len(self.faults)} faults; "
        return [f"{head}{seconds:.0f} s", *(f"  {line}" for line in self.faults[:50])]


def warm(*commands: Iterable[object]) -> None:
    """Import once what commands need, so that each forked one starts at once.

    Args:
        commands: Given once, in a folder that goes; what they import and keep is there for all.
    """
    import torch

    torch.set_num_threads(1)  # threads do not live through a fork
    from sononerf.cli import entry, start  # noqa: F401

    here = Path.cwd()
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack:
        stack.callback(os.chdir, here)
        os.chdir(place)
        stack.enter_context(contextlib.redirect_stderr(io.StringIO()))
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        before = sys.argv
        stack.callback(setattr, sys, "argv", before)
        for words in commands:
            sys.argv = ["sononerf", *map(str, words)]
            with contextlib.suppress(SystemExit):
                start.main()


@contextmanager
def prepared(*commands: Iterable[object]) -> Iterator[Path]:
    """Give some commands once, make what takes long short, and give a folder.

    Args:
        commands: Those that will be given; all where there are none.
    """
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        draw_small(patch)
        patch.setattr(SurfaceViews.png, "__defaults__", ((38, 34),))
        warm(*(commands or (SIMULATE, FIT, *AFTER.values())))
        yield Path(place)


def give(
    words: Iterable[object],
    folder: Path,
    *,
    kill_after: float | None = None,
    number: int = signal.SIGKILL,
    before: Callable[[], object] | None = None,
    limit: float = LIMIT_SECONDS,
) -> Outcome:
    """Give a command in a forked process; its standard error is kept, its output thrown away.

    Args:
        words: ``sononerf WORDS``.
        folder: Working directory.
        kill_after: A signal is sent after so long, s.
        number: Number of the signal.
        before: Called in the new process first.
        limit: The process is killed after so long, s.
    """
    heard, tells = os.pipe()
    begun = time.monotonic()
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            os.close(heard)
            os.dup2(tells, 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.chdir(folder)
            sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
            sys.stdout = os.fdopen(1, "w", closefd=False)
            sys.argv = ["sononerf", *map(str, words)]
            code = _child(before)
        finally:
            os._exit(code)
    os.close(tells)
    said, hung, sent = bytearray(), False, kill_after is None
    os.set_blocking(heard, False)
    while True:
        with contextlib.suppress(BlockingIOError):
            said += os.read(heard, 65536)
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        elapsed = time.monotonic() - begun
        if not sent and kill_after is not None and elapsed >= kill_after:
            os.kill(pid, number)
            sent = True
        if elapsed > limit and not hung:
            hung = True
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.002)
    while True:
        try:
            more = os.read(heard, 65536)
        except BlockingIOError:
            break  # a child of the child still has the pipe
        if not more:
            break
        said += more
    os.close(heard)
    code = os.waitstatus_to_exitcode(status)
    text = said.decode(errors="replace")
    return Outcome(code, text, time.monotonic() - begun, hung, usage.ru_maxrss * 1024)


def _child(before: Callable[[], object] | None) -> int:
    from sononerf.cli import start

    for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # On one core nothing starts processes, which would import everything anew.
    os.sched_setaffinity(0, {os.getpid() % os.cpu_count()})
    logging.root.handlers.clear()  # those of the parent write elsewhere
    if before is not None:
        before()
    try:
        start.main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    except BaseException:
        import traceback

        traceback.print_exc()
        return 70
    return 0


def contents(folder: Path, *, leaving: Iterable[str] = TIMES) -> dict[str, str]:
    """Return the SHA-256 of each file below a folder, without what tells of times.

    Args:
        folder: Folder of a run or a store.
        leaving: First parts of names that are left out.
    """
    left = set(leaving)
    found = {}
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder)
        if not file.is_file() or name.parts[0] in left or name.name == ".lock":
            continue
        data = file.read_bytes()
        if name.name == "metrics.json":
            plain = json.loads(data)
            plain.pop("cost", None)
            data = json.dumps(plain, sort_keys=True).encode()
        found[name.as_posix()] = hashlib.sha256(data).hexdigest()
    return found


def leftovers(folder: Path) -> list[str]:
    """Return the files below a folder that no command may leave."""
    return [
        file.relative_to(folder).as_posix()
        for file in folder.rglob(".*")
        if file.name.endswith(".tmp") or file.name == ".probe"
    ]


def differences(one: dict[str, str], other: dict[str, str]) -> list[str]:
    """Return the names whose content differs."""
    names = sorted(one.keys() | other.keys())
    return [name for name in names if one.get(name) != other.get(name)]
