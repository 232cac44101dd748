# SPDX-License-Identifier: MIT
"""Display of objects in a notebook: a table of numbers and a small picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sononerf import storage

Display = Callable[..., Any]
_displays: dict[str, Display] = {}


def show_by(html: Display, picture: Display) -> None:
    """Set what makes the HTML and the picture of an object; the package does so when imported."""
    _displays.update(html=html, picture=picture)


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
        return str(_displays["html"](self))


def picture_of(thing: object, **options: Any) -> Picture:
    """Return the picture of an object, see :func:`sononerf.report.notebook.png_of`."""
    return Picture(_displays["picture"](thing, **options))
