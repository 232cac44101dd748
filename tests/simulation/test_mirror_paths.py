# SPDX-License-Identifier: MIT
"""Echoes over several bodies, heard by few rays, which only search, and by very many, which sum."""

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize

from sononerf.scene.material import RIGID
from sononerf.scene.scene import Scene
from tests.simulation.listening import ball, delay, echoes, level_db, rays, spectrum

BAND = np.linspace(40e3, 95e3, 56)
RADIUS = 0.01
MIDDLES = np.array([[0.3, -0.05, 0.0], [0.33, 0.04, 0.01]])
PAIR = trimesh.util.concatenate([ball(RADIUS, middle) for middle in MIDDLES])


def later(mesh, count, bounces=3, seed=0):
    """What comes after the first bounce (S,)."""
    all_, first = (
        echoes(rays(mesh, None, rays=count, bounces=number), seed=seed)[0]
        for number in (bounces, 1)
    )
    return all_ - first


@pytest.fixture(scope="module")
def pair():
    return Scene(PAIR, RIGID)


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


def test_a_path_over_two_bodies_is_as_long_as_the_shortest(pair):
    """There and back it is the same path, so all that comes after two bounces comes at once."""
    fine = np.linspace(40e3, 95e3, 1101)
    found = delay(spectrum(later(pair, 20_000, 2), fine), fine)
    assert found == pytest.approx(0.5 * mirror_path((0, 1)), abs=2e-5)


@pytest.mark.parametrize("bounces", [2, 3])
def test_few_rays_hear_what_very_many_hear(pair, bounces):
    few, many = later(pair, 20_000, bounces), later(pair, 3_000_000, bounces)
    found, wanted = spectrum(few, BAND), spectrum(many, BAND)
    error = np.sqrt(np.mean(np.abs(found - wanted) ** 2) / np.mean(np.abs(wanted) ** 2))
    assert error < 0.1


def test_two_patterns_of_rays_hear_the_same_of_curved_bodies(pair):
    one, two = (spectrum(later(pair, 20_000, seed=seed), BAND) for seed in (1, 2))
    assert np.abs(level_db(one) - level_db(two)).max() < 0.5
