# SPDX-License-Identifier: MIT
"""Objects in notebooks, and aligned columns of text."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sononerf import storage
from sononerf.errors import InputError
from sononerf.storage import name_by_content, require_regular, wrong_kind

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


class NotebookRepr:
    """Shows itself in a notebook."""

    def _repr_html_(self) -> str:
        return str(_displays["html"](self))


def picture_of(thing: object, **options: Any) -> Picture:
    """Return the picture of an object, see :func:`sononerf.report.page.png_of`."""
    return Picture(_displays["picture"](thing, **options))


MOST_BYTES = 200_000_000
"""Largest table of poses that is read, bytes."""


def read_rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header of a table, and line number and cells of each row."""
    try:
        require_regular(path)
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: larger than {MOST_BYTES} bytes; no table of poses")
        if name_by_content(path):
            raise wrong_kind(path, "table of poses")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not UTF-8 text; save it as CSV in UTF-8") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    # Lines that programs put before the header; line numbers stay those of the file.
    before = re.match(r'(?:(?:sep=|#).*\n)+(?=["A-Za-z])', text)
    if before:
        text = before[0].count("\n") * "\n" + text[before.end() :]
    separator = max(",;\t", key=text.lstrip().partition("\n")[0].count)
    try:
        reader = csv.reader(io.StringIO(text), delimiter=separator, strict=True)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: no CSV table ({error})") from None
    if len(rows) < 2:
        raise InputError(f"{path}: holds no poses; expected a header line and one line per pose")
    header = [cell.strip() for cell in rows[0][1]]
    double = sorted({name for name in header if header.count(name) > 1})
    if double:
        raise InputError(f"{path}:1: duplicate column {double[0]!r}")
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(f"{path}:{line}: {len(row)} columns, expected {len(header)}")
    return header, rows[1:]


def number_in(path: Path, line: int, name: str, cell: str) -> float:
    """Return the number in a cell."""
    try:
        number = float(cell.replace("\N{MINUS SIGN}", "-"))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(
            f"{path}:{line}: column {name} is {cell!r}, expected a finite number with a decimal "
            "point"
        )
    return number


def aligned(rows: Sequence[Sequence[str]], sides: str) -> list[str]:
    """Return rows as lines with columns of one width; each column's side is ``<`` or ``>``."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    columns = list(zip(sides, widths, strict=True))
    return [
        "  ".join(
            f"{cell:{side}{width}}" for cell, (side, width) in zip(row, columns, strict=True)
        ).rstrip()
        for row in rows
    ]
