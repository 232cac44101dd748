# SPDX-License-Identifier: MIT
"""Every settings file that we ship loads, round-trips and builds."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import torch

from sononerf.run.build import module_for
from sononerf.run.simulate import head_of
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import dump_yaml, load_settings, read_yaml, validate_settings

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
FILES = sorted(CONFIGS.rglob("*.yaml"))
BOX = torch.tensor([[-0.05] * 3, [0.05] * 3])


def named(path):
    return str(path.relative_to(CONFIGS))


def leaves(data):
    for key, value in data.items():
        if isinstance(value, dict) and value:
            yield from ((f"{key}.{name}", leaf) for name, leaf in leaves(value))
        else:
            yield key, value


def test_there_are_some():
    assert {"smoke.yaml", "sweep.yaml", "three_spheres.yaml", "paper/three_spheres.yaml"} <= {
        named(path) for path in FILES
    }
    assert [path.name for path in CONFIGS.rglob("*.yml")] == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_it_loads_and_round_trips(path, tmp_path):
    settings = load_settings(path)
    (tmp_path / "whole.yaml").write_text(dump_yaml(settings))
    assert load_settings(tmp_path / "whole.yaml") == settings
    assert dump_yaml(load_settings(tmp_path / "whole.yaml")) == dump_yaml(settings)


@pytest.mark.parametrize("path", [path for path in FILES if path.parent == CONFIGS], ids=named)
def test_it_says_only_what_differs_from_the_defaults(path):
    settings = read_yaml(path)
    defaults = validate_settings({"scene": {"name": settings["scene"]["name"]}}, "defaults")
    same = dict(leaves(defaults.plain()))
    same.pop("scene.name")
    assert [key for key, value in leaves(settings) if key in same and same[key] == value] == []


@pytest.mark.parametrize("path", FILES, ids=named)
def test_its_scene_field_and_renderer_build(path):
    settings = load_settings(path)
    assert len(load_scene(settings.scene.name, settings.scene.options).mesh.faces) > 0
    module = module_for(settings, head_of(settings), BOX, 1.0)
    assert sum(parameter.numel() for parameter in module.field.parameters()) > 0
    assert module.renderer.whole_poses == (settings.renderer.kind != "shell")


PAPER = CONFIGS / "paper" / "three_spheres.yaml"


def test_the_papers_training_is_the_papers():
    settings = load_settings(PAPER)
    fit_settings = settings.fit
    assert (settings.field.kind, settings.renderer.kind) == ("fourier", "shell")
    assert settings.renderer.options["directions"] == 600
    assert (fit_settings.epochs, fit_settings.batch_slices) == (100, 512)
    assert (fit_settings.learning_rate, fit_settings.loss) == (0.01, "l2")
    assert (fit_settings.schedule, fit_settings.staircase_factor) == ("staircase", 0.97)
    assert fit_settings.staircase_epochs == 10


def test_the_options_for_the_published_code_are_known():
    page = (CONFIGS.parent / "docs" / "paper.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    told = [found for row in rows for found in re.findall(r"`([^`]+=[^`]+)`", row)]
    assert len(told) > 10
    for options in told:
        settings = load_settings(PAPER, shlex.split(options.replace("NUMBER", "20000")))
        module_for(settings, head_of(settings), None, 1.0)
        assert settings != load_settings(PAPER), options


def test_the_papers_scenes_differ_in_scene_and_poses_alone():
    settings = {path.stem: read_yaml(path) for path in PAPER.parent.glob("*.yaml")}
    own = {name: (data.pop("scene"), data.pop("poses", {})) for name, data in settings.items()}
    assert own == {
        "three_spheres": ({"name": "three_spheres"}, {}),
        "three_spheres_100": ({"name": "three_spheres"}, {"count": 100}),
        "ua": ({"name": "ua"}, {}),
        "leaf": ({"name": "leaf"}, {}),
        "leaf_dragonfly": ({"name": "leaf_dragonfly"}, {}),
    }
    assert all(data == settings["three_spheres"] for data in settings.values())
