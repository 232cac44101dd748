# SPDX-License-Identifier: MIT
"""Display of objects in a notebook: a table of numbers and a small picture."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from sononerf import storage

NOTEBOOK = "sononerf.report.notebook"
"""Module that shows each kind of object. It imports all of them, so that they cannot import it; it
is imported at first use."""


class Picture:
    """A picture, which shows itself in a notebook."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def save(self, path: Path | str) -> None:
        """Write the PNG file."""
        storage.commit_bytes(Path(path), self.data)

    def _repr_png_(self) -> bytes:
        return self.data


class Shown:
    """Shows itself in a notebook."""

    def _repr_html_(self) -> str:
        return str(import_module(NOTEBOOK).html_of(self))


def picture_of(thing: object, **options: Any) -> Picture:
    """Return the picture of an object, see :func:`sononerf.report.notebook.png_of`."""
    return Picture(import_module(NOTEBOOK).png_of(thing, **options))
