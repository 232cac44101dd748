# SPDX-License-Identifier: MIT
"""The manual, built by Sphinx; pages of commands and settings are made from the program itself.

python -m sphinx -W -b html docs docs/_build
"""

from __future__ import annotations

import inspect
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any, get_args

import typer
from docutils import nodes
from docutils.utils.math import latex2mathml
from pydantic.fields import FieldInfo
from typer.cli import get_docs_for_click

from sononerf import __version__
from sononerf.cli.app import complete
from sononerf.settings.schema import Settings
from sononerf.settings.sections import ImportSettings, Section

sys.path.insert(0, str(Path(__file__).parent))
import house

project = "sononerf"
author = "The sononerf developers"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"sononerf {version}"
html_copy_source = False
html_show_copyright = False
html_math_renderer = "mathml"
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "attrs_inline"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_custom_sections = [("Returns", "params_style")]  # of several names
toc_object_entries = False


def commands() -> str:
    """Return the page of all commands, in Markdown."""
    command = typer.main.get_command(complete())
    context = typer.Context(command)
    page = get_docs_for_click(obj=command, ctx=context, name="sononerf")
    page = page.partition("## `")[1] + page.partition("## `")[2]
    # Markdown would take <hash> in a help text for a tag; options in backticks keep theirs.
    return re.sub(r"(?m)(?<=: )[^`\n]*$", lambda text: text[0].replace("<", "&lt;"), page)


def settings() -> str:
    """Return a table of each section of the settings file, in Markdown."""
    models = {name: _model(field.annotation) for name, field in Settings.model_fields.items()}
    return "\n".join(_section(*each) for each in {**models, "import": ImportSettings}.items())


def _model(annotation: Any) -> type[Section]:
    return next(kind for kind in (annotation, *get_args(annotation)) if inspect.isclass(kind))


def _section(name: str, model: type[Section]) -> str:
    source = inspect.getsource(model)
    lines = [f"## `{name}`", "", inspect.getdoc(model).replace("``", "`"), ""]
    lines += ["| key | default | allowed | unit and note |", "|---|---|---|---|"]
    described = model.model_json_schema()["properties"]
    for key, field in model.model_fields.items():
        key = field.alias or key
        note = re.search(rf"^    {key}: .*?#\s*(.*)$", source, re.MULTILINE)
        default = _plain(field)
        allowed = " or ".join(dict.fromkeys(_allowed(described.get(key, {}))))
        lines.append(f"| `{key}` | {default} | {allowed} | {note[1] if note else ''} |")
    return "\n".join([*lines, ""])


def _plain(field: FieldInfo) -> str:
    """Return the default of a key as Markdown."""
    if field.is_required():
        return "required"
    if field.default_factory_takes_validated_data:
        return "follows from other keys"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, Section):
        return "see its own section"
    return "not set" if value is None else f"`{value}`".replace("|", "\\|")


def _allowed(schema: dict) -> list[str]:
    """Return what a JSON schema allows, one text for each alternative."""
    if "anyOf" in schema:
        return [text for part in schema["anyOf"] for text in _allowed(part)]
    if "enum" in schema or "const" in schema:
        return [", ".join(f"`{one}`" for one in schema.get("enum", [schema.get("const")]))]
    kind = schema.get("type", "")
    if kind == "null":
        return []
    words = {"array": "list", "object": "section", "string": "text", "boolean": "true or false"}
    if kind not in ("number", "integer"):
        return [words.get(kind, "section")]
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [f"{sign} {schema[word]:,}" for word, sign in signs.items() if word in schema]
    return [" ".join([kind, ", ".join(limits)]).strip()]


def _formula(translator: Any, node: Any, *, display: bool) -> None:
    """Write a formula as MathML: browsers know it, and nothing is loaded from the network."""
    made = "".join(latex2mathml.tex2mathml(node.astext(), as_block=display))
    translator.body.append(f'<div class="formula">{made}</div>' if display else made)
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Let pages name what is made from the program: ``{{ commands }}`` and ``{{ settings }}``."""
    house.write()
    inline, block = partial(_formula, display=False), partial(_formula, display=True)
    app.add_html_math_renderer("mathml", (inline, None), (block, None))

    def fill(_: object, __: str, source: list[str]) -> None:
        for name, make in {"{{ commands }}": commands, "{{ settings }}": settings}.items():
            if name in source[0]:
                source[0] = source[0].replace(name, make())

    app.connect("source-read", fill)
