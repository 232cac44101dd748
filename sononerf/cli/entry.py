# SPDX-License-Identifier: MIT
"""The root command, and its error messages."""

from __future__ import annotations

import logging
import tempfile
import traceback
from pathlib import Path
from typing import Annotated

import typer

from sononerf.cli import experiments, files
from sononerf.cli.options import app, say
from sononerf.errors import SettingsError, SonoNerfError
from sononerf.memory import memory_faults
from sononerf.progress import Progress
from sononerf.storage import WAYS_OUT, commit_text, storage_error
from sononerf.version import __version__

__all__ = ["app", "experiments", "fault_of", "files", "run"]


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


def run() -> int:
    """Run the given command and return its exit code; its exceptions pass through."""
    with memory_faults():
        return app(prog_name="sononerf", standalone_mode=False) or 0


def fault_of(error: Exception) -> SonoNerfError:
    """Return an exception of a command as an error with a line for the user."""
    if isinstance(error, SonoNerfError):
        return error
    if isinstance(error, typer.TyperException):
        where = getattr(getattr(error, "ctx", None), "command_path", "sononerf")
        text = error.format_message().rstrip(".").replace("Value error, ", "")
        text = text.replace(". Did you mean", "; did you mean").rstrip("?")
        return SettingsError(f"{text[:1].lower()}{text[1:]}; see `{where} --help`")
    return _unforeseen(error)


def _unforeseen(error: Exception) -> SonoNerfError:
    """Return one line for an unexpected exception; a file keeps its traceback."""
    refused: BaseException | None = error
    while refused is not None:
        # Libraries report a full disk by an exception of their own around the system's.
        if isinstance(refused, OSError) and refused.errno in WAYS_OUT:
            path = Path(str(refused.filename or "a file"))
            return storage_error("cannot be read or written", path, refused)
        hidden = refused.__suppress_context__  # an exception that was handled is not the cause
        refused = refused.__cause__ or (None if hidden else refused.__context__)
    first = str(error).partition("\n")[0]
    line = f"unforeseen: {type(error).__name__}: {first}"
    try:
        kept = Path(tempfile.mkdtemp(prefix="sononerf-")) / "traceback.txt"
        commit_text(kept, f"sononerf {__version__}\n{''.join(traceback.format_exception(error))}")
    except (OSError, SonoNerfError):
        return SonoNerfError(f"{line}; this is a fault of sononerf, or of a plugin")
    return SonoNerfError(
        f"{line}; this is a fault of sononerf, or of a plugin: report it with {kept}"
    )
