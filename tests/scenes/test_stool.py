# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE, SIDE
from sononerf_scenes.stool import OUT

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(
    "options",
    [{}, {"legs": 5}, {"legs": 12, "seat_radius": 0.02}, {"leg_radius": 0.01, "leg_length": 0.2}],
)
def test_a_stool_is_one_closed_body(options):
    mesh = load_scene("stool", options).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    assert mesh.edges_unique_length.max() <= 1.1 * EDGE
    legs, wide = options.get("legs", 3), options.get("seat_radius", 0.05)
    long, thin = options.get("leg_length", 0.06), options.get("leg_radius", 0.003)
    np.testing.assert_allclose(mesh.extents, [2 * wide, 2 * wide, 0.006 + long], rtol=3e-3)
    seat, leg = np.pi * wide**2 * 0.006, np.pi * thin**2 * long
    # Polygons of sides s instead of circles lose (s/r)^2 / 6.
    lost = seat * (SIDE / wide) ** 2 / 3.0 + legs * leg * (SIDE / thin) ** 2 / 3.0
    assert seat + legs * leg - lost < mesh.volume < seat + legs * leg


@pytest.mark.parametrize("legs", [3, 4])
def test_a_stool_stands_on_its_legs(legs):
    mesh = load_scene("stool", {"legs": legs}).mesh
    cut = mesh.section(plane_origin=[0.0, 0.0, -0.01], plane_normal=[0.0, 0.0, 1.0])
    middles = np.array([0.5 * (line.min(axis=0) + line.max(axis=0)) for line in cut.discrete])
    assert len(middles) == legs
    np.testing.assert_allclose(np.hypot(*middles[:, :2].T), OUT * 0.05, atol=1e-4)
    feet = mesh.vertices[mesh.vertices[:, 2] < -0.0329]
    assert np.hypot(*feet[:, :2].T).max() == pytest.approx(OUT * 0.05 + 0.003, abs=1e-4)


def test_the_seat_is_whole_but_for_the_legs():
    mesh = load_scene("stool").mesh
    under = (mesh.face_normals[:, 2] < -0.99) & (mesh.triangles_center[:, 2] > -0.03)
    exact = np.pi * (0.05**2 - 3 * 0.003**2)
    assert mesh.area_faces[under].sum() == pytest.approx(exact, rel=2e-3)
    top = mesh.face_normals[:, 2] > 0.99
    assert mesh.area_faces[top].sum() == pytest.approx(np.pi * 0.05**2, rel=1e-3)


def test_a_stool_is_turned():
    mesh = load_scene("stool", {"pitch": 90.0}).mesh
    np.testing.assert_allclose(mesh.extents, [0.066, 0.1, 0.1], rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"leg_radius": 0.012}, r"leg_radius: found 0\.012; must not exceed 0\.0114, else .* rim"),
        ({"legs": 12, "leg_radius": 0.0095}, r"leg_radius: .* 0\.00918, else the legs would touch"),
        ({"legs": 2}, "legs"),
        ({"leg_radius": 0.001}, "leg_radius"),
        ({"seat_thickness": 0.0}, "seat_thickness"),
        ({"leg_length": 0.0}, "leg_length"),
    ],
)
def test_what_does_not_fit_is_refused(options, said):
    with pytest.raises(SettingsError, match=rf"^scene\.options\.{said}") as caught:
        load_scene("stool", options)
    assert "\n" not in str(caught.value)
