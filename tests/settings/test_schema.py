# SPDX-License-Identifier: MIT
"""Settings: every fault in one line that says where, what was found, and a way out."""

from __future__ import annotations

from pathlib import Path

import pytest

from sononerf.errors import SettingsError
from sononerf.settings import loading
from sononerf.settings.loading import (
    apply_override,
    dump_yaml,
    load_settings,
    read_import_settings,
    read_yaml,
    validate_settings,
)
from sononerf.settings.schema import CallSettings, Settings
from sononerf.settings.sections import CALL_PRESETS

SCENE = "scene: {name: sphere}\n"


@pytest.fixture
def write(tmp_path):
    def writer(text, name="a.yaml"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return writer


def faults(path, *overrides):
    with pytest.raises(SettingsError) as caught:
        load_settings(path, overrides)
    return str(caught.value).splitlines()


def test_defaults_of_the_design(write):
    settings = load_settings(write(SCENE))
    assert (settings.poses.count, settings.poses.validation, settings.poses.heldout) == (
        400,
        10,
        20,
    )
    assert (settings.poses.radius, settings.poses.aim_jitter_deg) == (0.4, 15.0)
    assert (settings.field.kind, settings.renderer.kind) == ("grid", "profile")
    assert settings.fit.steps_per_epoch == "auto"
    assert settings.prediction.traced == "auto"


def test_precedence(write):
    path = write(SCENE + "fit: {epochs: 3, seed: 1}\n")
    settings = load_settings(path, ["fit.seed=2", "fit.seed=4"])
    assert (settings.fit.epochs, settings.fit.seed) == (3, 4)


def test_a_shipped_file_is_found_by_its_name_wherever_one_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_settings(Path("three_spheres")).scene.name == "three_spheres"
    paper = load_settings(Path("paper/three_spheres"), ["fit.epochs=2"])
    assert (paper.field.kind, paper.fit.epochs) == ("fourier", 2)
    assert faults(Path("three_sphere")) == [
        "three_sphere: no such settings file; did you mean three_spheres?"
    ]
    assert "shipped are kettle, neural, " in faults(Path("mine"))[0]


def test_a_file_of_the_users_goes_before_a_shipped_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("ua").write_text("scene: {name: torus}\n")
    assert load_settings(Path("ua")).scene.name == "torus"


def test_assignments_need_no_file():
    settings = load_settings(Path("scene.name=sphere"), ["scene.options.radius=0.02"])
    assert (settings.scene.name, settings.scene.options) == ("sphere", {"radius": 0.02})
    assert any("command line: scene.nam: unknown key" in f for f in faults(Path("scene.nam=a")))


def test_what_is_dumped_reads_back(write):
    settings = load_settings(
        write(SCENE), ["fit.learning_rate=3e-3", "region.lower=[0,0,0]", "region.upper=[1,1,1]"]
    )
    assert load_settings(write(loading.dump_yaml(settings), "b.yaml")) == settings
    assert Settings.model_validate(settings.plain()) == settings


def test_settings_know_their_file_and_are_the_same_from_another(write):
    first, second = load_settings(write(SCENE, "a.yaml")), load_settings(write(SCENE, "b.yaml"))
    assert first.source.endswith("a.yaml")
    assert second.source.endswith("b.yaml")
    assert first == second
    assert first != load_settings(write(SCENE, "b.yaml"), ["fit.epochs=3"])
    assert "source" not in first.plain()
    assert Settings.model_validate(first.plain()).source is None


def test_later_faults_name_the_file():
    with pytest.raises(SettingsError) as caught, loading.faults_of("mine.yaml"):
        raise SettingsError("one\ntwo")
    assert str(caught.value) == "mine.yaml: one\nmine.yaml: two"
    with pytest.raises(SettingsError, match=r"^one$"), loading.faults_of(None):
        raise SettingsError("one")


def test_off_is_a_word_and_no_truth_value(write):
    path = write(SCENE + "prediction: {traced: off}\n")
    settings = load_settings(path)
    assert settings.prediction.traced == "off"
    assert load_settings(write(SCENE, "b.yaml"), ["prediction.traced=off"]) == settings
    assert load_settings(write(loading.dump_yaml(settings), "c.yaml")) == settings


def test_settings_do_not_change(write):
    with pytest.raises(ValueError, match="frozen"):
        load_settings(write(SCENE)).fit.epochs = 2


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("fit.epoch=3", ["fit.epoch: unknown key", "did you mean epochs?"]),
        ("fits.epochs=3", ["fits: unknown key", "did you mean fit?"]),
        ("fit.zzz=3", ["fit.zzz: unknown key", "known here: epochs"]),
        ("fit.epochs=0", ["fit.epochs: found 0", "greater than or equal to 1"]),
        ("fit.epochs=true", ["fit.epochs: give a number, not yes or no"]),
        ("poses.axis=[0, true, 0]", ["poses.axis.1: give a number, not yes or no"]),
        ("ears.directivity=file", ["ears: the directivity file needs ears.file"]),
        ("ears.file=a.sofa", ["file is of the directivity file, not of ear"]),
        ("ears.directivity=cardioid", ["ears.directivity: found 'cardioid'"]),
        ("ears.receivers=[]", ["ears.receivers"]),
        ("ears.receivers=[[0, 1]]", ["ears.receivers.0: found [0, 1]; give 3 values"]),
        ("ears.piston_radius=0", ["ears.piston_radius: found 0"]),
        ("ears.left=[0, 1]", ["ears.left: found [0, 1]; give 3 values"]),
        ("fit.epochs=many", ["fit.epochs: found 'many'"]),
        ("fit.loss=l3", ["fit.loss: found 'l3'", "'l1', 'l2' or 'l1_4l2'"]),
        ("poses.radius=.inf", ["poses.radius: found"]),
        ("poses.radius=-1", ["poses.radius: found -1"]),
        ("scene.name=", ["scene.name: found None"]),
        ("reconstruction.level=high", ["reconstruction.level: found 'high'"]),
        (
            "reconstruction.method=oriented",
            ["reconstruction.method: found 'oriented'", "'levels' or 'isosurface'"],
        ),
        (
            "reconstruction.spacing=2",
            ["reconstruction.spacing: found 2", "less than or equal to 0.1"],
        ),
        ("fit.batch_frequencies=some", ["fit.batch_frequencies: found 'some'"]),
        ("spectrogram.range_min=2", ["spectrogram: range_min must lie below range_max"]),
        ("spectrogram.fft=32", ["spectrogram: fft must be at least window"]),
        ("region.lower=[0,0,0]", ["region: lower and upper are set together"]),
        ("ears.left=[1,2]", ["ears.left"]),
        (
            "call.kind=chirp",
            ["call.kind: found 'chirp'", "'impulse', 'linear', 'hyperbolic' or 'file'"],
        ),
        ("call.kind=file", ["call: kind file needs file, the WAV of one call"]),
        ("call.file=a.wav", ["call: file is of the kind file, not of impulse"]),
        ("call.preset=airsa", ["call: preset: found 'airsa'; did you mean airsas?"]),
        ("spectrogram.kind=cochlea", ["'stft' or 'gammatone'"]),
        ("spectrogram.q=0.5", ["spectrogram.q: found 0.5", "greater than or equal to 1"]),
        ("call.duration=3", ["call.duration: found 3", "less than or equal to 0.1"]),
        ("call.frequency_end=150000", ["call: frequency_start and frequency_end must differ"]),
        ("call.harmonics=[0, 0]", ["call: one of the harmonics at least must be above 0"]),
        ("call.harmonics=[1, -1]", ["call.harmonics.1: found -1"]),
        ("noise.snr_db=loud", ["noise.snr_db: found 'loud'"]),
        ("noise.snr_db=[1, 2, 3]", ["noise.snr_db"]),
        ("noise.snr=3", ["noise.snr: unknown key", "did you mean snr_db?"]),
        ("prediction.traced=on", ["prediction.traced: found 'on'", "'auto' or 'off'"]),
        ("prediction.trace=off", ["prediction.trace: unknown key", "did you mean traced?"]),
    ],
)
def test_a_wrong_value_is_told_with_file_key_and_way_out(write, key, words):
    path = write(SCENE)
    lines = faults(path, key)
    for word in words:
        assert any(word in line for line in lines), lines
    assert all(line.startswith(f"{path}: ") for line in lines)


@pytest.mark.parametrize(
    ("assignments", "words"),
    [
        (
            ["call.harmonics=[1, 0, 0, 0.1]"],
            "call: harmonic 4 reaches 600000 Hz, above half of spectrogram.sampling_rate (500000",
        ),
        (["spectrogram.sampling_rate=250e3"], "call: harmonic 1 reaches 150000 Hz"),
        (
            [
                "call.frequency_start=200e3",
                "call.frequency_end=120e3",
                "spectrogram.frequency_max=100e3",
            ],
            "call: sweeps 120000 to 200000 Hz, all outside spectrogram.frequency_min",
        ),
    ],
)
def test_a_call_that_cannot_be_sampled_or_heard_is_refused(write, assignments, words):
    path = write(SCENE)
    (line,) = faults(path, "call.kind=linear", *assignments)
    assert line.startswith(f"{path}: {words}")
    load_settings(path, assignments)  # an impulse has no frequencies


def test_a_call_may_reach_half_the_sampling_rate_and_noise_be_set_per_ear(write):
    settings = load_settings(
        write(SCENE),
        [
            "call.kind=hyperbolic",
            "call.frequency_start=250e3",
            "call.harmonics=[0.5, 1]",
            "noise.snr_db=[20, 3.5]",
        ],
    )
    assert settings.call.bands == {1: (40e3, 250e3), 2: (80e3, 500e3)}
    assert settings.noise.snr_db == (20.0, 3.5)
    assert Settings.model_validate(settings.plain()) == settings


@pytest.mark.parametrize("key", ["fit.batch_frequencies", "reconstruction.level", "fit.max_steps"])
def test_a_choice_of_types_is_told_under_its_own_key(write, key):
    path = write(SCENE)
    for line in faults(path, f"{key}=high"):
        assert line.startswith(f"{path}: {key}: found 'high'")


def test_one_line_per_fault(write):
    lines = faults(write("fit: {epochs: 0, epoch: 1}\npose: 3\n"))
    assert len(lines) == 3  # epochs, epoch, pose


def test_without_scene_and_store_there_are_no_echoes(write):
    (line,) = faults(write("fit: {epochs: 3}\n"))
    assert "scene: missing; set scene.name, or data.store" in line
    assert load_settings(write("data: {store: somewhere}\n")).scene is None


@pytest.mark.parametrize("key", ["fit", "=3", "fit..epochs=3", "fit.=1"])
def test_what_is_no_assignment(key):
    with pytest.raises(SettingsError, match="expected KEY=VALUE"):
        apply_override({}, key)


def test_an_assignment_through_a_value():
    with pytest.raises(SettingsError, match="epochs is a value, not a section"):
        apply_override({"fit": {"epochs": 3}}, "fit.epochs.x=1")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-3", 0.003),
        ("010", 10),
        ("12:30", "12:30"),
        ("on", "on"),
        ("1_000", 1000),
        ("true", True),
        ("~", None),
        ("-.5", -0.5),
    ],
)
def test_yaml_reads_numbers_as_people_write_them(text, value):
    data = {}
    apply_override(data, f"a={text}")
    assert data == {"a": value}
    assert type(data["a"]) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2\n", 'duplicate key "a"'),
        ("a: [\n", r"a\.yaml:2:1"),
        ("a: &x [1]\nb: *x\n", "aliases are not accepted"),
        ("- 1\n", "holds list"),
        (b"\xff\xfe\x00", "UTF-8"),
        ("a: " + "x" * 1_000_001, "larger than"),
        ("a: !!python/object/apply:os.system [ls]\n", "could not determine a constructor"),
        ("a: b: c\n", "not allowed here"),
    ],
)
def test_what_is_no_settings_file(write, text, message):
    with pytest.raises(SettingsError, match=message):
        read_yaml(write(text))


def test_an_empty_file_is_empty_settings(write):
    assert read_yaml(write("")) == {}
    assert read_yaml(write(b"\xef\xbb\xbfa: 1\n")) == {"a": 1}


def test_a_missing_file_suggests_its_neighbour(write, tmp_path):
    write(SCENE, "three_spheres.yaml")
    with pytest.raises(SettingsError, match=r"did you mean .*three_spheres\.yaml"):
        read_yaml(tmp_path / "three_sphere.yaml")
    with pytest.raises(SettingsError, match=r"no such settings file$"):
        read_yaml(tmp_path / "none" / "a.yaml")
    with pytest.raises(SettingsError, match="cannot be read"):
        read_yaml(tmp_path)


def test_a_source_is_named_for_plain_data_too():
    with pytest.raises(SettingsError, match=r"^RUN/config\.yaml: scene: missing"):
        validate_settings({}, "RUN/config.yaml")


def test_another_scene_does_not_inherit_the_options_of_the_files_scene(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("scene:\n  name: sphere\n  options:\n    radius: 0.02\n", encoding="utf-8")
    other = load_settings(path, ["scene.options.path=b.stl", "scene.name=mesh"])
    assert other.scene.options == {"path": "b.stl"}
    same = load_settings(path, ["scene.name=sphere"])
    assert same.scene.options == {"radius": 0.02}


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        ("arrangement: cap", "the arrangement cap needs half_angle_deg"),
        ("arrangement: volume", "the arrangement volume needs radius_max"),
        ("arrangement: path", "the arrangement path needs path"),
        ("arrangement: cylinder", "the arrangement cylinder needs heights"),
        ("heights: [0, 1]", "heights is of the arrangement cylinder, not of sphere"),
        ("{arrangement: cylinder, heights: [1, 0]}", "heights must be the lowest and the highest"),
        ("path: a.csv", "path is of the arrangement path, not of sphere"),
        ("half_angle_deg: 9", "half_angle_deg is of the arrangement cap or volume, not of sphere"),
        (
            "{arrangement: cap, half_angle_deg: 9, radius_max: 1}",
            "radius_max is of the arrangement volume, not of cap",
        ),
        ("{arrangement: volume, radius_max: 0.4}", "radius must lie below radius_max"),
        ("axis: [0, 0, 0]", "axis gives no direction"),
    ],
)
def test_poses_of_an_arrangement_say_what_it_needs_and_nothing_else(write, poses, said):
    (line,) = faults(write(SCENE + f"poses: {poses if poses[0] == '{' else '{' + poses + '}'}\n"))
    assert f": poses: {said}" in line


def test_only_an_isosurface_has_a_level(write):
    (line,) = faults(write(SCENE + "reconstruction: {level: 0.4}\n"))
    assert ": reconstruction: level is of the method isosurface, not of levels" in line
    settings = load_settings(write(SCENE + "reconstruction: {level: 0.4, method: isosurface}\n"))
    assert settings.reconstruction.level == 0.4


def test_only_an_isosurface_is_smoothed(write):
    (line,) = faults(write(SCENE + "reconstruction: {smoothing: 0.045}\n"))
    assert ": reconstruction: smoothing is of the method isosurface, not of levels" in line
    settings = load_settings(
        write(SCENE + "reconstruction: {smoothing: 0.045, method: isosurface}\n")
    )
    assert settings.reconstruction.smoothing == 0.045


def settings(**call):
    return validate_settings({"scene": {"name": "sphere"}, "call": call}, "test")


@pytest.mark.parametrize("name", CALL_PRESETS)
def test_a_preset_fills_the_section_with_what_its_source_says(name):
    preset = CALL_PRESETS[name]
    call = settings(preset=name).call
    for key, value in preset.keys.items():
        assert getattr(call, key) == value
    assert set(preset.keys) <= set(CallSettings.model_fields) - {"preset"}
    assert preset.keys["kind"] in ("linear", "hyperbolic")
    assert any(year in preset.source for year in map(str, range(1960, 2027)))


def test_what_is_set_beside_a_preset_wins():
    call = settings(preset="eptesicus_fuscus", duration=1e-3, harmonics=[1.0]).call
    assert (call.duration, call.harmonics) == (1e-3, (1.0,))
    assert (call.frequency_start, call.frequency_end) == (75e3, 33e3)


def test_resolved_settings_are_read_back_as_they_are(tmp_path):
    first = settings(preset="airsas", taper=0.3)
    (tmp_path / "a.yaml").write_text(dump_yaml(first))
    assert load_settings(tmp_path / "a.yaml") == first


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("eptesicus", "did you mean eptesicus_fuscus?"),
        ("zzz", "known here: eptesicus_fuscus, phyllops"),
        (3, "preset: found 3"),
        (["airsas"], "preset: found"),
    ],
)
def test_an_unknown_preset_is_refused(name, words):
    with pytest.raises(SettingsError) as caught:
        settings(preset=name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


MIRROR = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]


def test_units_have_no_default():
    settings = read_import_settings({}, "a.yaml")
    assert (settings.length, settings.angle, settings.quaternion) == (None, None, None)


def test_what_belongs_together_is_taken():
    settings = read_import_settings(
        {"frame": "own", "axes": MIRROR, "length": "mm", "channels": [0, [1, 2]]}, "a.yaml"
    )
    assert settings.axes == ((1, 0, 0), (0, -1, 0), (0, 0, 1))
    assert settings.channels == (0, (1, 2))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"lenght": "mm"}, "import.lenght: unknown key; did you mean length?"),
        ({"length": "inch"}, "import.length"),
        ({"frame": "own"}, "axes and frame=own go together"),
        ({"axes": MIRROR}, "axes and frame=own go together"),
        ({"head_axes": MIRROR}, "head_axes is of frame=own"),
        ({"turntable": {}}, "import.turntable.radius: missing"),
        ({"channels": [-1]}, "import.channels"),
        ("poses.csv", "expected `key: value` lines"),
    ],
)
def test_a_fault_is_one_line(given, words):
    with pytest.raises(SettingsError) as caught:
        read_import_settings(given, "a.yaml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("a.yaml: ")
