# SPDX-License-Identifier: MIT
"""The commands that README and guides show are ones that there are."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from sononerf.cli.app import complete
from sononerf.run.scenes import new_plugin
from sononerf.settings.loading import SCENES as GROUP
from sononerf.settings.loading import check_options, load, load_settings, registered

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDES = "\n".join(path.read_text(encoding="utf-8") for path in sorted(ROOT.glob("docs/*.md")))
SIMULATOR = (ROOT / "docs" / "simulator.md").read_text(encoding="utf-8")
SCENES = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")
OTHERS = {".", "tensorboard", "pip", "pytest", "git", "cd", "dask", "diff", "printf"}
"""Programs of others."""


def blocks(kind, text=TEXT + GUIDES):
    return re.findall(rf"^```{kind}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def commands():
    lines = "\n".join(blocks("sh")).replace("\\\n", " ").splitlines()
    found = [shlex.split(line, comments=True) for line in lines]
    return [words for words in found if words]


def shown():
    """Return the settings files that the guides show, by the name in their first line."""
    found = (text.partition("\n") for text in blocks("yaml", GUIDES))
    return {first.removeprefix("# "): rest for first, _, rest in found}


def targets():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    lines = re.findall(r"^([\w -]+):", makefile, re.MULTILINE)
    return {name for line in lines for name in line.split()}


def parse(words):
    """Let the command line read a command without running it; return its parameters."""
    group = typer.main.get_command(complete())
    name, *arguments = words
    assert name in group.commands, f"no command {name}"
    return group.commands[name].make_context(name, arguments).params


def test_two_commands_come_first():
    assert [words[:2] for words in commands()[:2]] == [["make", "demo"], ["make", "test"]]


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_a_command_exists(words, tmp_path):
    program, *arguments = words
    if program == "make":
        assert set(arguments) <= targets()
    elif program == "sononerf":
        parameters = parse(arguments)
        config = parameters.get("config")
        if config is not None:
            path = config
            if str(config) in shown():
                path = tmp_path / config
                path.write_text(shown()[str(config)], encoding="utf-8")
            elif config.suffix == ".yaml":
                path = ROOT / config
            load_settings(path, parameters["overrides"] or ())
    elif program == "python" and arguments[0] == "-c":
        compile(arguments[1], "command", "exec")
    elif program == "python" and arguments[0] == "-m":
        assert arguments[1] in OTHERS
    elif program == "python":
        assert (ROOT / arguments[0]).is_file()
    else:
        assert program in OTHERS


def test_the_files_and_scenes_it_names_are_there():
    for path in set(re.findall(r"(?:configs|docs)/[\w/]+\.\w+", TEXT)):
        assert (ROOT / path).is_file(), path


@pytest.mark.slow
@pytest.mark.parametrize("code", blocks("python", SIMULATOR))
def test_the_code_of_the_guides_runs(code):
    names = {}
    exec(compile(code, "guide", "exec"), names)
    assert names["waveform"].any()
    assert names["magnitude"].shape == (2, len(names["simulator"].head.range), 47)


def test_the_guide_shows_the_scene_that_is_written(tmp_path):
    project, module, _ = new_plugin("scene", "round-bar", tmp_path / "round-bar")
    assert blocks("toml", SCENES) == [project.read_text(encoding="utf-8")]
    assert blocks("python", SCENES) == [module.read_text(encoding="utf-8")]


def test_the_guide_knows_the_options_of_a_mesh():
    table = SCENES.partition("| option |")[2].partition("\n\n")[0]
    made = check_options(load(GROUP, "mesh"), {"path": "x"}, where="scene.options")
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == list(made)


def test_the_scene_of_a_file_is_there():
    assert {"mesh"} <= {plugin.name for plugin in registered(GROUP)}
