# SPDX-License-Identifier: MIT
"""Settings become objects, and wrong ones are refused before anything expensive."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sononerf import plugins
from sononerf.acoustics.reception import effective_window
from sononerf.data.store import EnsembleStore
from sononerf.errors import InputError, SettingsError
from sononerf.experiment import build
from sononerf.experiment.build import (
    acquisition,
    check_plugins,
    echo_region,
    field_and_renderer,
    heard_from,
    module_for,
)
from sononerf.field.fourier import FourierField
from sononerf.field.grid import GridField
from sononerf.field.hash import HashField
from sononerf.renderer.profile import ProfileRenderer
from sononerf.renderer.shell import ShellRenderer

BOX = torch.tensor([[-0.05] * 3, [0.05] * 3])


def test_the_acquisition_has_the_axes_of_the_store(tiny, echoes):
    store = EnsembleStore.open(echoes)
    known = acquisition(tiny())
    torch.testing.assert_close(known.range.double(), torch.as_tensor(store.range))
    torch.testing.assert_close(known.frequency.double(), torch.as_tensor(store.frequency))
    assert known.speed_of_sound == store.attributes["speed_of_sound"] == 343.0
    assert acquisition(tiny(air={"temperature_c": 0.0})).speed_of_sound == pytest.approx(
        331.3, abs=0.5
    )
    # dB per metre become nepers: 20 log10(e) dB are one.
    assert float(known.absorption[-1]) == pytest.approx(3.3 / 8.686, rel=0.3)  # at 100 kHz


def test_the_acquisition_of_a_sweep_is_told_how_long_and_how_late_its_rows_are(tiny):
    impulse = acquisition(tiny())
    assert impulse.lag is None
    torch.testing.assert_close(
        impulse.window, torch.hamming_window(64, periodic=False).expand(47, -1)
    )
    settings = tiny(call={"kind": "hyperbolic"}, spectrogram={"window": 120, "frequency_min": 45e3})
    known = acquisition(settings)
    window = effective_window(settings.call, settings.spectrogram)
    np.testing.assert_allclose(known.window, window, rtol=1e-6)
    assert known.window.shape[1] > 200
    assert known.lag.shape == known.ears.shape
    # 0.4 ms for 110 kHz are 0.6 mm per kHz: a few kHz off the middle of a row that a notch cuts.
    assert 0.5e-3 < float(known.lag.abs().amax()) < 30e-3
    assert not torch.equal(known.ears, acquisition(tiny(spectrogram={"window": 120})).ears[:, 18:])


@pytest.mark.parametrize(
    ("field", "renderer", "kinds"),
    [
        ("grid", "profile", (GridField, ProfileRenderer)),
        ("fourier", "shell", (FourierField, ShellRenderer)),
        ("hash", "profile", (HashField, ProfileRenderer)),
    ],
)
def test_any_field_with_any_renderer(tiny, field, renderer, kinds):
    settings = tiny(
        field={"kind": field, "options": {}}, renderer={"kind": renderer, "options": {}}
    )
    made = field_and_renderer(settings, BOX)
    assert tuple(type(each) for each in made) == kinds
    module = module_for(settings, *made, reference=1e-3, total_steps=7, steps_per_epoch=3)
    assert (module.total_steps, module.steps_per_epoch) == (7, 3)
    assert module.learning_rate == made[0].learning_rate


def test_the_module_is_told_what_is_heard_at_first(tiny):
    settings = tiny(fit={"early_range_db": 25.0, "early_share": 0.5})
    module = module_for(settings, *field_and_renderer(settings, BOX), reference=1.0, total_steps=8)
    whole = settings.spectrogram.dynamic_range_db
    assert [module.range_db(step) for step in (0, 3, 4)] == [25.0, 25.0, whole]


def test_training_poses_hear_from_half_way_between_emitter_and_ears():
    renderer = SimpleNamespace(
        emitter=torch.tensor([0.002, 0.0, -0.010]),
        ear_positions=torch.tensor([[-0.010, 0.010, 0.005], [-0.010, -0.004, 0.005]]),
    )
    left = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # looks along y
    store = SimpleNamespace(
        positions=np.array([[9.0, 9.0, 9.0], [1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]),
        rotations=np.array([np.eye(3), left, np.eye(3)]),
        indices=lambda split: {"train": np.array([1, 2])}[split],
    )
    # The ears' middle is (-10, 3, 5) mm, half way to it from the emitter (-4, 1.5, -2.5) mm.
    expected = [[1 - 0.0015, 2 - 0.004, 3 - 0.0025], [-0.004, 0.0015, -0.0025]]
    found = heard_from(renderer, store)
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_the_seed_of_the_fit_is_that_of_the_first_weights(tiny):
    def weights(seed):
        settings = tiny(field={"kind": "fourier", "options": {}}, fit={"seed": seed})
        torch.rand(3)  # whatever went before
        return next(field_and_renderer(settings, BOX)[0].parameters())

    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"field": {"kind": "gird", "options": {}}}, "unknown field 'gird'; did you mean grid"),
        ({"renderer": {"kind": "shel", "options": {}}}, "unknown renderer 'shel'"),
        ({"field": {"options": {"level": 2}}}, r"field\.options: level: .*did you mean levels"),
        ({"renderer": {"options": {"points": 0}}}, r"renderer\.options: points: found 0"),
    ],
)
def test_wrong_kinds_and_options_are_refused(tiny, changes, message):
    with pytest.raises(SettingsError, match=message):
        check_plugins(tiny(**changes))


def test_a_plugin_that_makes_something_else(tiny, monkeypatch):
    real = plugins.load

    def load(group, name):
        return (
            (lambda region, frequency: "no field") if group == plugins.FIELDS else real(group, name)
        )

    monkeypatch.setattr(plugins, "load", load)
    with pytest.raises(InputError, match="'grid' makes a str, expected a sononerf Field"):
        check_plugins(tiny(field={"options": {}}))


def test_the_region_comes_from_the_echoes_or_from_the_settings(tiny, echoes):
    store = EnsembleStore.open(echoes)
    region, possible = echo_region(tiny(), store)
    assert bool((region[0] < -0.015).all())
    assert bool((region[1] > 0.015).all())  # the sphere's radius is 20 mm
    assert bool((region.abs() < 0.2).all())
    places = region[0] + torch.rand(500, 3) * (region[1] - region[0])
    found = possible(places, 0.001)
    assert found.shape == (500,)
    assert 0 < int(found.sum()) < 500
    chosen, _ = echo_region(
        tiny(region={"lower": (-0.1, -0.1, -0.1), "upper": (0.1, 0.2, 0.3)}), store
    )
    torch.testing.assert_close(chosen[1], torch.tensor([0.1, 0.2, 0.3]))


def test_the_region_is_told_how_long_an_echo_is(tiny, echoes, monkeypatch):
    told = []

    class Asked(build.EchoEvidence):
        def __init__(self, *given, reach, **options):
            told.append(reach)
            super().__init__(*given, reach=reach, **options)

    monkeypatch.setattr(build, "EchoEvidence", Asked)
    store = EnsembleStore.open(echoes)
    for settings in (tiny(), tiny(call={"kind": "linear", "duration": 1e-3})):
        echo_region(settings, store)
    assert told[0] == pytest.approx(31.5e-6 * 343 / 2)
    assert told[1] > 3 * told[0]
