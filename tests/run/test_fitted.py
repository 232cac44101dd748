# SPDX-License-Identifier: MIT
"""A fitted run is what its two files say, and its poses are those of its ensemble."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError
from sononerf.field.checkpoint_io import load_weights
from sononerf.field.fitting import render_poses
from sononerf.progress import Progress
from sononerf.run.build import true_mesh
from sononerf.run.run import Run, open_run
from sononerf.settings.loading import validate_settings

QUIET = Progress(quiet=True)

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture
def run(fitted_run, tmp_path):
    """The run with nothing but its two files, somewhere else."""
    path = tmp_path / "elsewhere"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted_run / name, path)
    return path


def change(path, **values):
    description = json.loads((path / "model.json").read_text())
    (path / "model.json").write_text(json.dumps({**description, **values}))


def test_what_is_loaded_is_what_was_fitted(run, tiny, echoes):
    found = Run(run)
    assert found.settings == tiny()
    attributes = EnsembleStore.open(echoes).attributes
    assert found.echo_hash == attributes["echo_hash"]
    assert found.model.reference == attributes["reference"]
    assert not found.model.training
    state, _ = load_weights(run)
    for part, prefix in ((found.model.field, "field."), (found.model.renderer, "renderer.")):
        own = part.state_dict()
        assert {f"{prefix}{name}" for name in own} == {n for n in state if n.startswith(prefix)}
        for name, tensor in own.items():
            assert torch.equal(tensor, state[prefix + name]), name


def damage(path, change):
    description = json.loads((path / "model.json").read_text())
    change(description)
    (path / "model.json").write_text(json.dumps(description))


def other_field(description):
    description["settings"]["field"] = {"kind": "fourier", "options": {}}


def unknown_key(description):
    description["settings"]["fit"]["speed"] = 3


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda d: d.pop("reference"), InputError, "incomplete"),
        (lambda d: d.pop("settings"), InputError, "incomplete"),
        (lambda d: d.update(reference="loud"), InputError, "incomplete"),
        (lambda d: d.update(reference=float("nan")), InputError, "reference is nan, expected"),
        (lambda d: d.update(reference=-1.0), InputError, r"model\.json: reference is -1\.0"),
        (lambda d: d.update(reference=float("inf")), InputError, "reference is inf"),
        (lambda d: d.update(reference=0), InputError, r"reference is 0\.0"),
        (lambda d: d.update(schema_version=99), IncompatibleError, "newer sononerf"),
        (other_field, IncompatibleError, "does not fit fourier and profile"),
        (unknown_key, IncompatibleError, r"settings of another version: .*fit\.speed"),
    ],
)
def test_a_wrong_description_is_told(run, change, error, message):
    damage(run, change)
    with pytest.raises(error, match=message) as caught:
        open_run(run)
    assert "\n" not in str(caught.value)


def test_the_ensemble_is_found_where_the_settings_or_its_hash_say(run, echoes, tmp_path):
    fitted = Run(run)
    assert fitted.echoes.store.path == echoes
    section = fitted.settings.data.model_dump()
    plain = {**fitted.settings.plain(), "data": {**section, "store": None}}
    change(run, settings=validate_settings(plain, "plain").plain())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        with pytest.raises(InputError, match=rf"sphere-{fitted.echo_hash[:8]}\w*: .*is not there"):
            _ = Run(run).echoes


def test_an_ensemble_of_other_echoes_is_refused(run):
    change(run, echo_hash="0" * 64)
    with pytest.raises(IncompatibleError, match="holds other echoes"):
        _ = Run(run).echoes


def test_rendering_goes_pose_by_pose_and_in_order(run):
    fitted = Run(run)
    poses = fitted.echoes.poses("train")[[4, 1, 6]]
    rendered = render_poses(fitted.model, poses, accelerator="cpu", progress=QUIET)
    assert rendered.dtype == np.float32
    assert rendered.shape == (3, 2, len(fitted.head.range), len(fitted.head.frequency))
    assert (rendered >= 0).all()
    for row in range(3):
        alone = poses[row]
        again = render_poses(fitted.model, alone, accelerator="cpu", progress=QUIET)
        np.testing.assert_array_equal(again[0], rendered[row])
    assert np.abs(rendered[0] - rendered[1]).max() > 0


def test_a_run_finds_its_store_from_another_working_folder(run, echoes, tmp_path, monkeypatch):
    home, other = tmp_path / "home", tmp_path / "other"
    shutil.copytree(echoes, home / "data" / "store")
    (other / "data" / "store").mkdir(parents=True)  # holds nothing
    plain = Run(run).settings.plain()
    change(run, settings={**plain, "data": {**plain["data"], "store": "data/store"}})
    shutil.copytree(run, home / "runs" / "one")
    monkeypatch.chdir(other)
    found = Run(Path("../home/runs/one")).echoes
    assert found.store.path.resolve() == home / "data" / "store"


def test_a_run_that_lies_elsewhere_finds_store_and_truth(run, echoes, tmp_path, monkeypatch):
    home = tmp_path / "home"
    shutil.copytree(echoes, home / "data" / "store")
    trimesh.creation.box().export(home / "true.ply")
    plain = Run(run).settings.plain()
    parts = {"data": {"store": "data/store"}, "evaluation": {"truth": "true.ply"}}
    change(run, settings={**plain, **{n: {**plain[n], **part} for n, part in parts.items()}})
    shutil.copytree(run, tmp_path / "runs" / "one")
    there = Run(tmp_path / "runs" / "one")
    monkeypatch.chdir(home)
    there.write_provenance()  # as the fit does in its working folder
    monkeypatch.chdir(tmp_path / "runs")
    found = Run(Path("one"))
    assert found.echoes.store.path.resolve() == home / "data" / "store"
    assert true_mesh(found.settings).volume == pytest.approx(1.0)


def test_a_store_of_other_echoes_does_not_hide_that_of_the_run(run, echoes, tmp_path, monkeypatch):
    home, other = tmp_path / "home", tmp_path / "other"
    for place in (home, other):
        shutil.copytree(echoes, place / "data" / "store")
    EnsembleStore.open(other / "data" / "store", mode="r+").update_attributes(echo_hash="another")
    plain = Run(run).settings.plain()
    change(run, settings={**plain, "data": {**plain["data"], "store": "data/store"}})
    shutil.copytree(run, home / "runs" / "one")
    monkeypatch.chdir(other)
    found = Run(Path("../home/runs/one")).echoes
    assert found.store.path.resolve() == home / "data" / "store"
