# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.geometry.poses import look_at
from sononerf.run.build import simulator_of
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.hybrid import Hybrid
from sononerf.simulation.rays import Rays
from tests.simulation.listening import ball

PLACE = np.array([0.35, 0.05, -0.02])
POSE = PLACE, look_at(PLACE, np.zeros(3))


def simulator(scene, **simulation):
    simulation = {"rays": 30_000, "sources": 300, **simulation}
    settings = {"scene": {"name": "sphere"}, "simulation": simulation}
    return simulator_of(scene, validate_settings(settings, "test"))


def levels(found):
    found.engine.prepare(PLACE[None], POSE[1][None])
    magnitude = found.spectrogram(*POSE, seed=0)
    return 20 * np.log10(np.maximum(magnitude, 1e-3 * magnitude.max()))


@pytest.mark.slow
@pytest.mark.thorough
def test_it_is_the_default_and_closer_to_the_truth_than_rays_at_low_frequencies():
    """A sphere half behind another: creeping, shadow, and sound back and forth."""
    scene = Scene(trimesh.util.concatenate([ball(0.012), ball(0.012, (-0.04, 0.006, 0.0))]))
    default = simulator(scene)
    assert isinstance(default.engine, Hybrid)
    highest = default.engine.low.frequency_full
    assert highest > 15e3
    exact = levels(simulator(scene, engine="spheres", frequency_max=60e3))
    error = {}
    for name, found in (("hybrid", default), ("rays", simulator(scene, engine="rays"))):
        heard = exact > exact.max() - 30
        heard[..., default.head.frequency > 0.6 * highest] = False
        error[name] = np.abs(levels(found) - exact)[heard].mean()
    assert error["hybrid"] < 0.5
    assert error["rays"] > 5.0


def test_high_frequencies_are_those_of_the_rays():
    scene = Scene(ball(0.015))
    found = simulator(scene)
    both, alone = levels(found), levels(simulator(scene, engine="rays"))
    high = found.head.frequency > found.engine.low.frequency_max + 40e3  # beyond the window's lobe
    loud = (alone > alone.max() - 20) & high
    assert loud.any()
    np.testing.assert_allclose(both[loud], alone[loud], atol=0.3)


def test_both_bands_add_up_to_the_whole():
    engine = simulator(Scene(ball(0.015))).engine
    frequency = engine.hearing.synthesis.frequency
    whole = Rays(engine.scene, engine.hearing, rays=1000, bounces=1, diffraction_points=100)
    above = engine.high._hats / np.where(whole._hats == 0.0, 1.0, whole._hats)
    some = np.abs(whole._hats[:, 3]) > 1e-3
    np.testing.assert_allclose(above[some, 3] + engine.low.taper(frequency)[some], 1.0, atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (Scene(trimesh.creation.box((0.06, 0.05, 3e-4))), "too thin"),
        (Scene(ball(0.3)), "so large"),
        (load_scene("sphere", {"material": "sonotracelab"}), "not rigid"),
    ],
)
def test_rays_do_all_where_the_low_band_cannot_be_solved(scene, reason):
    engine = simulator(scene).engine
    assert isinstance(engine, Rays)
    assert reason in engine.note


def test_an_open_surface_is_left_to_the_rays():
    half = ball(0.015)
    half.update_faces(half.triangles_center[:, 0] > 0.0)
    engine = simulator(Scene(half)).engine
    assert isinstance(engine, Rays)
    assert "open" in engine.note
