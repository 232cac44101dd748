# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.simulation.reference.boundary_near import Panels

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def panels():
    mesh = trimesh.creation.box((0.3, 0.2, 0.1)).subdivide()
    return Panels.of(mesh.vertices, mesh.faces)


def test_points_and_vectors_close_the_surface(panels):
    assert panels.weights.sum() == pytest.approx(0.22)
    np.testing.assert_allclose(panels.vectors.sum(axis=0), 0.0, atol=1e-15)
    # Gauss: a third of the flux of the place is the volume.
    assert (panels.points * panels.vectors).sum() / 3.0 == pytest.approx(0.006)


def test_linear_functions_are_exact(panels):
    slope = np.array([0.3, -0.7, 1.1])
    values = panels.vertices @ slope
    np.testing.assert_allclose(panels.halves @ values, panels.points @ slope, atol=1e-15)
    flat = np.einsum("tcd,tc->td", panels.slopes, values[panels.faces])
    along = slope - (panels.normals @ slope)[:, None] * panels.normals
    np.testing.assert_allclose(flat, along, atol=1e-12)
    exact = (panels.area / 12.0 * (values[panels.faces] ** 2).sum(axis=1)).sum()
    exact += (panels.area / 12.0 * values[panels.faces].sum(axis=1) ** 2).sum()
    assert values @ panels.mass @ values == pytest.approx(exact)


def test_curls_are_square_to_slopes_and_normals(panels):
    slope = np.array([0.3, -0.7, 1.1])
    values = panels.vertices @ slope
    curl = np.stack([(part @ values).sum() for part in panels.curls])
    exact = (panels.area[:, None] * np.cross(panels.normals, slope)).sum(axis=0)
    np.testing.assert_allclose(curl, exact, atol=1e-12)
