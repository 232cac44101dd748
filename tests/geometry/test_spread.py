# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sononerf.geometry.directions import spread_points


def uneven():
    """Return a box of which two triangles are divided into 2,048, and the others are not."""
    box = trimesh.creation.box((0.04, 0.05, 0.06))
    first, others = box.submesh([[0, 1], range(2, 12)])
    for _ in range(5):
        first = first.subdivide()
    return trimesh.util.concatenate([first, others])


@pytest.mark.parametrize("first", [40, 100, 250])
@pytest.mark.parametrize(
    "mesh", [trimesh.creation.icosphere(subdivisions=3, radius=0.02), uneven()], ids=["ball", "box"]
)
def test_any_first_points_are_spread_evenly(mesh, first):
    points, _ = spread_points(mesh, 250)
    apart = cKDTree(points[:first]).query(points[:first], k=2)[0][:, 1]
    spacing = np.sqrt(mesh.area / first)
    assert apart.min() > 0.55 * spacing
    assert apart.max() < 1.5 * spacing
    # And no place of the surface is far from all of them.
    places = mesh.triangles_center
    assert cKDTree(points[:first]).query(places)[0].max() < 1.2 * spacing


def test_points_lie_on_the_surface_and_normals_point_out():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    points, normals = spread_points(mesh, 100)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.02, rtol=5e-3)
    np.testing.assert_allclose(normals, points / 0.02, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_the_same_points_every_time():
    mesh = uneven()
    np.testing.assert_array_equal(spread_points(mesh, 50)[0], spread_points(mesh, 50)[0])
