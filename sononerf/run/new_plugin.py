# SPDX-License-Identifier: MIT
"""A scene, field or renderer of one's own: a copy of a package that is tested as it is."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from sononerf import storage
from sononerf.errors import SettingsError
from sononerf.settings import plugins

Kind = Literal["scene", "field", "renderer"]
TEMPLATES = Path(__file__).resolve().parent.parent / "templates"
"""Folder of the packages, one per kind; each is called ``my-KIND``, its module ``my_KIND``."""


def new_plugin(kind: Kind, name: str, folder: Path | None = None) -> list[Path]:
    """Write a plugin with one scene, field or renderer: two files that install, and their test."""
    module = name.replace("-", "_")
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9_-]*[A-Za-z0-9])?", name):
        raise SettingsError(
            f"NAME: found {name!r}; give letters, digits, _ and -, a letter first and no _ or - "
            "last, e.g. my_bar"
        )
    if any(plugin.name == module for plugin in plugins.registered(f"sononerf.{kind}s")):
        raise SettingsError(f"NAME: there is a {kind} {module!r}; choose another, e.g. my_{module}")
    folder = Path(name) if folder is None else folder
    if folder.is_dir() and any(folder.iterdir()):
        raise SettingsError(f"{folder}: is not empty; choose another folder with --output")
    written = []
    for file in sorted((TEMPLATES / kind).glob("*.*"), key=lambda file: file.name):
        text = file.read_text(encoding="utf-8")
        text = text.replace(f"my-{kind}", name).replace(f"my_{kind}", module)
        written.append(folder / file.name.replace(f"my_{kind}", module))
        storage.commit_text(written[-1], text)
    return sorted(written, key=lambda file: (file.suffix != ".toml", file.name.startswith("test_")))
