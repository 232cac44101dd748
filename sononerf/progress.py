# SPDX-License-Identifier: MIT
"""Progress of long work: a bar in a terminal, plain lines elsewhere; always on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

LINE_SECONDS = 10.0
"""Shortest time between two plain lines, s."""
MIN_BAR_COLUMNS = 80
"""Least width of a terminal, columns, for a bar with all its numbers in one line."""


def duration(seconds: float) -> str:
    """Return a duration as text, in the largest unit of which there are two or more."""
    for unit, length in (("days", 86_400.0), ("h", 3_600.0), ("min", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


class Task:
    """One piece of work that is counted."""

    def __init__(self, what: str, total: int, bars: Bars | None, quiet: bool) -> None:
        self.what, self.total, self.done, self.note = what, total, 0, ""
        self._bars, self._quiet = bars, quiet
        self._id = bars.add_task(what, total=total, note="") if bars else None
        self._started = self._last = time.monotonic()

    def advance(self, count: int = 1, note: str | None = None) -> None:
        """Count on; ``note`` stands behind the bar until the next one."""
        self.done += count
        if note is not None:
            self.note = note
        if self._bars is not None and self._id is not None:
            self._bars.update(self._id, completed=self.done, note=self.note)
        elif self.done < self.total and time.monotonic() - self._last >= LINE_SECONDS:
            self._line()

    def _line(self) -> None:
        if self._quiet:
            return
        self._last = time.monotonic()
        seconds = self._last - self._started
        text = f"{self.what}: {self.done} of {self.total}, {seconds:.0f} s"
        if 0 < self.done < self.total:
            rate = self.done / max(seconds, 1e-9)
            text += f", {rate:.2g}/s, {(self.total - self.done) / rate:.0f} s left"
        text += f" {self.note}"
        print(text.rstrip(), file=sys.stderr, flush=True)  # noqa: T201

    def finish(self) -> None:
        """Say in a plain line how it ended, if any line was said before or it took long."""
        if self._bars is None and time.monotonic() - self._started > 2.0:
            self._line()


class Progress:
    """Shows tasks one after the other.

    Attributes:
        silenced: If True, every new Progress is quiet; ``--quiet`` of the command line sets it.
    """

    silenced: ClassVar[bool] = False

    def __init__(self, *, quiet: bool = False) -> None:
        self.quiet = quiet or Progress.silenced
        self.console = Console(stderr=True, highlight=False)

    def say(self, text: str) -> None:
        """Print one line on stderr."""
        if not self.quiet:
            self.console.print(text, markup=False, soft_wrap=True)

    @contextmanager
    def task(self, what: str, total: int) -> Iterator[Task]:
        """Count a piece of work of ``total`` parts."""
        if self.quiet or not self.console.is_terminal:
            task = Task(what, total, None, self.quiet)
            yield task
            task.finish()
            return
        columns: list[ProgressColumn] = [TextColumn("{task.description}"), MofNCompleteColumn()]
        if self.console.width >= MIN_BAR_COLUMNS:
            columns[1:1] = [BarColumn()]
            columns += [TimeElapsedColumn(), TimeRemainingColumn()]
            columns += [TextColumn("{task.fields[note]}")]
        else:
            columns += [TimeRemainingColumn()]
        with Bars(*columns, console=self.console) as bars:
            yield Task(what, total, bars, quiet=False)
