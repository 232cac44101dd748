# SPDX-License-Identifier: MIT
import pytest

from sononerf.errors import SettingsError
from sononerf.settings.call_presets import CALL_PRESETS
from sononerf.settings.loading import dump_yaml, load_settings, validate_settings
from sononerf.settings.schema import CallSettings


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
