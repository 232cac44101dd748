# SPDX-License-Identifier: MIT
"""The entry of the command line: the root command, signals, and exit codes."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Annotated

import typer

from sononerf import __version__
from sononerf.cli import experiments, files
from sononerf.cli.options import app, say
from sononerf.errors import SettingsError, SonoNerfError, StoppedError
from sononerf.memory import memory_limited
from sononerf.progress import Progress

__all__ = ["app", "experiments", "files", "main"]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sononerf {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print results, warnings and errors alone.")
    ] = False,
) -> None:
    del version
    Progress.silenced = quiet
    if context.invoked_subcommand is None:
        say(context.get_help())
        raise typer.Exit(SettingsError.exit_code)
    logging.basicConfig(format="warning: %(message)s", level=logging.WARNING)


class _SignalledError(BaseException):
    """A signal came; nothing on the way may take it for a fault and go on."""

    def __init__(self, number: int) -> None:
        self.number = number


@contextmanager
def _signals_unwind() -> Iterator[None]:
    """Let signals close files and end child processes on the way out."""

    def unwind(number: int, frame: FrameType | None) -> None:
        del frame
        raise _SignalledError(number)

    before = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # What was ignored when we were started (nohup, a shell's &) stays ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, unwind)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run() -> int:
    try:
        with _signals_unwind(), memory_limited():
            return app(prog_name="sononerf", standalone_mode=False) or 0
    except SonoNerfError as error:
        fault = error
    except typer.TyperException as error:
        where = getattr(getattr(error, "ctx", None), "command_path", "sononerf")
        text = error.format_message().rstrip(".").replace("Value error, ", "")
        text = text.replace(". Did you mean", "; did you mean").rstrip("?")
        fault = SettingsError(f"{text[:1].lower()}{text[1:]}; see `{where} --help`")
    except _SignalledError as error:
        fault = StoppedError(error.number)
    if isinstance(fault, StoppedError):
        say(str(fault))  # the user's wish, not a fault
        return fault.exit_code
    for line in str(fault).splitlines():
        typer.echo(f"error: {line}", err=True)
    return fault.exit_code


def main() -> None:
    """Run the command line and end with the exit code of what went wrong."""
    try:
        sys.exit(_run())
    except BrokenPipeError:
        # The reader of our output went away, as `head` does.
        sys.stderr.close()
        sys.exit(141)
