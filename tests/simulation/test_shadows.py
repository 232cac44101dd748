# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.run.simulate import simulator_of
from sononerf.scene.material import RIGID
from sononerf.scene.scene import Scene
from sononerf.settings.loading import validate_settings
from tests.simulation.judges import Case
from tests.simulation.listening import ball, echoes, hearing, level_db, rays, spectrum, wall

BAND = np.linspace(40e3, 80e3, 41)


def both(offset, gap=0.05):
    """A ball of 15 mm at 0.4 m, and one behind it, moved aside."""
    return ball(0.015, (0.4, 0.0, 0.0)), ball(0.015, (0.4 + gap, offset, 0.3 * offset))


def rear(echo):
    """Mean power of what comes from the ball behind."""
    return np.mean(np.abs(spectrum(echo, BAND, since=0.421, until=0.465)) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.012, 0.018, 0.03])
def test_a_ball_fades_behind_another_as_multiple_scattering_says(offset):
    """What the left ear of the default head hears of the ball behind."""
    front, behind = both(offset)
    levels = []
    for mesh, name in ((trimesh.util.concatenate([front, behind]), ""), (behind, "_alone")):
        simulation = {"engine": "rays", "bounces": 1, "rays": 40_000}
        plain = {"scene": {"name": "mine"}, "simulation": simulation}
        simulator = simulator_of(Scene(mesh, RIGID), validate_settings(plain, "test"))
        echo = simulator.echo(np.zeros(3), np.eye(3), seed=0)[0]
        exact = Case.load(f"shaded_{1e3 * offset:g}{name}").record(0, len(echo))[0]
        levels.append([10.0 * np.log10(rear(part)) for part in (echo, exact)])
    found, expected = np.subtract(*levels)
    assert expected > -15.0
    assert abs(found - expected) < 1.5


@pytest.mark.slow
def test_the_level_falls_smoothly_through_the_border():
    steps = np.linspace(0.012, 0.024, 13)
    levels = []
    for offset in steps:
        front, behind = both(offset)
        levels.append(
            10 * np.log10(rear(echoes(rays(trimesh.util.concatenate([front, behind]), RIGID))[0]))
        )
    levels = np.array(levels) - 10 * np.log10(rear(echoes(rays(both(0.03)[1], RIGID))[0]))
    assert np.abs(np.diff(levels)).max() < 2.0
    assert levels[0] < -5.0
    assert abs(levels[-1]) < 2.0


def test_a_knife_edge_halves_the_sound_of_each_leg_on_its_border():
    """J. B. Keller, JOSA 52, 1962: half of the pressure at the border, so a quarter both ways."""
    target = ball(0.015, (0.5, 0.0, 0.0))
    levels = []
    for border in (-0.04, 0.0, 0.04):
        screen = wall(0.35, (-0.4, -0.4), (border, 0.4))
        mesh = trimesh.util.concatenate([screen, target])
        echo = echoes(rays(mesh, RIGID, rays=300_000))[0]
        levels.append(level_db(spectrum(echo, BAND, since=0.475, until=0.52)))
    free = level_db(spectrum(echoes(rays(target, RIGID))[0], BAND, since=0.475, until=0.52))
    light, border, dark = np.array(levels) - free
    # A shadow is the same over a cell of the surface, some millimetres here.
    assert np.abs(border + 12.0).max() < 2.0
    assert np.abs(light).max() < 2.5
    assert dark.max() < -25.0


def test_emitter_and_ear_exchanged_hear_the_same_past_an_obstacle():
    front, behind = both(0.017)
    mesh = trimesh.util.concatenate([front, behind])
    one, two = (0.0, 0.01, 0.0), (0.0, -0.015, 0.01)
    there, back = (
        spectrum(
            echoes(rays(mesh, RIGID, hearing(a, (b,)), rays=300_000), seed=s)[0], BAND, since=0.421
        )
        for a, b, s in ((one, two, 1), (two, one, 2))
    )
    assert np.abs(there - back).max() < 0.06 * np.abs(there).max()
