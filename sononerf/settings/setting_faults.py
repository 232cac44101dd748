# SPDX-License-Identifier: MIT
"""Faults of settings, one line each: where, what was found, what is allowed."""

from __future__ import annotations

import difflib
import re
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from pydantic import BaseModel, ValidationError

from sononerf.errors import SettingsError


def _model_at(model: type[BaseModel], path: Iterable[str | int]) -> type[BaseModel] | None:
    for part in path:
        if isinstance(part, int):  # in a list of models, each of them
            continue
        info = model.model_fields.get(part)
        found = info.annotation if info else None
        if typing.get_origin(found) is list:
            found = typing.get_args(found)[0]
        if not (isinstance(found, type) and issubclass(found, BaseModel)):
            return None
        model = found
    return model


def describe_faults(
    error: ValidationError, model: type[BaseModel], source: str | None, prefix: str = ""
) -> str:
    """Turn pydantic's faults into one line each: source, dotted key, what is wrong, a way out."""
    head = "" if source is None else f"{source}: "
    lines: dict[str, None] = {}
    for fault in error.errors():
        if fault["type"] == "default_factory_not_called":
            continue  # it follows from a key that is at fault itself
        location = [
            part
            for part in fault["loc"]
            if not (isinstance(part, str) and re.search(r"constrained|literal|\[", part))
        ]
        # A union reports one fault per member, with the member's type as last part.
        if location and location[-1] in ("int", "float", "none", "str"):
            location = location[:-1]
        key = ".".join([*([prefix] if prefix else []), *(str(part) for part in location)])
        if fault["type"] == "extra_forbidden":
            parent = _model_at(model, location[:-1])
            known = list(parent.model_fields) if parent else []
            near = difflib.get_close_matches(str(location[-1]), known, n=1)
            listed = f"known here: {', '.join(known)}" if known else "there is none to set here"
            hint = f"did you mean {near[0]}?" if near else listed
            lines[f"{head}{key}: unknown key; {hint}"] = None
        elif fault["type"] == "missing" and isinstance(location[-1], int):
            # One fault for each value that a list is short of; the last one tells the length.
            short = ".".join([*([prefix] if prefix else []), *map(str, location[:-1])])
            end = f"found {fault['input']!r}; give {location[-1] + 1} values"
            lines = {line: None for line in lines if not line.startswith(f"{head}{short}: found")}
            lines[f"{head}{short}: {end}"] = None
        elif fault["type"] == "missing":
            lines[f"{head}{key}: missing; set it, e.g. {key}=..."] = None
        elif fault["type"] == "value_error":
            message = fault["msg"].removeprefix("Value error, ")
            lines[f"{head}{key + ': ' if key else ''}{message}"] = None
        else:
            message = fault["msg"][0].lower() + fault["msg"][1:]
            found = repr(fault["input"])
            found = found if len(found) < 80 else found[:77] + "..."
            lines[f"{head}{key}: found {found}; {message}"] = None
    return "\n".join(lines)


def refuse_truths(
    given: Mapping[str, Any], taken: BaseModel, *, source: str | None = None, prefix: str = ""
) -> None:
    """Refuse yes and no where a number is meant; pydantic takes them for 1 and 0.

    Parameters
    ----------
    given : mapping
        What the settings say.
    taken : BaseModel
        What pydantic made of it.
    source, prefix : str
        Where it was read from, and the dotted key of all of it, for messages.

    Raises
    ------
    SettingsError
        One line for each.
    """
    head = "" if source is None else f"{source}: "
    keys = [".".join([*([prefix] if prefix else []), *key]) for key in _truths(given, taken)]
    if keys:
        raise SettingsError("\n".join(f"{head}{key}: give a number, not yes or no" for key in keys))


def _truths(given: Any, taken: Any) -> Iterator[tuple[str, ...]]:
    if isinstance(given, bool):
        if isinstance(taken, int | float) and not isinstance(taken, bool):
            yield ()
        return
    pairs: Iterable[tuple[str, Any, Any]] = ()
    if isinstance(given, Mapping) and isinstance(taken, BaseModel):
        pairs = ((str(k), v, getattr(taken, k, None)) for k, v in given.items())
    elif isinstance(given, list | tuple) and isinstance(taken, list | tuple):
        pairs = ((str(n), *both) for n, both in enumerate(zip(given, taken, strict=False)))
    for key, one, other in pairs:
        yield from ((key, *rest) for rest in _truths(one, other))


@contextmanager
def faults_of(source: str | None) -> Iterator[None]:
    """Name the file, where it is known, in faults of settings that are checked later on."""
    try:
        yield
    except SettingsError as error:
        if source is None:
            raise
        lines = [f"{source}: {line}" for line in str(error).splitlines()]
        raise SettingsError("\n".join(lines)) from None
