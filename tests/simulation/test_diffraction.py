# SPDX-License-Identifier: MIT
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from sononerf.geometry.raycast import RayCaster
from sononerf.scene.material import RIGID
from sononerf.scene.scene import Scene
from sononerf.simulation.diffraction import Diffraction, diffracting_edges, wedge_directivity
from sononerf.simulation.paths import reflection
from tests.simulation.exact import SPEED, disc_on_axis
from tests.simulation.judges import Case
from tests.simulation.listening import (
    NODES,
    ball,
    box,
    disc,
    echoes,
    hearing,
    level_db,
    rays,
    spectrum,
    wall,
)

PLAIN = replace(RIGID, diffraction=None)
BAND = np.linspace(20e3, 100e3, 161)
CUBE = box([-0.03] * 3, [0.03] * 3)


def band_db(pressure):
    return 10 * np.log10(np.mean(np.abs(pressure) ** 2))


def edges_only(mesh, position=(0.0, 0.0, 0.0), head=None, step=1e-3, material=RIGID):
    """What the ears hear of edges and curved places (E, S)."""
    scene, head = Scene(mesh, material), head or hearing()
    reflections = (reflection(material, NODES, speed_of_sound=SPEED),)
    found = Diffraction(scene, RayCaster(scene.mesh), reflections, step=step)
    sound = found.sound(head, np.array(position, float), np.eye(3))
    return head.echo(sound, head.synthesis.hats)


def off_normal(count):
    """Directions at least ten degrees off each face's normal."""
    found = np.random.default_rng(3).normal(size=(50, 3))
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found[np.abs(found).max(axis=1) < math.cos(math.radians(10))][:count]


def test_a_box_has_twelve_edges_three_quarters_of_the_air_around_each():
    found = diffracting_edges(CUBE)
    assert len(found.triangle) == 12
    np.testing.assert_allclose(found.length, 0.06)
    np.testing.assert_allclose(found.open_angle, 1.5 * math.pi)
    middle = found.ends.mean(axis=1)
    outward = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    np.testing.assert_allclose(found.away, outward, atol=1e-5)
    dot = np.einsum("kd,kd->k", found.inward, found.normal)
    np.testing.assert_allclose(dot, 0.0, atol=1e-9)
    # Along the face, away from the edge, and so from the other face's side.
    assert (np.einsum("kd,kd->k", found.inward, middle) < 0.0).all()


def test_a_sheet_ends_in_edges_with_air_all_around():
    found = diffracting_edges(wall(0.3, (-0.02, -0.03), (0.04, 0.05)))
    assert len(found.triangle) == 4
    np.testing.assert_allclose(np.sort(found.length), [0.06, 0.06, 0.08, 0.08])
    np.testing.assert_allclose(found.open_angle, 2 * math.pi)
    np.testing.assert_allclose(found.away, -found.inward)


def test_concave_edges_and_shallow_ones_do_not_diffract():
    inside_out = CUBE.copy()
    inside_out.invert()
    assert len(diffracting_edges(inside_out).triangle) == 0
    assert len(diffracting_edges(ball(0.02, subdivisions=3)).triangle) == 0
    step = trimesh.Trimesh(  # an L of two sheets: its fold is concave for one side, its rims count
        [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0, 0.1], [0, 0.1, 0.1]],
        [[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]],
        process=False,
    )
    found = diffracting_edges(step)
    assert len(found.triangle) == 6
    assert (
        not ((np.abs(found.ends[..., 0]) < 1e-9) & (np.abs(found.ends[..., 2]) < 1e-9)).all(1).any()
    )


def wedge(count=200, seed=0, open_angle=1.5 * math.pi):
    """Sources and receivers around an edge along z, outside the wedge."""
    rng = np.random.default_rng(seed)
    places = []
    for _ in range(2):
        angle = rng.uniform(0.05, open_angle - 0.05, count)
        radius, height = rng.uniform(0.05, 0.5, count), rng.uniform(-0.3, 0.3, count)
        places.append(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1))
    inward, normal = np.tile([1.0, 0, 0], (count, 1)), np.tile([0, 1.0, 0], (count, 1))
    return (inward, normal, np.full(count, open_angle)), places


def test_the_directivity_is_that_of_the_papers_formula():
    r"""Svensson, Fred and Vanderkooy 1999, equations (5) to (7), written out ray by ray."""
    faces, (source, receiver) = wedge()
    found = wedge_directivity(*faces, source, receiver, np.array([1e9]))[:, 0]
    nu = math.pi / (1.5 * math.pi)
    for k in range(len(found)):
        one, two = (math.atan2(p[1], p[0]) % (2 * math.pi) for p in (source[k], receiver[k]))
        r1, r2 = (math.hypot(*p[:2]) for p in (source[k], receiver[k]))
        l1, l2 = (np.linalg.norm(p) for p in (source[k], receiver[k]))
        # Heights from the edge's point: z_s z_r enters with the sign of theirs, (5) to (7).
        eta = math.acosh((source[k][2] * receiver[k][2] + l1 * l2) / (r1 * r2))
        total = 0.0
        for a in (1, -1):
            for b in (1, -1):
                angle = nu * (math.pi + a * one + b * two)
                total += math.sin(angle) / (math.cosh(nu * eta) - math.cos(angle))
        assert found[k] == pytest.approx(-nu / 2 * total, rel=1e-6, abs=1e-9)


def test_tensors_give_the_same_directivity_and_its_gradients():
    faces, (source, receiver) = wedge()
    fade = np.array([500.0, 2000.0])
    given = [torch.as_tensor(part) for part in (*faces, source, receiver, fade)]
    given[3].requires_grad_(True)
    found = wedge_directivity(*given, xp=torch)
    assert np.allclose(found.detach(), wedge_directivity(*faces, source, receiver, fade))
    found.sum().backward()
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        ends = [
            wedge_directivity(*faces, source + sign * step, receiver, fade).sum(axis=1)
            for sign in (1, -1)
        ]
        wanted = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(given[3].grad[:, axis], wanted, rtol=1e-3, atol=1e-3)


def test_a_plane_has_no_edge():
    faces, (source, receiver) = wedge(open_angle=math.pi)
    found = wedge_directivity(*faces, source, receiver, np.array([1e9]))
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


@pytest.mark.parametrize("open_angle", [1.5 * math.pi, 2 * math.pi])
def test_the_directivity_is_finite_at_the_mirror_direction(open_angle):
    """Source straight above the edge at 0.3 m and receivers about there, where the pole is."""
    angle = np.pi / 2 + np.concatenate([[0.0], np.outer([-1, 1], np.logspace(-9, -1, 9)).ravel()])
    receiver = 0.3 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    source = np.tile([0.0, 0.3, 0.0], (len(angle), 1))
    faces = np.tile([1.0, 0, 0], (len(angle), 1)), np.tile([0, 1.0, 0], (len(angle), 1))
    opening = np.full(len(angle), open_angle)
    found = wedge_directivity(*faces, opening, source, receiver, np.array([500.0, 2000.0]))
    assert np.isfinite(found).all()
    # Fading within 1 / k of detour: no more than about sqrt(k r).
    assert np.abs(found).max() < math.sqrt(2000.0 * 0.3)


def test_the_level_depends_neither_on_the_number_of_points_nor_on_the_mesh():
    fine = CUBE.subdivide().subdivide().subdivide()
    position = 0.3 * off_normal(1)[0]
    many = spectrum(edges_only(CUBE, position, step=1e-4)[0], BAND)
    for mesh, step, error in ((CUBE, 2e-3, 0.05), (CUBE, 1e-3, 0.02), (fine, 1e-3, 0.02)):
        found = spectrum(edges_only(mesh, position, step=step)[0], BAND)
        assert abs(band_db(found) - band_db(many)) < error


@pytest.mark.parametrize("radius", [0.04, 0.06])
def test_the_rim_of_a_disc_answers_as_the_wedge_theory_says(radius):
    r"""On the axis of a thin rigid disc all of its rim answers at once.

    Each of the terms of nu = 1/2 is a cotangent; with sin t = a / l and l the way to the rim the
    pressure is -(1 + sin t) / (2 l): for a small disc just what takes the mirror's 1 / (2 h) away.
    """
    way = math.hypot(0.3, radius)
    found = spectrum(edges_only(disc(radius, 0.3))[0], BAND[BAND > 60e3])
    expected = -(1 + radius / way) / (2 * way)
    expected = expected * np.exp(-4j * np.pi * BAND[BAND > 60e3] * way / SPEED)
    # What the fading mirror itself still brings over the rim: e^-k d, d the detour of 5 mm.
    np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())


@pytest.mark.parametrize("radius", [0.03, 0.05])
def test_a_disc_is_heard_about_as_loud_as_its_closed_form(radius):
    (echo,) = echoes(rays(disc(radius, 0.3), RIGID, rays=40_000))
    found, expected = spectrum(echo, BAND), disc_on_axis(BAND, radius, 0.3)
    assert abs(band_db(found) - band_db(expected)) < 1.5


@pytest.mark.parametrize("radius", [0.01, 0.02, 0.04])
def test_mirror_and_rim_of_a_disc_add_up_to_the_closed_form(radius):
    (echo,) = echoes(rays(disc(radius, 0.3), RIGID, rays=40_000))
    found, expected = spectrum(echo, BAND), disc_on_axis(BAND, radius, 0.3)
    # The closed form is Kirchhoff's, whose rim is weaker by 1 + a / l.
    error = np.sqrt(np.mean(np.abs(found - expected) ** 2) / np.mean(np.abs(expected) ** 2))
    assert error < 0.15


@pytest.fixture(scope="module")
def optics():
    """Physical optics of the cube: eight poses off its faces' normals, three near one."""
    return Case.load("cube_kirchhoff")


def spectra(optics, pose, rays_per_pose):
    head = hearing()
    exact = optics.record(pose, head.synthesis.samples)[0]
    found = echoes(rays(CUBE, RIGID, head, rays=rays_per_pose), optics.position[pose])[0]
    return spectrum(found, BAND), spectrum(exact, BAND)


@pytest.mark.parametrize("pose", range(8))
def test_the_edges_of_a_box_are_about_as_loud_as_kirchhoffs(optics, pose):
    found, exact = spectra(optics, pose, 2000)
    # Physical optics underestimates wedges seen from the side.
    assert -1.0 < band_db(found) - band_db(exact) < 3.5


@pytest.mark.parametrize("pose", [8, 9, 10])
def test_face_and_edges_of_a_box_add_up_as_in_kirchhoffs_integral(optics, pose):
    found, exact = spectra(optics, pose, 40_000)
    assert np.sqrt(np.mean((level_db(found) - level_db(exact)) ** 2)) < 0.7


def test_a_stretch_that_is_seen_in_part_counts_by_that_part():
    """A screen hides part of a rim; with long stretches its border is found as with short ones."""
    sheet = wall(0.3, (-0.02, -0.02), (0.02, 0.02))
    screen = box([0.2, -0.1, -0.1], [0.201, 0.0037, 0.1])
    mesh = trimesh.util.concatenate([sheet, screen])
    gate = {"since": 0.28, "until": 0.35}
    found, fine = (spectrum(edges_only(mesh, step=step)[0], BAND, **gate) for step in (2e-3, 2e-5))
    np.testing.assert_allclose(found, fine, atol=0.02 * np.abs(fine).max())


def test_a_triangle_without_area_opens_no_edge():
    """A sliver between two halves of a sheet; where it was there is neither an end nor a fold."""
    corners = [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0.05, 0, 0], [0.05, -0.1, 0]]
    whole = trimesh.Trimesh(
        corners, [[0, 1, 2], [0, 2, 3], [0, 4, 1], [0, 5, 4], [4, 5, 1]], process=False
    )
    found = diffracting_edges(whole)
    assert not (np.abs(found.ends[..., 1]) < 1e-9).all(axis=1).any()
    assert found.length.sum() == pytest.approx(0.3 + 2 * math.hypot(0.05, 0.1))


def test_an_edge_that_a_body_hides_is_silent():
    sheet = wall(0.3, (-0.02, -0.02), (0.02, 0.02))
    screen = wall(0.15, (-0.2, -0.2), (0.2, 0.2))
    both = trimesh.util.concatenate([sheet, screen])
    free, hidden, alone = (edges_only(mesh)[0] for mesh in (sheet, both, screen))
    gate = {"since": 0.28, "until": 0.35}
    loud = np.abs(spectrum(free, BAND, **gate)).max()
    assert (
        np.abs(spectrum(hidden, BAND, **gate)).max()
        < 0.02 * loud + 1.1 * np.abs(spectrum(alone, BAND, **gate)).max()
    )
    assert np.abs(spectrum(alone, BAND, **gate)).max() < 0.1 * loud


def test_smooth_bodies_have_none_and_cost_no_search():
    scene = Scene(ball(0.02, (0.3, 0.0, 0.0), 3), RIGID)

    class NoSearch(RayCaster):
        def visible(self, *arguments, **options):
            raise AssertionError

    reflections = (reflection(RIGID, NODES, speed_of_sound=SPEED),)
    found = Diffraction(scene, NoSearch(scene.mesh), reflections, step=1e-3)
    sound = found.sound(hearing(), np.zeros(3), np.eye(3))
    assert not sound.bins[0].values.any()


def test_a_materials_strength_is_that_of_its_edges():
    position = 0.3 * off_normal(1)[0]
    whole, half = (
        edges_only(CUBE, position, material=replace(RIGID, diffraction=(d, d)))[0]
        for d in (1.0, 0.5)
    )
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-9 * np.abs(whole).max())
    none = replace(RIGID, diffraction=None)
    assert not edges_only(CUBE, position, material=none).any()


def test_a_part_without_diffraction_has_none_and_the_other_keeps_its_own():
    other = box([-0.03, 0.07, -0.03], [0.03, 0.13, 0.03])
    mesh = trimesh.util.concatenate([CUBE, other])
    part = np.repeat([0, 1], [12, 12])
    position = np.array([0.2, -0.2, 0.13])
    several = Scene(mesh, (RIGID, PLAIN), part)
    found = echoes(rays(several, None, rays=1000), position)[0]
    alone = edges_only(CUBE, position)[0]
    gate = {"until": 0.35}
    ratio = band_db(spectrum(found, BAND, **gate)) - band_db(spectrum(alone, BAND, **gate))
    assert abs(ratio) < 0.3


def test_strongly_curved_places_scatter_by_their_share_of_turning():
    """A ball of 2 mm, half of whose curvature counts: by the emitter's side, in step up to ka 1."""
    radius = 2e-3
    curved = replace(RIGID, transition_curvature=math.sqrt(2) / radius)
    found = edges_only(ball(radius, (0.3, 0, 0), 3), material=curved, step=1e-4)[0]
    smooth = edges_only(ball(radius, (0.3, 0, 0), 3), material=RIGID)[0]
    assert not smooth.any()
    # Half a sphere is seen: dM = share kappa dA, each dM / (2 pi r^2), summed with its delay.
    measure = 0.5 * math.sqrt(2) / radius * 2 * math.pi * radius**2
    slow = np.array([8e3, 10e3])
    way = np.linspace(0.3 - radius, 0.3, 400)
    mean = np.exp(-4j * np.pi * np.outer(slow, way) / SPEED).mean(axis=1)
    expected = measure / (2 * math.pi * 0.3**2) * mean
    np.testing.assert_allclose(spectrum(found, slow), expected, rtol=0.03)
