# SPDX-License-Identifier: MIT
"""Settings become objects, and wrong ones are refused before anything expensive."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.field.fields import FourierField, GridField
from sononerf.field.module import EchoModule
from sononerf.field.profile import ProfileRenderer
from sononerf.field.renderer import ShellRenderer
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.refinement.objective import HUBER_SCALE
from sononerf.refinement.optics import Optics
from sononerf.refinement.refine import Refinement
from sononerf.run.build import module_for, read_truth, true_mesh, with_store
from sononerf.run.fit import finish, fit
from sononerf.run.simulate import head_of, simulate
from sononerf.settings.loading import load_settings, validate_settings
from sononerf.settings.schema import HEAD_SECTIONS
from tests.memory import echoes_of

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
BOX = torch.tensor([[-0.05] * 3, [0.05] * 3])


def region_of(settings, echoes):
    """Return the region of a fit, and what is possible in it."""
    lower, upper = settings.region.lower, settings.region.upper
    region = None if lower is None else (lower, upper)
    options = {"field_options": settings.field.options}
    module = EchoModule.for_echoes(echoes, region=region, **options)
    return module.field.region, module.possible


@pytest.mark.parametrize(
    ("field", "renderer", "kinds"),
    [
        ("grid", "profile", (GridField, ProfileRenderer)),
        ("fourier", "shell", (FourierField, ShellRenderer)),
    ],
)
def test_any_field_with_any_renderer(tiny, field, renderer, kinds):
    settings = tiny(
        field={"kind": field, "options": {}}, renderer={"kind": renderer, "options": {}}
    )
    module = module_for(settings, head_of(settings), BOX, 1e-3)
    assert (type(module.field), type(module.renderer)) == kinds
    assert module.learning_rate == module.field.learning_rate


def test_the_hull_of_a_sphere_holds_it_and_little_more(tiny, echoes):
    """The front of a sphere is its nearest point."""
    hull = Echoes(EnsembleStore.open(echoes), head_of(tiny())).hull
    assert hull.first.shape == (8, 2)
    front = hull.clearance(0.02 * hull.sources / np.linalg.norm(hull.sources, axis=1)[:, None])[0]
    # Beam and ears lengthen an echo, so it rises a little earlier, which is the safe side.
    assert (front > -0.0001).all()
    assert (front < 0.1 * head_of(tiny()).resolution).all()
    assert (hull.clearance(0.0199 * fibonacci_sphere(200))[0] > 0).all()
    assert (hull.clearance(0.021 * hull.sources / 0.4)[0] < 0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"field": {"kind": "gird", "options": {}}}, "unknown field 'gird'; did you mean grid"),
        ({"renderer": {"kind": "shel", "options": {}}}, "unknown renderer 'shel'"),
        ({"field": {"options": {"level": 2}}}, r"field\.options\.level: .*did you mean levels"),
        ({"renderer": {"options": {"points": 0}}}, r"renderer\.options\.points: found 0"),
        # As of one who thinks in millimetres.
        ({"field": {"options": {"spacing": 4}}}, r"field\.options\.spacing: found 4; .*0\.1"),
        ({"field": {"options": {"finest": 4}}}, r"field\.options\.finest: found 4; .*0\.1"),
        ({"field": {"options": {"coarsest": 20}}}, r"field\.options\.coarsest: found 20; .*0\.1"),
        ({"field": {"kind": "hash"}}, "field 'hash' was removed in version 0.2.0; take grid"),
        (
            {"field": {"options": {"finest": 0.03}}},
            r"field\.options\.finest: found 0\.03; must not lie above coarsest, 0\.02$",
        ),
        ({"fit": {"silent_share": 0.2}}, r"fit\.silent_share: found 0\.2, .*'profile' takes whole"),
    ],
)
def test_wrong_kinds_and_options_are_refused(tiny, changes, message):
    with pytest.raises(SettingsError, match=f"^tiny: {message}"):
        module_for(tiny(**changes), head_of(tiny(**changes)), None, 1.0)


def test_the_region_comes_from_the_echoes_or_from_the_settings(tiny, echoes):
    heard = Echoes(EnsembleStore.open(echoes), head_of(tiny()))
    region, possible = region_of(tiny(), heard)
    assert bool((region[0] < -0.015).all())
    assert bool((region[1] > 0.015).all())  # the sphere's radius is 20 mm
    assert bool((region.abs() < 0.2).all())
    places = region[0] + torch.rand(500, 3) * (region[1] - region[0])
    found = possible(places, 0.001)
    assert found.shape == (500,)
    assert 0 < int(found.sum()) < 500
    box = tiny(region={"lower": (-0.1, -0.1, -0.1), "upper": (0.1, 0.2, 0.3)})
    chosen, _ = region_of(box, heard)
    torch.testing.assert_close(chosen[1], torch.tensor([0.1, 0.2, 0.3]))


@pytest.mark.slow
def test_the_region_and_the_hull_are_found_in_noise(tiny, tmp_path):
    """The noise of all lies above the zero of the reported decibels, 3, 23 and 33 dB."""
    poses = {"count": 24, "validation": 0, "heldout": 0}

    def heard(name, **noise):
        settings = tiny(poses=poses, noise=noise, data={"store": str(tmp_path / name)})
        store = simulate(settings, workers=1)
        found = Echoes(store, head_of(settings))
        return region_of(settings, found)[0], found.hull

    box, _ = heard("plain")
    for snr_db, error in ((40, 0.001), (20, 0.002), (10, 0.003)):
        found, hull = heard(f"at {snr_db} dB", snr_db=snr_db)
        torch.testing.assert_close(found, box, rtol=0, atol=0.010)
        both = hull.first[(hull.weight > 0).all(axis=1)].mean(axis=1)
        late = both - (np.linalg.norm(hull.sources, axis=1) - 0.02)[(hull.weight > 0).all(axis=1)]
        assert len(late) > 20
        assert np.abs(late).max() < error


@pytest.mark.parametrize("config", ["sweep", "recorded", "three_spheres"])
def test_renderer_and_refinement_have_the_range_resolution_of_the_head(config):
    head = head_of(load_settings(CONFIGS / f"{config}.yaml"))
    hull = EchoHull(
        emitters=np.zeros((1, 3)),
        receivers=np.zeros((1, 1, 3)),
        first=np.full((1, 1), 0.4),
        axes=np.array([[1.0, 0.0, 0.0]]),
        within=0.5,
    )
    work = Refinement(
        {"given": trimesh.creation.icosphere()},
        echoes_of(head, np.zeros((1, 3)), np.eye(3)[None], None, [0], hull),
        Optics(head),
        simulate=lambda mesh: None,
        seed=0,
    )
    assert work.onsets.scale == HUBER_SCALE * head.resolution
    assert ProfileRenderer(BOX, head, surroundings=1.0).surroundings == head.resolution


def test_a_file_comes_before_the_scene(tiny, tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.export(tmp_path / "true.ply")
    assert true_mesh(tiny()).extents == pytest.approx([0.04] * 3)
    given = tiny(evaluation={"truth": str(tmp_path / "true.ply")})
    assert true_mesh(given).extents == pytest.approx([0.1, 0.2, 0.3])


def test_without_scene_and_file_there_is_no_truth(tiny, echoes):
    assert true_mesh(tiny().model_copy(update={"scene": None})) is None


def test_a_scene_whose_file_has_moved_is_told(tiny, tmp_path, caplog):
    file = tmp_path / "mug.stl"
    trimesh.creation.box((0.1, 0.2, 0.3)).export(file)
    settings = tiny(scene={"name": "mesh", "options": {"path": str(file), "unit": "m"}})
    assert true_mesh(settings) is not None
    file.unlink()
    assert true_mesh(settings) is None
    assert "the true surface is unknown: " in caplog.text
    assert str(file) in caplog.text
    assert "evaluation.truth=FILE" in caplog.text


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("true.txt", b"x", "evaluation.truth: .*not a file that ends in .stl"),
        ("true.ply", b"ply\nnonsense", "evaluation.truth: .*damaged PLY"),
        ("true.obj", b"# nothing\n", "evaluation.truth: "),
        (None, b"", "evaluation.truth: .*No such file"),
    ],
)
def test_a_bad_true_surface_is_refused_in_one_line(tmp_path, name, content, says):
    path = tmp_path / (name or "missing.ply")
    if name:
        path.write_bytes(content)
    with pytest.raises(InputError, match=says) as raised:
        read_truth(path)
    assert "\n" not in str(raised.value)


@pytest.fixture
def alone(tiny_settings, echoes):
    """Settings of the tiny experiment that name nothing but the store."""

    def settings(**sections):
        plain = tiny_settings().plain()
        kept = {
            k: v
            for k, v in plain.items()
            if k not in (*HEAD_SECTIONS, "scene", "poses", "simulation")
        }
        for name, values in sections.items():
            kept[name] = {**kept.get(name, {}), **values}
        return validate_settings(kept, "alone")

    return settings


def test_settings_without_a_scene_take_the_store_s(alone, tiny_settings):
    found = with_store(alone())
    for section in HEAD_SECTIONS:
        assert getattr(found, section) == getattr(tiny_settings(), section)
    assert found.scene is None


def test_settings_with_a_scene_are_left_alone(tiny_settings):
    assert with_store(tiny_settings()) == tiny_settings()


def test_what_contradicts_the_store_is_refused_and_what_agrees_is_not(alone):
    assert with_store(alone(spectrogram={"range_min": 0.34}))
    with pytest.raises(IncompatibleError, match=r"air\.temperature_c: found 30") as raised:
        with_store(alone(air={"temperature_c": 30.0}))
    assert "\n" not in str(raised.value)
    wider = with_store(alone(spectrogram={"dynamic_range_db": 50.0}))
    assert wider.spectrogram.dynamic_range_db == 50.0


@pytest.mark.slow
def test_a_fit_of_a_store_needs_no_scene(alone, tmp_path):
    run = tmp_path / "run"
    fit(alone(), run, accelerator="cpu")
    metrics = finish(run, accelerator="cpu")
    assert metrics["prediction"]["poses"] == 2
    assert metrics["geometry"] is None
    assert (run / "reconstruction" / "mesh.ply").is_file()
    again = fit(alone(evaluation={"registration": "rigid"}), run, accelerator="cpu")
    assert again.is_done("fit")


def test_an_unfinished_or_silent_store_is_refused(alone, echoes, tmp_path):
    copy = tmp_path / "store"
    shutil.copytree(echoes, copy)
    EnsembleStore.open(copy)._chunk(3).unlink()
    with pytest.raises(InputError, match="1 poses are missing"):
        fit(alone(data={"store": str(copy)}), tmp_path / "run", accelerator="cpu")
    EnsembleStore.open(echoes)
    bare = tmp_path / "bare"
    store = EnsembleStore.create(
        bare,
        positions=np.zeros((1, 3)),
        rotations=np.eye(3)[None],
        split=[0],
        range=[0.1, 0.2],
        frequency=[1e4],
        attributes={},
    )
    assert store.receivers == 2
    with pytest.raises(InputError, match="does not state its head"):
        with_store(alone(data={"store": str(bare)}))


def test_neither_scene_nor_store_is_a_fault_of_the_settings(alone):
    with pytest.raises(SettingsError, match=r"set scene\.name, or data\.store"):
        alone(data={"store": None})
    with pytest.raises(SettingsError, match=r"scene: missing; set scene\.name"):
        simulate(alone())


def test_a_run_of_a_store_knows_its_settings(alone, tmp_path):
    run = tmp_path / "run"
    fit(alone(), run, accelerator="cpu")
    saved = json.loads((run / "model.json").read_text())["settings"]
    assert saved["scene"] is None
    assert saved["spectrogram"]["range_max"] == 0.45
