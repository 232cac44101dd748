# SPDX-License-Identifier: MIT
"""The application: its root command, options that several commands share, and error messages."""

from __future__ import annotations

import importlib
import json
import logging
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sononerf import __version__
from sononerf.errors import SettingsError, SonoNerfError
from sononerf.progress import Progress
from sononerf.resources import memory_faults
from sononerf.storage import WAYS_OUT, commit_text, storage_error

app = typer.Typer(
    name="sononerf",
    help="Three-dimensional hearing: simulate echoes, fit a reflectivity field, predict, "
    "reconstruct.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


Accelerator = Literal["auto", "cpu", "gpu"]
SurfaceMethod = Literal["levels", "isosurface"]
Registration = Literal["none", "rigid", "similarity"]
Exported = Literal["auto", "echoes", "prediction", "volume", "mesh"]
FrameName = Literal["auto", "world", "original"]
Figures = Literal["svg", "pdf"]
Unit = Literal["m", "cm", "mm"]
Split = Literal["test", "val", "train"]
Within = Literal["sphere", "cap", "volume"]
Config = Annotated[
    Path,
    typer.Argument(
        help="Settings file; or the name of a shipped one, such as three_spheres; or KEY=VALUE."
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="[KEY=VALUE]...", help="Settings by dotted key, such as fit.epochs=5."),
]
Run = Annotated[Path, typer.Argument(help="Folder of a run.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
InFrame = Annotated[
    FrameName,
    typer.Option(
        help="world: z up, metres. original: of the recordings, or of the scene's file. auto: "
        "original for recordings."
    ),
]
OnWhat = Annotated[Accelerator, typer.Option(help="Device to compute on.")]


def say(text: str) -> None:
    """Print a line for people, on standard error; not under ``--quiet``."""
    if not Progress.silenced:
        typer.echo(text, err=True)


def print_json(data: Any) -> None:
    """Print one JSON object on standard output."""
    typer.echo(json.dumps(data, indent=2, allow_nan=False))


def optional(values: dict[str, Any], key: str, template: str) -> str:
    """Return a value in a template; nothing where there is no value."""
    value = values.get(key)
    return "" if value is None else template.format(value)


def _version(shown: bool) -> None:
    if shown:
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
    for handler in logging.getLogger().handlers:
        if type(handler) is logging.StreamHandler:  # the one of this command line
            handler.filters = [_Once()]


class _Once(logging.Filter):
    """Lets each line through once: one command may make a scene several times."""

    def __init__(self) -> None:
        super().__init__()
        self.said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the line is new."""
        line = record.getMessage()
        is_new = line not in self.said
        self.said.add(line)
        return is_new


def complete() -> typer.Typer:
    """Return the application with all of its commands."""
    importlib.import_module("sononerf.cli.experiments")
    importlib.import_module("sononerf.cli.files")
    return app


def run() -> int:
    """Run the given command and return its exit code; its exceptions pass through."""
    quiet = [word for word in sys.argv[1:] if word in ("-q", "--quiet")]
    # It may stand behind the command too.
    sys.argv[1:] = [*quiet[:1], *(word for word in sys.argv[1:] if word not in quiet)]
    for word in sys.argv[1:]:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise SettingsError(
                f"{word!a}: holds bytes that are no UTF-8; rename the file or folder, or work "
                "within it by a relative path"
            ) from None
    with memory_faults():
        return complete()(prog_name="sononerf", standalone_mode=False) or 0


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
