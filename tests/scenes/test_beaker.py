# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE, SIDE

from sononerf.errors import SettingsError
from sononerf.evaluation.solid import Solid
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import MATERIALS, load_scene


@pytest.mark.parametrize(
    ("radius", "height", "wall"), [(0.04, 0.09, 0.004), (0.03, 0.05, 0.001), (0.02, 0.06, 0.015)]
)
def test_a_beaker_is_walls_and_a_floor(radius, height, wall):
    options = {"radius": radius, "height": height, "wall": wall}
    mesh = load_scene("beaker", options).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    assert mesh.edges_unique_length.max() <= EDGE
    np.testing.assert_allclose(mesh.bounds[:, 2], [-height / 2.0, height / 2.0])
    inner = radius - wall
    exact = np.pi * (radius**2 * height - inner**2 * (height - wall))
    # Polygons of sides s lose s^2 of area whatever their radius, outside and inside alike.
    assert abs(mesh.volume - exact) < np.pi * height * SIDE**2 / 6.0


def test_a_beaker_is_open_on_top_and_hollow():
    mesh = load_scene("beaker").mesh
    places = np.zeros((4, 3))
    places[:, 2] = [0.06, 0.0, -0.0405, -0.043]
    inside = Solid(mesh).contains(places)
    np.testing.assert_array_equal(inside, [False, False, False, True])
    walls = np.array([[0.038, 0.0, 0.0], [0.035, 0.0, 0.0], [0.041, 0.0, 0.0]])
    np.testing.assert_array_equal(Solid(mesh).contains(walls), [True, False, False])


def test_a_beaker_is_turned_and_of_its_material():
    scene = load_scene("beaker", {"pitch": 90.0, "material": "leaf"})
    np.testing.assert_allclose(scene.mesh.extents, [0.09, 0.08, 0.08], rtol=1e-3)
    # Positive pitch turns what is up to where x points.
    ahead = scene.mesh.vertices[:, 0] > 0.0449
    assert np.hypot(*scene.mesh.vertices[ahead][:, 1:].T).min() == pytest.approx(0.036, rel=1e-3)
    assert scene.material == MATERIALS["leaf"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"wall": 0.04}, r"wall: found 0\.04; must lie below radius, 0\.04"),
        ({"wall": 0.03, "height": 0.02}, r"wall: found 0\.03; must lie below height, 0\.02"),
        ({"wall": 1e-4}, "wall"),
        ({"radius": 0.0}, "radius"),
        ({"height": 1.0}, "height"),
    ],
)
def test_what_leaves_no_hollow_is_refused(options, said):
    with pytest.raises(SettingsError, match=rf"^scene\.options\.{said}") as caught:
        load_scene("beaker", options)
    assert "\n" not in str(caught.value)
