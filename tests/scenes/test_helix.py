# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from scipy.spatial import cKDTree
from sononerf_scenes.bodies import EDGE, SIDE

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


@pytest.mark.parametrize(
    ("radius", "rise", "turns", "wire"),
    [(0.03, 0.025, 4.0, 0.003), (0.02, 0.03, 2.25, 0.005), (0.04, 0.01, 1.0, 0.0022)],
)
def test_a_helix_is_a_round_wire_along_its_line(radius, rise, turns, wire):
    options = {"radius": radius, "pitch_length": rise, "turns": turns, "wire_radius": wire}
    mesh = load_scene("helix", options).mesh
    assert surface_faults(mesh) == []
    assert (mesh.euler_number, mesh.body_count) == (2, 1)
    assert mesh.edges_unique_length.max() <= 1.1 * EDGE
    assert mesh.extents[2] == pytest.approx(turns * rise + 2.0 * wire, rel=0.02)
    # The volume of a bent tube is its section times its middle line; the ends are half balls.
    length = turns * np.hypot(2.0 * np.pi * radius, rise)
    exact = np.pi * wire**2 * length + 4.0 / 3.0 * np.pi * wire**3
    assert 1.0 - (SIDE / wire) ** 2 / 3.0 < mesh.volume / exact < 1.0
    # Its sides are heard as one round surface.
    assert np.degrees(mesh.face_adjacency_angles.max()) < 30.0


def test_all_of_the_wire_is_a_radius_away_from_a_right_handed_line():
    mesh = load_scene("helix", {"turns": 2.0}).mesh
    angle = np.linspace(0.0, 4.0 * np.pi, 20000)
    line = np.stack([0.03 * np.cos(angle), 0.03 * np.sin(angle), 0.025 * angle / 2 / np.pi], 1)
    # The middle of two turns was moved to the origin.
    distance = cKDTree(line).query(mesh.vertices + np.array([0.0, 0.0, 0.025]))[0]
    np.testing.assert_allclose(distance, 0.003, atol=3e-5)


def test_a_helix_is_turned():
    mesh = load_scene("helix", {"pitch": 90.0}).mesh
    assert np.argmax(mesh.extents) == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"pitch_length": 0.006}, r"wire_radius: found 0\.003; .* 0\.003, else neighbouring turns"),
        ({"radius": 0.003}, r"wire_radius: found 0\.003; .* 0\.003, else the wire would fill"),
        ({"wire_radius": 0.001}, "wire_radius"),
        ({"turns": 0.1}, "turns"),
    ],
)
def test_what_would_touch_itself_is_refused(options, said):
    with pytest.raises(SettingsError, match=rf"^scene\.options\.{said}") as caught:
        load_scene("helix", options)
    assert "\n" not in str(caught.value)
