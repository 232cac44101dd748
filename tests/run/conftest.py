# SPDX-License-Identifier: MIT
"""An experiment that takes less than a second, and its echoes."""

from __future__ import annotations

import functools
import shutil

import pytest

from sononerf import callbacks
from sononerf.head import head as head_module
from sononerf.run import reconstruct as reconstruct_module
from sononerf.run.fit import fit
from sononerf.run.simulate import simulate
from sononerf.settings.loading import validate_settings
from tests.small_views import draw_small

TINY = {
    "scene": {"name": "sphere", "options": {"radius": 0.02}},
    "poses": {"count": 8, "validation": 2, "heldout": 2},
    "simulation": {"rays": 500, "sources": 60, "noise_floor_poses": 1},
    "spectrogram": {"range_min": 0.34, "range_max": 0.45},
    "field": {"options": {"finest": 0.01, "levels": 2}},
    # Lattices are sampled, pruned and refined within few steps, so that all of a fit's state moves.
    "renderer": {"options": {"prune_every": 3, "points": 30, "start": 50, "prune_below": 0.3}},
    "fit": {"epochs": 3, "steps_per_epoch": 4, "batch_poses": 2, "batch_frequencies": 2},
    "preview": {"voxels": 8},
    "reconstruction": {"refine": False},
}


def _settings(store=None, **sections):
    data = {name: {**TINY.get(name, {}), **values} for name, values in sections.items()}
    where = {} if store is None else {"data": {"store": str(store)}}
    for name, values in where.items():
        data[name] = {**values, **data.get(name, {})}
    return validate_settings({**TINY, **data}, "tiny")


@pytest.fixture(scope="session")
def echoes(tmp_path_factory):
    """The store of the tiny experiment."""
    path = tmp_path_factory.mktemp("echoes") / "store"
    simulate(_settings(), output=path, workers=1)
    return path


@pytest.fixture(scope="session")
def tiny_settings(echoes):
    """Settings of the tiny experiment, section by section with changes."""
    return lambda **sections: _settings(echoes, **sections)


@pytest.fixture
def tiny(tiny_settings):
    """The same under a short name."""
    return tiny_settings


@pytest.fixture(scope="module")
def without_pictures():
    """Spectrograms and ears take most of a tiny fit and have tests of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(head_module, "analysed_ears", functools.cache(head_module.analysed_ears))
        patch.setattr(callbacks, "writer_of", lambda trainer: None)
        yield


@pytest.fixture(scope="session")
def fitted_run(tiny_settings, tmp_path_factory):
    """The tiny experiment, fitted; for reading alone."""
    path = tmp_path_factory.mktemp("fitted") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callbacks, "writer_of", lambda trainer: None)
        fit(tiny_settings(), path, accelerator="cpu", workers=1)
    return path


@pytest.fixture(scope="session")
def fitted(tiny_settings, tmp_path_factory):
    """The tiny experiment with a longer fit; for reading alone."""
    path = tmp_path_factory.mktemp("fitted") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callbacks, "writer_of", lambda trainer: None)
        fit(tiny_settings(fit={"epochs": 10}), path, accelerator="cpu", workers=1)
    return path


@pytest.fixture
def run(fitted, tmp_path):
    """A copy of a fitted run, to write into."""
    path = tmp_path / "elsewhere"
    path.mkdir()
    for name in ("model.safetensors", "model.json"):
        shutil.copy(fitted / name, path)
    return path


@pytest.fixture(autouse=True)
def small_views(monkeypatch):
    """Views of meshes are drawn with few pixels; their full size has tests of its own."""
    draw_small(monkeypatch)


@pytest.fixture
def no_projections(monkeypatch):
    """Projections take most of a tiny read-out."""
    monkeypatch.setattr(reconstruct_module, "mip_pictures", lambda volume: {})
