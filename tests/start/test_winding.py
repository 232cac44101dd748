# SPDX-License-Identifier: MIT
import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from sononerf.field.field import sphere_directions
from sononerf.geometry.lattice import Lattice
from sononerf.start.occupancy import winding_number

RADIUS = 12.0


def flux(keep, sign=1.0):
    normals = sphere_directions(20_000, torch.zeros(1).double()).numpy()
    area = 4 * np.pi * RADIUS**2 / len(normals)
    normals = normals[keep(normals)]
    lattice = Lattice(np.full(3, -20.0), 1.0, (41, 41, 41))
    points = RADIUS * normals
    return [
        gaussian_filter(lattice.spread(points, sign * area * along), 1.0) for along in normals.T
    ]


def test_inside_of_a_closed_surface_it_is_one_and_outside_zero():
    found = winding_number(flux(lambda n: n[:, 2] > -2))
    assert abs(found[20, 20, 20] - 1) < 0.03
    assert np.abs(found[[1, 20], [1, 20], [1, 1]]).max() < 0.05


def test_half_a_sphere_fills_half_of_what_is_seen_from_its_middle():
    found = winding_number(flux(lambda n: n[:, 2] > 0))
    assert abs(found[20, 20, 20] - 0.5) < 0.03
    assert found[20, 20, 38] < 0.05


def test_a_surface_that_faces_inward_is_seen_from_behind():
    assert winding_number(flux(lambda n: n[:, 2] > -2, sign=-1.0))[20, 20, 20] < -0.9
