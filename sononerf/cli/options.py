# SPDX-License-Identifier: MIT
"""Arguments and options that several commands share, and how they print."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sononerf.progress import Progress

app = typer.Typer(
    name="sononerf",
    help="Three-dimensional hearing: simulate echoes, fit a reflectivity field, predict, "
    "reconstruct.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


Accelerator = Literal["auto", "cpu", "gpu"]
SurfaceMethod = Literal["auto", "open", "filled", "hull", "sheet", "levels", "isosurface"]
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
