# SPDX-License-Identifier: MIT
"""Echoes are made once, found again by what they depend on, and go on where they stopped."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.data.store import EnsembleStore
from sononerf.errors import IncompatibleError, LockedError, NumericalError
from sononerf.experiment import simulate as simulate_module
from sononerf.experiment.simulate import echo_hash, simulate, store_path
from sononerf.scene import load_scene
from sononerf.storage import lock


def hashed(settings):
    return echo_hash(settings, load_scene(settings.scene.name, settings.scene.options))


def test_the_hash_covers_all_that_echoes_depend_on_and_nothing_else(tiny):
    base = hashed(tiny())
    for changed in (
        {"scene": {"options": {"radius": 0.021}}},
        {"poses": {"seed": 1}},
        {"poses": {"radius": 0.41}},
        {"simulation": {"rays": 501}},
        {"air": {"temperature_c": 20.0}},
        {"ears": {"azimuth_deg": 20.0}},
        {"spectrogram": {"range_max": 0.46}},
    ):
        assert hashed(tiny(**changed)) != base, changed
    for changed in (
        {"fit": {"epochs": 9}},
        {"field": {"options": {"levels": 1}}},
        {"data": {"store": "elsewhere"}},
        {"reconstruction": {"spacing": 0.01}},
    ):
        assert hashed(tiny(**changed)) == base, changed


def test_where_the_store_lies(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = tiny(data={"store": None}, poses={"count": 2, "validation": 0, "heldout": 0})
    store = simulate(settings, workers=1)
    assert str(store.path) == f"data/sphere-{hashed(settings)[:12]}"
    scene = load_scene("sphere", settings.scene.options)
    assert store_path(tiny(data={"store": "there"}), scene, None).name == "there"
    assert store_path(tiny(data={"store": "there"}), scene, tmp_path / "here").name == "here"


def test_a_whole_store_is_opened_and_nothing_is_simulated(tiny, echoes, monkeypatch):
    monkeypatch.setattr(simulate_module, "Simulator", None)
    store = simulate(tiny())
    assert store.path == echoes
    assert store.mode == "r"


def test_a_store_of_other_settings_is_refused(tiny, echoes):
    with pytest.raises(IncompatibleError, match="holds echoes of other settings"):
        simulate(tiny(simulation={"rays": 501}), output=echoes)


def test_an_interrupted_simulation_goes_on(tiny, echoes, tmp_path, monkeypatch):
    real = EnsembleStore.write_pose
    written = []

    def cut(self, index, spectrogram):
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(index)
        real(self, index, spectrogram)

    with monkeypatch.context() as patch:
        patch.setattr(EnsembleStore, "write_pose", cut)
        with pytest.raises(KeyboardInterrupt):
            simulate(tiny(), output=tmp_path / "store", workers=1)

    def count(self, index, spectrogram):
        assert index not in written
        real(self, index, spectrogram)

    monkeypatch.setattr(EnsembleStore, "write_pose", count)
    store = simulate(tiny(), output=tmp_path / "store", workers=1)
    whole = EnsembleStore.open(echoes)
    assert store.missing() == []
    for index in range(len(whole)):
        np.testing.assert_array_equal(store.read_pose(index), whole.read_pose(index))
    for name in ("reference", "noise_floor_mae_db", "echo_hash"):
        assert store.attributes[name] == whole.attributes[name]


def test_the_noise_floor_is_that_of_other_rays(echoes, tiny, tmp_path):
    store = EnsembleStore.open(echoes)
    train = max(float(store.read_pose(int(i)).max()) for i in store.indices("train"))
    assert store.attributes["reference"] == pytest.approx(train / 1000)
    coarse = store.attributes["noise_floor_mae_db"]
    fine = simulate(
        tiny(simulation={"rays": 20_000}), output=tmp_path / "fine", workers=1
    ).attributes["noise_floor_mae_db"]
    assert 0 < fine < coarse / 2
    none = simulate(
        tiny(poses={"count": 2, "heldout": 0}), output=tmp_path / "none", workers=1
    ).attributes
    assert none["noise_floor_mae_db"] is None


@pytest.mark.parametrize("limits", [(1.0, 1.1), (0.1, 0.2)])
def test_range_limits_that_no_echo_reaches(tiny, tmp_path, limits):
    settings = tiny(spectrogram=dict(zip(("range_min", "range_max"), limits, strict=True)))
    with pytest.raises(NumericalError, match="no pose received an echo"):
        simulate(settings, output=tmp_path / "store")
    assert not (tmp_path / "store").exists()


def test_a_store_in_use_is_left_alone(tiny, tmp_path):
    with lock(tmp_path / "store"), pytest.raises(LockedError):
        simulate(tiny(), output=tmp_path / "store")
