# SPDX-License-Identifier: MIT
"""The list of scenes: a broken one says so and hurts no other."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from sononerf.data.store import EnsembleStore
from sononerf.experiment.scenes import describe_scenes, draw_ensemble, draw_scenes


def test_every_scene_says_where_it_is_from_and_what_it_takes(plugin):
    rows = {row["name"]: row for row in describe_scenes()}
    assert {"sphere", "three_spheres", "ua", "mesh", "fixture_bar"} <= rows.keys()
    assert rows["sphere"]["distribution"] == "sononerf"
    assert rows["sphere"]["summary"].startswith("Build a sphere")
    assert rows["sphere"]["options"] == ["radius", "material"]
    assert (rows["fixture_bar"]["distribution"], rows["fixture_bar"]["version"]) == (
        "sononerf-fixture",
        "1.0",
    )
    assert rows["fixture_bar"]["options"] == ["length", "radius"]
    assert not any(row["broken"] for row in rows.values())


@pytest.fixture
def broken(tmp_path, monkeypatch):
    info = tmp_path / "broken-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text("[sononerf.scenes]\nbroken = no_such_module:make\n")
    monkeypatch.syspath_prepend(tmp_path)


def test_a_broken_scene_is_listed_as_broken(broken):
    rows = {row["name"]: row for row in describe_scenes()}
    assert rows["broken"]["broken"]
    assert "no_such_module" in rows["broken"]["summary"]
    assert not rows["sphere"]["broken"]


def size_of(path):
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        image.load()
        return image.size


def test_scenes_are_drawn_but_those_that_cannot_be(broken, tmp_path, monkeypatch):
    names = {"sphere", "broken", "mesh"}
    from sononerf.experiment import scenes as scenes_module

    listed = [plugin for plugin in scenes_module.list_scenes() if plugin.name in names]
    monkeypatch.setattr(scenes_module, "list_scenes", lambda: listed)
    written = draw_scenes(tmp_path / "pictures")
    assert [path.name for path in written] == ["sphere.png"]
    assert min(size_of(written[0])) > 100


def test_an_ensemble_is_drawn_with_the_echo_of_its_first_test_pose(
    tiny, echoes, tmp_path, monkeypatch
):
    from sononerf.experiment import scenes as scenes_module

    drawn = {}
    real = scenes_module.echo_png

    def keep(*given, **named):
        drawn.update(points=given[1], level=given[2], position=given[3], named=named)
        return real(*given, **named)

    monkeypatch.setattr(scenes_module, "echo_png", keep)
    store = EnsembleStore.open(echoes)
    written = draw_ensemble(tiny(), store, tmp_path)
    assert [path.name for path in written] == ["scene.png", "pose_0010.png"]
    assert all(min(size_of(path)) > 100 for path in written)
    assert store.split[10] == 2
    assert drawn["named"]["title"] == "sphere, pose 10"
    # The loudest hit of a sphere is where its surface faces the head.
    loudest = drawn["points"][np.argmax(drawn["level"])]
    towards = drawn["position"] / np.linalg.norm(drawn["position"])
    assert np.degrees(np.arccos(loudest @ towards / 0.02)) < 15
