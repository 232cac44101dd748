# SPDX-License-Identifier: MIT
"""Echoes are made once, found again by what they depend on, and go on where they stopped."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from sononerf.echoes.store import EnsembleStore, SubtractedStore
from sononerf.errors import (
    IncompatibleError,
    InputError,
    LockedError,
    NumericalError,
    SettingsError,
)
from sononerf.head.directivity_files import write_sofa
from sononerf.head.front_end import compress
from sononerf.run.import_recordings import read_recordings
from sononerf.run.simulate import (
    background_path,
    echo_hash,
    open_or_simulate,
    simulate,
    store_path,
    write_waveforms,
)
from sononerf.scene.scene import load_scene
from sononerf.storage import lock
from tests.head.directivity.patterns import pair


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
        {"ears": {"receivers": [[0.0, 0.0, 0.0]]}},
        {"ears": {"directivity": "piston"}},
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


def test_a_directivity_counts_as_what_it_is_not_as_where_it_lies(tiny, tmp_path):
    first, second, third = (tmp_path / f"{name}.sofa" for name in "abc")
    write_sofa(first, pair())
    second.write_bytes(first.read_bytes())
    write_sofa(third, pair(beam=False))
    one, same, other = (
        hashed(tiny(ears={"directivity": "file", "file": str(path)}))
        for path in (first, second, third)
    )
    assert one == same
    assert one != other
    with pytest.raises(InputError, match="no such file"):
        hashed(tiny(ears={"directivity": "file", "file": str(tmp_path / "d.sofa")}))


def test_what_is_background_sounds_as_it_would_otherwise(tiny):
    settings = tiny()
    scene = load_scene(settings.scene.name, settings.scene.options)
    background = np.arange(len(scene.mesh.faces)) > 0
    assert echo_hash(settings, replace(scene, background=background)) == hashed(settings)


HEADER = "x,y,z,yaw,pitch,roll\n"
ROWS = [f"0.4,{0.01 * row},0.0,180,{row},0\n" for row in range(8)]


def test_a_path_counts_as_the_poses_it_holds(tiny, tmp_path):
    def of(name, rows, **changes):
        (tmp_path / name).write_text(HEADER + "".join(rows), encoding="utf-8")
        path = {"arrangement": "path", "path": str(tmp_path / name), **changes}
        return hashed(tiny(poses=path))

    base = of("a.csv", ROWS)
    assert of("b.csv", ROWS) == base
    assert of("b.csv", ROWS, count=99, radius=9.0) == base  # neither is of a path
    assert of("a.csv", [*ROWS[:-1], ROWS[-1].replace(",7,0", ",7,1")]) != base
    assert of("a.csv", [*ROWS[:-1], "0.41" + ROWS[-1][3:]]) != base
    assert of("a.csv", ROWS[::-1]) != base
    assert of("a.csv", ROWS, heldout=1) != base


def test_a_path_is_simulated_in_its_order(tiny, tmp_path):
    (tmp_path / "a.csv").write_text(HEADER + "".join(ROWS), encoding="utf-8")
    settings = tiny(poses={"arrangement": "path", "path": str(tmp_path / "a.csv")})
    store = simulate(settings, output=tmp_path / "store", workers=1)
    np.testing.assert_allclose(store.positions[:, 1], 0.01 * np.arange(8))
    assert np.bincount(store.split).tolist() == [4, 2, 2]
    assert min(store.read_pose(index).max() for index in range(8)) > 0


def test_where_the_store_lies(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = tiny(data={"store": None}, poses={"count": 2, "validation": 0, "heldout": 0})
    store = simulate(settings, workers=1)
    assert str(store.path) == f"data/sphere-{hashed(settings)[:12]}"
    scene = load_scene("sphere", settings.scene.options)
    assert store_path(tiny(data={"store": "there"}), scene, None).name == "there"
    assert store_path(tiny(data={"store": "there"}), scene, tmp_path / "here").name == "here"


def test_a_store_of_other_settings_is_refused(tiny, echoes):
    with pytest.raises(IncompatibleError, match="holds echoes of other settings"):
        simulate(tiny(simulation={"rays": 501}), output=echoes)


def content(store):
    files = sorted(path for path in store.path.rglob("*") if path.is_file())
    return {str(path.relative_to(store.path)): path.read_bytes() for path in files}


def test_the_same_command_mends_a_damaged_pose(tiny, echoes, tmp_path):
    shutil.copytree(echoes, tmp_path / "store")
    file = next((tmp_path / "store" / "spectrogram").glob("c.3.*"))
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    made = simulate(tiny(), output=tmp_path / "store", workers=1)
    assert made.damaged() == []
    assert content(made) == content(EnsembleStore.open(echoes))


def test_the_noise_floor_is_that_of_other_rays(echoes, tiny, tmp_path):
    store = EnsembleStore.open(echoes)
    train = max(float(store.read_pose(int(i)).max()) for i in store.indices("train"))
    assert store.attributes["reference"] == pytest.approx(train / 1000)
    coarse, fine = (  # the fewer rays, the fewer paths of later bounces do they find
        simulate(
            tiny(scene={"name": "three_spheres"}, simulation={"rays": rays}),
            output=tmp_path / f"with {rays}",
            workers=1,
        ).attributes["noise_floor_mae_db"]
        for rays in (3000, 30_000)
    )
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


def test_a_background_of_ones_own_is_taken_off(tiny, echoes, tmp_path):
    settings = tiny(data={"background": str(echoes)})
    assert background_path(settings) == echoes
    assert isinstance(open_or_simulate(settings).store, SubtractedStore)
    assert background_path(tiny()) is None
    assert not isinstance(open_or_simulate(tiny()).store, SubtractedStore)


SWEEP = {"kind": "linear", "duration": 3e-4, "frequency_start": 100e3, "frequency_end": 20e3}


def test_a_round_trip_through_wav_and_csv(tiny, tmp_path):
    settings = tiny(
        data={"store": None},
        call=SWEEP,
        noise={"snr_db": 40.0},
        spectrogram={"frequency_min": 20e3},
        simulation={"engine": "rays"},
    )
    direct = simulate(settings, output=tmp_path / "direct", workers=1)
    written = write_waveforms(settings, tmp_path / "wav")
    assert [path.name for path in written] == ["poses.csv", "import.yaml", "ping_0000.wav"]
    back = read_recordings(tmp_path / "wav", tmp_path / "back").store
    np.testing.assert_allclose(back.positions, direct.positions, atol=1e-12)
    np.testing.assert_allclose(back.rotations, direct.rotations, atol=1e-12)
    np.testing.assert_array_equal(back.split, direct.split)
    np.testing.assert_allclose(back.range, direct.range, rtol=1e-12)
    np.testing.assert_allclose(back.frequency, direct.frequency)
    reference = direct.attributes["reference"]
    assert back.attributes["reference"] == pytest.approx(reference, rel=1e-4)
    for index in range(len(direct)):
        one, two = (compress(store.read_pose(index), reference) for store in (direct, back))
        active = (one >= 3) | (two >= 3)
        assert active.any()
        assert np.abs(one - two)[active].max() < 1.0  # dB
    known = ("air", "ears", "call", "spectrogram")
    assert all(
        back.attributes["settings"][name] == direct.attributes["settings"][name] for name in known
    )


def test_a_folder_with_files_is_left_alone(tiny, tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty"):
        write_waveforms(tiny(), tmp_path)


def test_a_rate_that_wav_cannot_hold_is_told(tiny, tmp_path):
    settings = tiny(spectrogram={"sampling_rate": 1000000.5})
    with pytest.raises(SettingsError, match="a WAV file cannot hold"):
        write_waveforms(settings, tmp_path / "w")
