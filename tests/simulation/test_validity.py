# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.scene.scene import Scene, load_scene
from sononerf.simulation.validity import SOLVED_DB, expected_error_db
from tests.simulation.listening import ball
from tests.simulation.test_hybrid import simulator

FREQUENCY = np.array([10e3, 20e3, 40e3, 80e3])


def error(scene, **simulation):
    engine = simulator(scene, **simulation).engine
    return expected_error_db(engine, scene, FREQUENCY)


def test_rays_err_most_where_bodies_are_small_against_the_wavelength():
    small, large = (error(Scene(ball(radius)), engine="rays") for radius in (0.01, 0.03))
    assert (np.diff(small) < 0.0).all()
    assert (large < small).all()
    assert small[0] > 5.0
    assert large[-1] < 0.5


def test_many_bodies_count_as_single_ones():
    two = Scene(trimesh.util.concatenate([ball(0.01), ball(0.01, (0.05, 0.0, 0.0))]))
    np.testing.assert_allclose(
        error(two, engine="rays"), error(Scene(ball(0.01)), engine="rays"), rtol=1e-6
    )


def test_the_low_band_of_the_default_is_as_good_as_a_solution():
    scene = Scene(ball(0.015))
    default, rays = error(scene), error(scene, engine="rays")
    assert default[0] == pytest.approx(SOLVED_DB)
    assert default[-1] == rays[-1]
    assert error(scene, engine="spheres")[-1] == SOLVED_DB


def test_of_other_materials_it_is_not_known():
    assert error(load_scene("sphere", {"material": "sonotracelab"})) is None
