# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh
from scipy.special import eval_legendre, spherical_jn, spherical_yn

from sononerf.simulation.reference.boundary_mesh import halved
from sononerf.simulation.reference.boundary_near import Panels
from sononerf.simulation.reference.boundary_operators import Operators, coupling
from tests.simulation.listening import ball

pytestmark = pytest.mark.thorough

SHAPES = {
    "ball": ball(0.02, subdivisions=3),
    "thin plate": halved(trimesh.creation.box((0.02, 0.015, 0.0003)), 0.002),
}


def operators(mesh):
    return Operators(Panels.of(mesh.vertices, mesh.faces))


@pytest.mark.parametrize(("shape", "bound"), [("ball", 1e-3), ("thin plate", 6e-3)])
def test_pressure_that_is_everywhere_the_same_is_not_scattered_at_low_frequency(shape, bound):
    """The solid angle that a closed surface fills, as seen from itself, is one half."""
    found = operators(SHAPES[shape])
    ones = np.ones(len(found.panels.vertices))
    mass = found.panels.mass @ ones
    assert np.abs((found.matrix(0.1) @ ones).real - mass).max() < bound * mass.max()


@pytest.mark.parametrize("wavenumber", [100.0, 250.0, 250.0 - 8.0j])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_harmonics_of_a_sphere_are_eigenfunctions(degree, wavenumber):
    """The operators' eigenvalues follow from the expansion of e^{-jkR} / R (DLMF 10.60.1)."""
    found = operators(ball(0.02, subdivisions=3))
    vertices = found.panels.vertices / np.linalg.norm(found.panels.vertices, axis=1)[:, None]
    harmonic = eval_legendre(degree, vertices @ np.array([0.6, 0.0, 0.8]))
    radius = np.cbrt(3 * ball(0.02, subdivisions=3).volume / (4 * np.pi))
    x = wavenumber * radius
    slope = spherical_jn(degree, x, True)
    value, rise = (
        spherical_jn(degree, x, derived) - 1j * spherical_yn(degree, x, derived)
        for derived in (False, True)
    )
    exact = 1.0 + 1j * x**2 * slope * (value + coupling(wavenumber) * wavenumber * rise)
    mass = found.panels.mass @ harmonic
    error = found.matrix(wavenumber) @ harmonic - exact * mass
    assert np.linalg.norm(error) < 0.01 * abs(exact) * np.linalg.norm(mass)


def test_the_coupling_belongs_to_outgoing_waves():
    assert coupling(complex(50.0, -0.1)) == pytest.approx(-0.02j)


def fine_points(corners, times):
    """Middles (4^times, 3) of the pieces of a triangle, and their barycentric coordinates."""
    pieces = np.eye(3)[None]
    for _ in range(times):
        middles = (pieces + np.roll(pieces, -1, axis=1)) / 2  # of corners 0 1, 1 2, 2 0
        parts = [np.stack([pieces[:, k], middles[:, k], middles[:, k - 1]], 1) for k in range(3)]
        pieces = np.concatenate([*parts, middles])
    coordinates = pieces.mean(axis=1)
    return coordinates @ corners, coordinates


@pytest.mark.parametrize("gap", [0.3, 0.5])
def test_near_triangles_are_integrated_at_any_wavenumber(gap):
    """Two plates that face each other, an edge long 1/5 wavelength, by thousands of points."""
    lower = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.4, 0.9, 0.0]])
    upper = lower[[0, 2, 1]] + [0.15, 0.05, gap]
    upper[0, 2] += 0.1
    panels = Panels.of(np.concatenate([lower, upper]), [[0, 1, 2], [3, 4, 5]])
    k = 2 * np.pi / 5
    found = Operators(panels).matrix(k)[:3, 3:]
    (x, a), (y, b) = fine_points(lower, 5), fine_points(upper, 5)
    away = x[:, None] - y[None]
    distance = np.linalg.norm(away, axis=2)
    green = np.exp(-1j * k * distance) / (4 * np.pi * distance)
    green *= np.prod(panels.area) / len(x) / len(y)
    layer = away @ panels.normals[1] / distance**2 * (1 + 1j * k * distance) * green
    curls = np.cross(panels.normals[:, None], panels.slopes)
    hyper = k**2 * panels.normals[0] @ panels.normals[1] * (a.T @ green @ b)
    hyper -= curls[0] @ curls[1].T * green.sum()
    exact = -(a.T @ layer @ b) - coupling(k) * hyper
    assert np.abs(found - exact).max() < 0.0014 * np.abs(exact).max()
