# SPDX-License-Identifier: MIT
from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.necks import without_necks

WAVELENGTH = 4e-3
RADIUS = 3 * WAVELENGTH
APART = 1.5 * RADIUS


def ball(x):
    return trimesh.creation.icosphere(subdivisions=4, radius=RADIUS).apply_translation([x, 0, 0])


@pytest.fixture(scope="module")
def bridged():
    """Two balls and a rod between them, a wavelength thick."""
    return trimesh.boolean.union([ball(-APART), ball(APART), rod(-APART, APART)], engine="manifold")


def rod(start, end):
    found = trimesh.creation.cylinder(0.5 * WAVELENGTH, segment=[[start, 0, 0], [end, 0, 0]])
    return found.subdivide_to_size(0.5 * WAVELENGTH)


def parts(mesh):
    return len(mesh.split(only_watertight=False))


def cut(mesh, one, two):
    """Return what is left if a surface of one part, and of two, has these objectives."""
    return without_necks(mesh, WAVELENGTH, lambda found: one if parts(found) == 1 else two)


def test_a_neck_that_echoes_contradict_is_cut(bridged):
    found, doubtful = cut(bridged, 2.0, 1.5)
    assert parts(found) == 2
    assert found.is_watertight
    assert found.volume == pytest.approx(2 * ball(0).volume, rel=0.02)
    between = np.abs(found.vertices[:, 0]) < APART - RADIUS
    assert doubtful[between].all()
    outer = np.abs(found.vertices[:, 0]) > APART
    assert not doubtful[outer].any()
    off_axis = np.linalg.norm(bridged.vertices[:, 1:], axis=1) > WAVELENGTH
    assert np.isin(bridged.vertices[off_axis], found.vertices).all()


@pytest.mark.parametrize(("two", "marked"), [(2.01, True), (1.99, True), (2.1, False)])
def test_a_neck_that_makes_no_difference_is_marked(bridged, two, marked):
    found, doubtful = cut(bridged, 2.0, two)
    assert found is bridged
    between = np.abs(found.vertices[:, 0]) < 0.9 * (APART - RADIUS)
    assert between.any()
    assert (doubtful[between] == marked).all()
    assert not doubtful[np.abs(found.vertices[:, 0]) > APART].any()


@pytest.fixture(scope="module")
def three(bridged):
    parts = [bridged, rod(APART, 3 * APART), ball(3 * APART)]
    return trimesh.boolean.union(parts, engine="manifold")


def test_only_the_neck_that_echoes_contradict_is_cut(three):
    def compare(found):
        return 1.5 if any(part.bounds[1, 0] < 0 for part in found.split()) else 2.0 * parts(found)

    found, doubtful = without_necks(three, WAVELENGTH, compare)
    assert parts(found) == 2
    assert not doubtful[found.vertices[:, 0] > APART].any()


def test_two_cuts_that_are_worse_together_are_not_made(three):
    found, doubtful = without_necks(three, WAVELENGTH, lambda x: {1: 2.0, 2: 1.9, 3: 3.0}[parts(x)])
    assert found is three
    assert doubtful.any()


def test_what_cannot_be_compared_is_left_alone(bridged):
    found, doubtful = cut(bridged, math.inf, math.inf)
    assert found is bridged
    assert not doubtful.any()


def test_a_large_body_takes_a_coarser_lattice(bridged):
    tracemalloc.start()
    found, _ = without_necks(bridged, WAVELENGTH / 12, lambda found: 2.0 / parts(found))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert parts(found) == 2
    assert most < 5e8


def without_faces_above(mesh):
    kept = mesh.copy()
    kept.update_faces(mesh.triangles_center[:, 2] < 0)
    return kept


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.cone(RADIUS, 4 * RADIUS),
        trimesh.creation.box([RADIUS, 2 * RADIUS, 3 * RADIUS]),
        trimesh.creation.torus(3 * RADIUS, 0.5 * WAVELENGTH),
        trimesh.util.concatenate([ball(-APART), ball(APART)]),
        trimesh.boolean.union([ball(-0.4 * RADIUS), ball(0.4 * RADIUS)], engine="manifold"),
        without_faces_above(ball(0)),
    ],
    ids=["cone", "box", "wire", "apart", "peanut", "open"],
)
def test_bodies_without_necks_are_left_alone(mesh):
    found, doubtful = without_necks(mesh, WAVELENGTH, lambda _: pytest.fail("nothing to compare"))
    assert found is mesh
    assert not doubtful.any()
