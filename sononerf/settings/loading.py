# SPDX-License-Identifier: MIT
"""Settings from YAML files and ``KEY=VALUE`` arguments, and back to YAML."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from sononerf.errors import SettingsError
from sononerf.settings.schema import Settings
from sononerf.settings.setting_faults import describe_faults, refuse_truths

MAX_SETTINGS_BYTES = 1_000_000
MAX_SETTINGS_DEPTH = 50
PLUGIN_NAMES = (("scene", "name"), ("field", "kind"), ("renderer", "kind"))
"""Keys whose value decides what the options beside it mean."""


class _StrictLoader(yaml.SafeLoader):
    """YAML that refuses duplicate keys and reads ``3e-3`` as the number it is."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is no text", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} stands twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


# YAML 1.1 reads 3e-3 as text, 010 as eight, 12:30 as 750 and `on` as true; YAML 1.2's core
# schema does not.
_StrictLoader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("int", r"^[-+]?(?:0|[1-9][0-9]*)$", list("-+0123456789")),
    (
        "float",
        r"^[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$",
        list("-+0123456789."),
    ),
):
    _StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)


def _parse_yaml(text: str, where: str) -> Any:
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_StrictLoader):
            if isinstance(event, yaml.AliasEvent):
                raise SettingsError(f"{where}: YAML aliases are not accepted; write the value out")
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
                if depth > MAX_SETTINGS_DEPTH:
                    raise SettingsError(f"{where}: nested deeper than {MAX_SETTINGS_DEPTH} levels")
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{where}:{mark.line + 1}:{mark.column + 1}" if mark else where
        problem = getattr(error, "problem", None) or "is no YAML"
        raise SettingsError(f"{place}: {problem}") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """Read one settings file as plain data.

    Raises
    ------
    SettingsError
        If the file is missing, not UTF-8, too large, or no YAML mapping.
    """
    try:
        if path.stat().st_size > MAX_SETTINGS_BYTES:
            raise SettingsError(f"{path}: larger than {MAX_SETTINGS_BYTES} bytes; no settings file")
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        near = difflib.get_close_matches(
            path.name, [p.name for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
        )
        hint = f"; did you mean {path.parent / near[0]}?" if near else ""
        raise SettingsError(f"{path}: no such settings file{hint}") from None
    except UnicodeDecodeError:
        raise SettingsError(f"{path}: not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror})") from None
    data = _parse_yaml(text, str(path))
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise SettingsError(f"{path}: holds {type(data).__name__}, expected `section:` lines")
    return data


def apply_override(data: dict[str, Any], assignment: str) -> None:
    """Set one dotted ``KEY=VALUE`` in ``data``, in place.

    Raises
    ------
    SettingsError
        If the text is no assignment or runs through a value that is no section.
    """
    key, equals, value = assignment.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise SettingsError(
            f"{assignment!r}: expected KEY=VALUE with a dotted key, such as fit.epochs=5"
        )
    node = data
    for part in parts[:-1]:
        child = node.setdefault(part, {})
        if not isinstance(child, dict):
            raise SettingsError(f"{key}: {part} is a value, not a section")
        node = child
    node[parts[-1]] = _parse_yaml(value, key)


def _drop_options_of_another(data: dict[str, Any], assignment: str) -> None:
    """Leave out the file's options where the command line names another scene than the file."""
    key, _, value = assignment.partition("=")
    section, _, name = key.strip().partition(".")
    if (section, name) not in PLUGIN_NAMES or not isinstance(data.get(section), dict):
        return
    if data[section].get(name) != value.strip():
        data[section].pop("options", None)


def validate_settings(data: Mapping[str, Any], source: str) -> Settings:
    """Check plain data against the settings.

    Raises
    ------
    SettingsError
        One line per fault, naming ``source``, the dotted key and what is allowed.
    """
    try:
        settings = Settings.model_validate(dict(data))
    except ValidationError as error:
        raise SettingsError(describe_faults(error, Settings, source)) from None
    refuse_truths(data, settings, source=source)
    settings.__dict__["source"] = source
    return settings


def load_settings(path: Path, overrides: Iterable[str] = ()) -> Settings:
    """Read a settings file and lay ``KEY=VALUE`` assignments over it.

    An assignment that names another scene, field or renderer than the file does takes the file's
    options for the old one away.
    """
    data = read_yaml(path)
    overrides = list(overrides)
    for assignment in overrides:
        _drop_options_of_another(data, assignment)
    for assignment in overrides:
        apply_override(data, assignment)
    return validate_settings(data, str(path))


def dump_yaml(settings: Settings) -> str:
    """Return the settings, whole, as YAML text that :func:`load_settings` reads back."""
    return str(yaml.safe_dump(settings.plain(), sort_keys=False, allow_unicode=True))
