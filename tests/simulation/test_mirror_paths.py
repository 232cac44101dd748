# SPDX-License-Identifier: MIT
"""Echoes over two bodies: in a wide scene by mirror paths, alone by a sum over very many rays."""

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize

from sononerf.scene.material import RIGID
from sononerf.scene.scene import Scene
from tests.simulation.listening import ball, delay, echoes, rays, spectrum

BAND = np.linspace(40e3, 95e3, 56)
RADIUS = 0.005
MIDDLES = np.array([[0.3, -0.012, 0.0], [0.31, 0.012, 0.005]])
FAR = [0.3, 0.09, 0.0]
"""Where one more ball makes the scene wide; the first Fresnel zones are then a small part of it."""
ALONE = Scene(trimesh.util.concatenate([ball(RADIUS, middle) for middle in MIDDLES]), RIGID)
WIDE = Scene(trimesh.util.concatenate([ALONE.mesh, ball(RADIUS, FAR)]), RIGID)
UNTIL = 0.33
"""Range up to which nothing comes by the far ball, m."""


def later(scene, count, bounces, frequency=BAND):
    """Return the spectrum of what comes after the first bounce."""
    all_, first = (
        echoes(rays(scene, None, rays=count, bounces=number))[0] for number in (bounces, 1)
    )
    return spectrum(all_ - first, frequency, until=UNTIL)


def mirror_path(order):
    """Length (m) of the path from the origin over balls and back, by brute force."""

    def length(angles):
        places = [np.zeros(3)]
        for which, (polar, azimuth) in zip(order, angles.reshape(-1, 2), strict=True):
            off = [np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), np.sin(polar)]
            places.append(MIDDLES[which] + RADIUS * np.array(off))
        places.append(np.zeros(3))
        return np.linalg.norm(np.diff(places, axis=0), axis=1).sum()

    start = []
    for which in order:  # each towards the middle of what comes before and after
        other = 0.5 * (MIDDLES[1 - which] - MIDDLES[which])
        way = other / np.linalg.norm(other) - MIDDLES[which] / np.linalg.norm(MIDDLES[which])
        way /= np.linalg.norm(way)
        start += [np.arcsin(way[2]), np.arctan2(way[1], way[0])]
    found = minimize(length, start, method="BFGS", options={"gtol": 1e-10})
    return found.fun


def test_a_path_over_two_bodies_is_as_long_as_the_shortest():
    """There and back it is the same path, so all that comes after two bounces comes at once."""
    fine = np.linspace(40e3, 95e3, 1101)
    found = delay(later(WIDE, 100_000, 2, fine), fine)
    assert found == pytest.approx(0.5 * mirror_path((0, 1)), abs=2e-5)


@pytest.mark.parametrize("bounces", [2, 3])
def test_mirror_paths_bring_what_a_sum_over_rays_brings(bounces):
    found, wanted = later(WIDE, 100_000, bounces), later(ALONE, 1_000_000, bounces)
    error = np.sqrt(np.mean(np.abs(found - wanted) ** 2) / np.mean(np.abs(wanted) ** 2))
    # The first Fresnel zone is not that much smaller than balls of one wavelength.
    assert error < 0.25
