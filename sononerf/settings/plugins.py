# SPDX-License-Identifier: MIT
"""Entry points: scenes, fields and renderers, ours and everyone's, through one door.

A plugin is imported only when its name is used, so a broken one affects nothing else.
"""

from __future__ import annotations

import difflib
import inspect
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, create_model
from pydantic.errors import PydanticUserError
from pydantic_core import to_jsonable_python

from sononerf.errors import InputError, SettingsError, SonoNerfError
from sononerf.memory import memory_faults
from sononerf.settings.loading import describe_faults, refuse_truths

SCENES = "sononerf.scenes"
FIELDS = "sononerf.fields"
RENDERERS = "sononerf.renderers"
GONE = {("field", "hash"): "take grid, or the plugin in docs/extending.md, A hash grid"}
"""What to use instead of built-in plugins that were removed."""


@dataclass(frozen=True)
class Plugin:
    """One registered name with its origin, not yet imported."""

    name: str
    distribution: str
    version: str
    entry_point: EntryPoint


def registered(group: str) -> list[Plugin]:
    """Return the registered plugins of a group, sorted by name; imports nothing."""
    plugins: dict[tuple[str, str, str], Plugin] = {}
    for entry in entry_points(group=group):
        distribution = entry.dist.name if entry.dist else "unknown"
        version = entry.dist.version if entry.dist else "unknown"
        # An editable install may be listed twice on sys.path; the same claim counts once.
        plugins[entry.name, distribution, entry.value] = Plugin(
            entry.name, distribution, version, entry
        )
    return sorted(plugins.values(), key=lambda plugin: (plugin.name, plugin.distribution))


def load(group: str, name: str) -> Callable[..., Any]:
    """Import one plugin by its name."""
    kind = group.rpartition(".")[2].removesuffix("s")
    plugins = registered(group)
    claims = [plugin for plugin in plugins if plugin.name == name]
    if not claims:
        if (kind, name) in GONE:
            raise SettingsError(f"{kind} {name!r} was removed in version 0.2.0; {GONE[kind, name]}")
        names = sorted({plugin.name for plugin in plugins})
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise SettingsError(f"unknown {kind} {name!r}; {hint}there are: {', '.join(names)}")
    if len(claims) > 1:
        owners = " and ".join(f"{plugin.distribution} {plugin.version}" for plugin in claims)
        raise SettingsError(
            f"{kind} {name!r} is claimed by {owners}; uninstall one, or rename its entry point"
        )
    plugin = claims[0]
    owner = f"{kind} {name!r} of {plugin.distribution} {plugin.version}"
    try:
        factory = plugin.entry_point.load()
    except (Exception, SystemExit) as error:
        raise InputError(
            f"{owner} cannot be loaded: {type(error).__name__}: {error}; mend or uninstall it"
        ) from error
    if not callable(factory):
        raise InputError(f"{owner} is {type(factory).__name__}, expected a function or class")
    return typing.cast(Callable[..., Any], factory)


def call(owner: str, factory: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """Call a plugin's factory."""
    try:
        with memory_faults():
            return factory(*given, **options)
    except SonoNerfError:
        raise  # has its own message of one line
    except (Exception, SystemExit) as error:
        text = " ".join(str(error).split())
        raise InputError(f"{owner} failed: {type(error).__name__}: {text}") from error


def check_options(
    factory: Callable[..., Any], options: Mapping[str, Any], *, where: str, given: int = 0
) -> dict[str, Any]:
    """Check options against a factory's keyword arguments and fill in its defaults."""
    model = _options_model(factory, where, given)
    try:
        checked = model.model_validate(dict(options))
    except ValidationError as error:
        raise SettingsError(describe_faults(error, model, None, where)) from None
    refuse_truths(options, checked, prefix=where)
    return {name: getattr(checked, name) for name in model.model_fields}


def describe_options(factory: Callable[..., Any], *, given: int = 0) -> list[dict[str, Any]]:
    """Return the options of a factory: its keyword arguments."""
    rows = []
    for name, field in _options_model(factory, "options", given).model_fields.items():
        needed = field.is_required()
        default = None if needed else to_jsonable_python(field.default, fallback=str)
        kind: Any = (
            Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
        )
        try:
            schema = TypeAdapter(kind).json_schema()
        except PydanticUserError:  # a type of the plugin's own, which has no schema
            schema = {}
        rows.append(
            {"name": name, "default": default, "needed": needed, "allowed": _allowed(schema)}
        )
    return rows


NUMBERS = {"number": "a number", "integer": "a whole number"}
KINDS = {
    **NUMBERS, "string": "text", "boolean": "true or false", "null": "none", "object": "a section",
}  # fmt: skip


def _allowed(schema: Mapping[str, Any]) -> str:
    """Put a JSON schema into words."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(_allowed(part) for part in schema["anyOf"]))
    if "enum" in schema or "const" in schema:
        return ", ".join(str(value) for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        count = schema.get("minItems")
        fixed = count is not None and count == schema.get("maxItems")
        each = _allowed((schema.get("prefixItems") or [schema.get("items") or {}])[0])
        return f"{count} of: {each}" if fixed else f"a list of: {each}"
    kind = "a section" if "$ref" in schema else KINDS.get(str(schema.get("type")), "see the source")
    if schema.get("type") not in NUMBERS:
        return kind
    least, most = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    bounds = (("from", least), ("above", above), ("to", most), ("below", below))
    return " ".join([kind, *(f"{word} {bound}" for word, bound in bounds if bound is not None)])


def _options_model(factory: Callable[..., Any], where: str, given: int) -> type[BaseModel]:
    try:
        signature = inspect.signature(factory)
        target = factory.__init__ if inspect.isclass(factory) else factory
        hints = typing.get_type_hints(target, include_extras=True)
    except (TypeError, ValueError, NameError) as error:
        raise InputError(f"{where}: the factory's annotations cannot be read: {error}") from None
    fields: dict[str, Any] = {}
    parameters = list(signature.parameters.values())[given:]
    for parameter in parameters:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        default = ... if parameter.default is parameter.empty else parameter.default
        fields[parameter.name] = (hints.get(parameter.name, Any), default)
    config = ConfigDict(
        extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False, protected_namespaces=()
    )
    return create_model("Options", __config__=config, **fields)
