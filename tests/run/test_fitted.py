# SPDX-License-Identifier: MIT
"""A fitted run is what its two files say, and its poses are those of its ensemble."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, ResourceError
from sononerf.field.checkpoint_io import load_weights, save_weights
from sononerf.field.fitting import render_poses
from sononerf.progress import Progress
from sononerf.run.build import head_of
from sononerf.run.fit import fit
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


def test_the_hull_is_of_the_training_poses_alone(run, echoes):
    hull = Run(run).hull
    store = EnsembleStore.open(echoes)
    train = store.indices("train")
    assert hull.emitters.dtype == hull.first.dtype == np.float64
    # A head is some centimetres large.
    np.testing.assert_allclose(hull.emitters, store.positions[train], atol=0.03)
    np.testing.assert_allclose(hull.receivers.mean(axis=1), store.positions[train], atol=0.03)
    np.testing.assert_allclose(hull.axes, store.rotations[train][:, :, 0], atol=1e-6)
    assert hull.first.shape == (len(train), 2)
    assert type(hull.within) is float
    assert -1 <= hull.within <= 1


HULL = ["hull.emitters", "hull.receivers", "hull.first", "hull.axes", "hull.within"]


@pytest.mark.parametrize("name", [*HULL, "field.region"])
def test_weights_without_what_is_needed_are_told(run, name):
    state, description = load_weights(run)
    del state[name]
    save_weights(run, state, description)
    with pytest.raises(InputError, match=rf"incomplete \('{name}'\); repeat the fit") as caught:
        open_run(run)
    assert "\n" not in str(caught.value)
    assert "model.json" not in str(caught.value)  # which is whole


def test_what_is_loaded_knows_what_first_echoes_leave(run, echoes, tiny):
    """An ear that heard nothing goes with the weights like all others."""
    hull = Echoes(EnsembleStore.open(echoes), head_of(tiny())).hull
    state, description = load_weights(run)
    state["hull.first"][3, 1] = -torch.inf
    save_weights(run, state, description)
    loaded = Run(run).hull
    assert loaded.within == hull.within
    assert isinstance(loaded.within, float)
    for name in ("emitters", "receivers", "axes"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(hull, name))
    assert loaded.first[3, 1] == -np.inf
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))
    heard = hull.first.copy()
    heard[3, 1] = -np.inf
    expected = dataclasses.replace(hull, first=heard).clearance(points)
    np.testing.assert_array_equal(loaded.clearance(points), expected)


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


def test_damaged_or_missing_weights_are_told(run, tmp_path):
    data = bytearray((run / "model.safetensors").read_bytes())
    data[-5] ^= 1
    (run / "model.safetensors").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        open_run(run)
    with pytest.raises(InputError, match="no fitted run"):
        open_run(tmp_path / "nowhere")


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


def test_rendering_does_not_look_at_what_was_measured(run, monkeypatch):
    fitted = Run(run)
    poses = fitted.echoes.poses("val")
    rendered = render_poses(fitted.model, poses, accelerator="cpu", progress=QUIET)
    read = EnsembleStore.read_pose
    monkeypatch.setattr(EnsembleStore, "read_pose", lambda *given: 0 * read(*given))
    again = fitted.echoes.poses("val")
    deaf = render_poses(fitted.model, again, accelerator="cpu", progress=QUIET)
    np.testing.assert_array_equal(deaf, rendered)


def test_a_gpu_that_is_not_there_or_apples(run, monkeypatch):
    fitted = Run(run)
    poses = fitted.echoes.poses("val")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    with pytest.raises(ResourceError):
        render_poses(fitted.model, poses, accelerator="gpu", progress=QUIET)


def test_what_was_fitted_without_its_background_is_measured_without_it(run, tiny, echoes, tmp_path):
    """The surroundings are the tiny echoes themselves, at half their magnitude."""
    heard = EnsembleStore.open(echoes)
    alone = EnsembleStore.create(
        tmp_path / "alone",
        poses_positions=heard.positions,
        poses_rotations=heard.rotations,
        split=heard.split,
        range=heard.range,
        frequency=heard.frequency,
        attributes=heard.attributes,
    )
    for index in range(len(heard)):
        alone.write_pose(index, 0.5 * heard.read_pose(index))
    fitted = Run(run)
    settings = tiny(data={"background": str(tmp_path / "alone")})
    without = Run(run)
    without.__dict__["_model"] = dataclasses.replace(fitted._model, settings=settings)
    store = without.echoes.store
    np.testing.assert_allclose(
        store.read_pose(1), np.sqrt(0.75) * heard.read_pose(1), rtol=1e-5, atol=1e-9
    )
    assert type(fitted.echoes.store) is EnsembleStore
    path = tmp_path / "fitted"
    fit(settings, path)
    reference = Run(path).model.reference
    assert reference == pytest.approx(np.sqrt(0.75) * heard.attributes["reference"], rel=1e-5)
    with pytest.raises(IncompatibleError, match=r"data\.background"):
        fit(tiny(), path)


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
