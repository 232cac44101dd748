# SPDX-License-Identifier: MIT
"""Settings files, ``KEY=VALUE`` and plugins, each checked at the door.

A plugin is imported only when its name is used, so a broken one affects nothing else.
"""

from __future__ import annotations

import difflib
import importlib.resources
import inspect
import io
import json
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, create_model
from pydantic.errors import PydanticUserError
from pydantic_core import to_jsonable_python
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

from sononerf.errors import InputError, SettingsError, SonoNerfError
from sononerf.resources import memory_faults
from sononerf.settings.schema import Settings
from sononerf.settings.sections import ImportSettings
from sononerf.storage import require_regular

SCENES = "sononerf.scenes"
FIELDS = "sononerf.fields"
RENDERERS = "sononerf.renderers"
REMOVED = {("field", "hash"): "take grid, or the plugin in docs/extending.md, A hash grid"}
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
        if (kind, name) in REMOVED:
            raise SettingsError(
                f"{kind} {name!r} was removed in version 0.2.0; {REMOVED[kind, name]}"
            )
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
    reject_booleans(options, checked, prefix=where)
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


MAX_SETTINGS_BYTES = 1_000_000
SectionT = TypeVar("SectionT", bound=BaseModel)
PLUGIN_NAMES = (("scene", "name"), ("field", "kind"), ("renderer", "kind"))
"""Keys whose value determines the options beside them."""


def _parse_yaml(text: str, where: str) -> Any:
    """Return the plain data of a YAML 1.2 text; duplicate keys and aliases are errors."""
    parser = YAML(typ="safe", pure=True)
    try:
        if any(isinstance(event, AliasEvent) for event in parser.parse(text)):
            raise SettingsError(f"{where}: YAML aliases are not accepted; write the value out")
        return parser.load(text)
    except RecursionError:
        raise SettingsError(f"{where}: nested too deeply") from None
    except (YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{where}:{mark.line + 1}:{mark.column + 1}" if mark else where
        problem = getattr(error, "problem", None) or "is no YAML"
        raise SettingsError(f"{place}: {problem}") from None


def read_yaml(path: Path) -> dict[str, Any]:
    """Read one settings file as plain data."""
    try:
        require_regular(path)
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
    """Set one dotted ``KEY=VALUE`` in ``data``, in place."""
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


def assignments(sections: Mapping[str, Any]) -> list[str]:
    """Return sections of settings, a dictionary of dictionaries, as ``KEY=VALUE`` assignments."""
    lines = []
    for section, keys in sections.items():
        if not isinstance(keys, Mapping):
            raise SettingsError(f"{section}: found {keys!r}, expected a dictionary of its keys")
        for key, value in keys.items():
            try:
                text = json.dumps(str(value) if isinstance(value, Path) else value)
            except (TypeError, ValueError):
                raise SettingsError(
                    f"{section}.{key}: found {value!r}, expected numbers, texts and lists"
                ) from None
            lines.append(f"{section}.{key}={text}")
    return lines


def _drop_options_of_another(data: dict[str, Any], assignment: str) -> None:
    """Leave out the file's options where the command line names another scene than the file."""
    key, _, value = assignment.partition("=")
    section, _, name = key.strip().partition(".")
    if (section, name) not in PLUGIN_NAMES or not isinstance(data.get(section), dict):
        return
    if data[section].get(name) != value.strip():
        data[section].pop("options", None)


def validate_settings(data: Mapping[str, Any], source: str) -> Settings:
    """Check plain data against the settings."""
    try:
        settings = Settings.model_validate(dict(data))
    except ValidationError as error:
        raise SettingsError(describe_faults(error, Settings, source)) from None
    reject_booleans(data, settings, source=source)
    settings.__dict__["source"] = source
    return settings


def checked_section(
    model: type[SectionT], given: SectionT | Mapping[str, Any], where: str
) -> SectionT:
    """Return a section of the settings from plain data; one that is checked already stays."""
    if isinstance(given, model):
        return given
    if not isinstance(given, Mapping):
        raise SettingsError(f"{where}: found {type(given).__name__}, expected keys and values")
    try:
        section = model.model_validate(dict(given))
    except ValidationError as error:
        raise SettingsError(describe_faults(error, model, None, where)) from None
    reject_booleans(given, section, prefix=where)
    return section


def shipped_configs() -> dict[str, Path]:
    """Return the settings files that come with the package, by name: ``ua``, ``paper/ua`` ..."""
    folder = Path(str(importlib.resources.files("sononerf_configs")))
    files = sorted(folder.rglob("*.yaml"))
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}


def _settings_file(config: Path) -> Path:
    """Return the file of a path, or of the name of a shipped one."""
    name = config.as_posix()
    if config.suffix or config.is_file():
        return config
    shipped = shipped_configs()
    if name not in shipped:
        near = difflib.get_close_matches(name, shipped, n=1)
        hint = f"did you mean {near[0]}?" if near else f"shipped are {', '.join(shipped)}"
        raise SettingsError(f"{name}: no such settings file; {hint}")
    return shipped[name]


def load_settings(config: Path, overrides: Iterable[str] = ()) -> Settings:
    """Read a settings file and lay ``KEY=VALUE`` assignments over it.

    An assignment that names another scene, field or renderer than the file does takes the file's
    options for the old one away.
    """
    overrides = list(overrides)
    if is_assignment(config):
        overrides.insert(0, str(config))
        data, source = dict[str, Any](), "command line"
    else:
        file = _settings_file(config)
        data, source = read_yaml(file), str(file)
    for assignment in overrides:
        _drop_options_of_another(data, assignment)
    for assignment in overrides:
        apply_override(data, assignment)
    return validate_settings(data, source)


def is_assignment(config: Path) -> bool:
    """True if a settings file is in fact an assignment ``KEY=VALUE``."""
    return "=" in str(config) and not config.is_file()


def dump_yaml(settings: Settings) -> str:
    """Return the settings, whole, as YAML text that :func:`load_settings` reads back."""
    return to_yaml(settings.plain())


def to_yaml(data: dict[str, Any]) -> str:
    """Return plain data as YAML text."""
    text = io.StringIO()
    dumper: Any = YAML(typ="safe", pure=True)
    dumper.default_flow_style, dumper.sort_base_mapping_type_on_output = False, False
    dumper.dump(data, text)
    return text.getvalue()


def _model_at(model: type[BaseModel], path: Iterable[str | int]) -> type[BaseModel] | None:
    for part in path:
        if isinstance(part, int):  # in a list of models, each of them
            continue
        info = model.model_fields.get(part)
        annotation = info.annotation if info else None
        if typing.get_origin(annotation) is list:
            annotation = typing.get_args(annotation)[0]
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return None
        model = annotation
    return model


def describe_faults(
    error: ValidationError, model: type[BaseModel], source: str | None, prefix: str = ""
) -> str:
    """Turn pydantic's faults into one line each: source, dotted key, fault, remedy."""
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
            # There is one fault for each missing value of a list; the last one has the length.
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


def reject_booleans(
    given: Mapping[str, Any], taken: BaseModel, *, source: str | None = None, prefix: str = ""
) -> None:
    """Refuse yes and no where a number is meant; pydantic takes them for 1 and 0."""
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


def read_import_settings(data: Mapping[str, Any], where: str) -> ImportSettings:
    """Check the section ``import`` of a settings file."""
    if not isinstance(data, Mapping):
        raise SettingsError(f"{where}: import: holds {data!r}, expected `key: value` lines")
    try:
        return ImportSettings.model_validate(dict(data))
    except ValidationError as error:
        text = describe_faults(error, ImportSettings, where, prefix="import")
        raise SettingsError(text) from None
