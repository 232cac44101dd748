# SPDX-License-Identifier: MIT
"""The start surface of the network: what it sees, and what it makes of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file
from safetensors.torch import save as safetensors_bytes
from scipy.spatial import cKDTree
from trimesh.transformations import random_rotation_matrix

from sononerf.echoes.detection import RangeLevels
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import IncompatibleError, NumericalError
from sononerf.geometry.meshes import Plane
from sononerf.start import network
from sononerf.start.features import (
    FEATURES,
    HARMONICS,
    KINDS,
    features_of,
    free_places,
    harmonics,
    pooled,
)
from sononerf.start.network import (
    FRAMES,
    FULLER_DISTANCE,
    LOGIT,
    VOXEL,
    StartNetwork,
    beyond_training,
    expected_level,
    lattice_of,
    lots_of,
    start_surfaces,
    without_hollows,
    without_small_parts,
)

RESOLUTION = 0.006
BALLS = ((0.0, 0.0, 0.0, 0.02), (0.045, 0.01, -0.02, 0.012))
"""Middle and radius of each sphere, m."""
BOX = np.array([[-0.07] * 3, [0.07] * 3])


def around(count, distance=0.4):
    number = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * number / count), np.pi * (1 + 5**0.5) * number
    way = np.column_stack(
        (np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar))
    )
    return distance * way


def heard(sources, balls=BALLS, scale=1.0, plane=None):
    """Levels and onsets of spheres, each of which is heard from its point next to a pose."""
    sources = np.asarray(sources) * scale
    ranges = scale * (0.3 + 0.001 * np.arange(220))
    parts = [
        (np.linalg.norm(sources - scale * np.array(ball[:3]), axis=1) - scale * ball[3])
        for ball in balls
    ]
    pulses = [
        ball[3] * np.exp(-(((ranges - part[:, None]) / (0.4 * RESOLUTION * scale)) ** 2))
        for ball, part in zip(balls, parts, strict=True)
    ]
    first = np.min(parts, axis=0)[:, None]
    receivers = sources[:, None]
    axes = -sources / np.linalg.norm(sources, axis=1, keepdims=True)
    hull = EchoHull(sources, receivers, first, axes, plane=plane)
    levels = RangeLevels.of(
        sum(pulses)[:, None, :, None].repeat(3, axis=3),
        np.arange(len(sources)),
        sources,
        receivers,
        first=ranges[0],
        spacing=ranges[1] - ranges[0],
        resolution=RESOLUTION * scale,
    )
    return levels, hull


def off(found, balls, scale=1.0):
    """Distance of vertices from the true spheres, m."""
    each = [
        np.abs(
            np.linalg.norm(found.vertices - scale * np.array(ball[:3]), axis=1) - scale * ball[3]
        )
        for ball in balls
    ]
    return np.min(each, axis=0)


def apart(one, other):
    """Median distance between two surfaces, m."""
    dense = trimesh.sample.sample_surface(one, 100_000, seed=0)[0]
    return np.median(cKDTree(dense).query(other.vertices)[0])


def surfaces(levels, hull):
    return start_surfaces(levels, hull, BOX, RESOLUTION)


def test_two_spheres_are_seen_as_two():
    found = surfaces(*heard(around(80)))["levels"]
    assert found.is_watertight
    assert found.body_count == 2
    assert off(found, BALLS).mean() < 0.25 * RESOLUTION


def test_the_fuller_surface_lies_outside():
    one, fuller = (surfaces(*heard(around(80)))[name] for name in ("levels", "fuller"))
    assert fuller.is_watertight
    middle, radius = np.array(BALLS[0][:3]), BALLS[0][3]
    far = [np.linalg.norm(found.vertices - middle, axis=1) for found in (one, fuller)]
    thin, thick = (np.median(of[of < 1.2 * radius]) for of in far)
    assert thick - thin == pytest.approx(FULLER_DISTANCE * VOXEL * RESOLUTION, rel=0.3)


def test_a_turned_scene_gives_a_turned_surface():
    turn = random_rotation_matrix(np.array([0.2, 0.4, 0.7]))[:3, :3]
    balls = tuple((*(turn @ ball[:3]), ball[3]) for ball in BALLS)
    sources = around(80)
    one = surfaces(*heard(sources))["levels"]
    other = surfaces(*heard(sources @ turn.T, balls))["levels"]
    one.vertices = one.vertices @ turn.T
    assert other.body_count == 2
    assert apart(one, other) < 0.1 * RESOLUTION


@pytest.mark.slow
def test_poses_in_another_order_give_the_same_surface():
    sources = around(500)  # more than one pass takes
    assert len(lots_of(heard(sources)[0])) == 2
    order = np.random.default_rng(0).permutation(500)
    one = surfaces(*heard(sources))["levels"]
    other = surfaces(*heard(sources[order]))["levels"]
    np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-4 * RESOLUTION)


def test_lengths_are_seen_in_range_resolutions():
    one = surfaces(*heard(around(60)))["levels"]
    large = start_surfaces(*heard(around(60), scale=3.0), 3 * BOX, 3 * RESOLUTION)["levels"]
    np.testing.assert_allclose(large.vertices, 3 * one.vertices, atol=0.01 * RESOLUTION)


def test_a_support_is_heard_as_the_image_of_body_and_poses():
    table = Plane((0.0, 0.0, -0.035), (0.0, 0.0, 1.0))
    above = around(160)[:80]
    balls = (BALLS[0],)
    image = (0.0, 0.0, -0.07, 0.02)
    levels, hull = heard(above, (*balls, image), plane=table)
    found = surfaces(levels, hull)["levels"]
    assert found.body_count == 1
    assert found.vertices[:, 2].min() < -0.018  # its underside is heard by the images alone
    assert off(found, balls).mean() < 0.25 * RESOLUTION


@pytest.mark.slow
@pytest.mark.parametrize("sources", [around(1), around(60)[:20]], ids=["one pose", "one side"])
def test_few_poses_give_a_surface(sources):
    levels, hull = heard(sources, BALLS[:1])
    assert start_surfaces(levels, hull, BOX / 2, RESOLUTION)["levels"].is_watertight


def formula(place, levels, onsets, table, resolution):
    """What all pairs say about a place, one by one, as ``docs/method.md`` has it."""
    total, behind = np.zeros((KINDS, HARMONICS)), []
    count = 0
    for pose, emitter in enumerate(levels.emitters):
        for ear, receiver in enumerate(levels.receivers[pose]):
            count += 1
            out, back = np.linalg.norm(emitter - place), np.linalg.norm(receiver - place)
            middle = emitter + receiver - 2 * place
            direction = middle / np.linalg.norm(middle)
            c = (out + back) / 2 - onsets[pose, ear]
            behind.append((c, *direction))
            at = ((out + back) / 2 - levels.first) / levels.spacing
            if not 0 <= at < table.shape[2] - 1:
                continue
            low, high, h, below = (
                np.interp(at, np.arange(table.shape[2]), table[pose, ear, :, k]) for k in range(4)
            )
            h += 20 * np.log10(out * back)
            amplitude = 10 ** (np.clip(h, -60, 10) / 20)
            peak, loud = max(0, 1 + below / 3), np.clip((h + 20) / 12, 0, 1)
            onset = np.exp(-((c / (0.35 * resolution)) ** 2))
            bins = np.maximum(0, 1 - np.abs((np.clip(h, -36, 0) + 36) / 6 - np.arange(7)))
            tilt = 1 + np.clip((high - low) / 12, -2, 2)
            kinds = [*bins, peak * (1 - loud), peak * loud, peak * amplitude, onset]
            kinds += [onset * amplitude, c < -0.15 * resolution, amplitude * tilt / 2, 1]
            total += np.outer(kinds, harmonics(direction[None])[0])
    behind = sorted(behind)
    return total / count, [one[0] for one in behind[:4]], behind[0][1:]


def test_the_kernel_is_the_formula():
    random = np.random.default_rng(0)
    emitters = around(7) + random.normal(scale=0.02, size=(7, 3))
    receivers = emitters[:, None] + random.normal(scale=0.01, size=(7, 2, 3))
    power = random.exponential(size=(7, 2, 220, 6))
    levels = RangeLevels.of(
        np.sqrt(power),
        np.arange(7),
        emitters,
        receivers,
        first=0.3,
        spacing=0.001,
        resolution=0.006,
    )
    table = levels.table(np.zeros(3))
    ranges = (np.linalg.norm(emitters, axis=1)[:, None] + np.linalg.norm(receivers, axis=2)) / 2
    onsets = ranges + random.normal(scale=0.002, size=(7, 2))
    near = random.normal(scale=0.002, size=(30, 3))
    places = np.concatenate([near, random.uniform(-0.15, 0.15, (20, 3))])  # some out of range
    given = levels.first, levels.spacing, 0.006
    means, behind, direction = pooled(places, emitters, receivers, onsets, table, *given)
    for place, *found in zip(places, means, behind, direction, strict=True):
        for one, other in zip(found, formula(place, levels, onsets, table, 0.006), strict=True):
            np.testing.assert_allclose(one, other, atol=2e-5)


def test_levels_are_relative_to_the_usual_loudest_one():
    levels, _ = heard(around(40), BALLS[:1])
    table = levels.table(np.zeros(3))
    way = 20 * np.log10(0.4**2)
    np.testing.assert_allclose(table[:, 0, :, 2].max(axis=1), -way, atol=1.5)
    assert table[..., 3].max() == 0.0
    assert table[..., 3].min() == -12.0


@pytest.mark.parametrize("frame", FRAMES)
def test_a_frame_is_the_lattice_turned(frame):
    order, signs = frame
    turn = np.zeros((3, 3))
    turn[np.arange(3), list(order)] = signs
    sources = around(50)
    levels, hull = heard(sources)
    lattice = lattice_of(hull, np.array([[-0.04] * 3, [0.04] * 3]), RESOLUTION)
    none = np.zeros([size // 2 for size in lattice.shape], bool)
    places = features_of(levels, np.arange(50), hull, lattice, none)
    seen, bound = places.in_frame(order, signs)
    assert seen.shape == (FEATURES, *bound.shape)
    balls = tuple((*(turn @ ball[:3]), ball[3]) for ball in BALLS)
    levels, hull = heard(sources @ turn.T, balls)
    steps = np.array([[0, 0, 0], lattice.shape]) - [[0], [1]]
    corners = lattice.origin + lattice.spacing * steps
    other = type(lattice)(
        (corners @ turn.T).min(axis=0), lattice.spacing, tuple(lattice.shape[k] for k in order)
    )
    places = features_of(levels, np.arange(50), hull, other, none.transpose(order))
    expected, expected_bound = places.in_frame(*FRAMES[0])
    np.testing.assert_allclose(seen, expected, atol=2e-3)
    np.testing.assert_allclose(bound, expected_bound, atol=1e-3)


def test_in_free_space_every_second_place_stands_for_those_beside_it():
    levels, hull = heard(around(30))
    lattice = lattice_of(hull, np.array([[-0.04] * 3, [0.04] * 3]), RESOLUTION)
    free = free_places(hull, lattice)
    assert 0.3 < free.mean() < 0.9
    whole = features_of(levels, np.arange(30), hull, lattice, np.zeros_like(free))
    some = features_of(levels, np.arange(30), hull, lattice, free)
    np.testing.assert_array_equal(some.means[~free], whole.means[~free])
    like = tuple(np.argwhere(free).T // 2 * 2)
    np.testing.assert_array_equal(some.means[free], whole.means[like])


def test_the_lattice_has_a_bound_however_large_the_region_is():
    _, hull = heard(around(20))
    lattice = lattice_of(hull, 500 * BOX, RESOLUTION)
    assert np.prod(lattice.shape) < 2 * network.MAX_VOXELS


def test_each_channel_is_a_voxel_of_its_place():
    made = StartNetwork()
    with torch.no_grad():
        made.leave[2].weight.zero_()
        made.leave[2].bias.copy_(torch.arange(8.0))
        found = made(torch.zeros(1, FEATURES, 8, 16, 8), torch.full((1, 8, 16, 8), 0.5))[0]
    x, y, z = np.indices(found.shape) % 2
    np.testing.assert_allclose(found.numpy(), 0.5 + 2.0 * (4 * x + 2 * y + z))


def test_the_level_gives_the_expected_volume():
    steps = np.linalg.norm(np.indices((40, 40, 40)) - 19.5, axis=0) - 12.0
    assert abs(expected_level(steps.clip(-4, 4))) < 0.15  # a sharp surface stays in its place
    wire = np.full((40, 40, 40), 4.0)
    wire[:, 15:21, 15:21] = np.linspace(0.3, 1.5, 36).reshape(6, 6)  # nowhere likelier than air
    chance = 1 / (1 + np.exp(wire[:, 15:21, 15:21] / LOGIT))
    inside = (wire < expected_level(wire)).sum()
    assert inside == pytest.approx(chance.sum(), rel=0.1)


def test_without_room_for_a_body_there_is_no_surface():
    levels, hull = heard(around(60))
    late = dataclasses.replace(hull, first=hull.first + 0.2)
    with pytest.raises(NumericalError, match="no room"):
        start_surfaces(levels, late, BOX, RESOLUTION)


def test_the_weights_fit_the_network():
    state = load_file(network.WEIGHTS)
    assert state.keys() == StartNetwork().state_dict().keys()
    assert all(bool(part.isfinite().all()) for part in state.values())


def test_hollows_are_filled_and_parts_of_few_voxels_left_out():
    distance = np.ones((20, 20, 20), np.float32)
    distance[2:10, 2:10, 2:10] = -1.0
    distance[5, 5, 5] = 1.0
    distance[15, 15, 15:18] = -1.0
    cleaned = without_small_parts(without_hollows(distance))
    assert (cleaned[2:10, 2:10, 2:10] < 0).all()
    assert (cleaned < 0).sum() == 8**3
    assert (without_small_parts(np.where(distance < 0, 1, distance)) > 0).all()
    alone = np.ones_like(distance)
    alone[15, 15, 15:18] = -1.0
    np.testing.assert_array_equal(without_small_parts(alone), alone)


@pytest.mark.parametrize(
    ("sources", "said"),
    [
        (around(80), ""),
        (around(6), "6 training poses are fewer than the 12"),
        (np.tile([[0.1, 0.2, 0.3]], (20, 1)), "within 0 degrees of one direction"),
        (around(400)[:20], "degrees of one direction"),
        (around(400)[:120], ""),
    ],
    ids=["all around", "few", "one place", "narrow cap", "wide cap"],
)
def test_poses_unlike_those_of_the_training_are_told(sources, said):
    size = 10 * RESOLUTION * np.array([[-1.0] * 3, [1.0] * 3])
    found = beyond_training(heard(sources)[0], size)
    assert said in found if said else found == ""
    assert "40 range resolutions large" in beyond_training(heard(sources)[0], 2 * size)
    assert "on a support" in beyond_training(heard(sources)[0], size, support=True)


def test_weights_of_another_version_are_refused(tmp_path, monkeypatch):
    file = tmp_path / "network.safetensors"
    monkeypatch.setattr(network, "WEIGHTS", file)
    for content in (b"", b"none of it", safetensors_bytes({"other": torch.zeros(2)})):
        file.write_bytes(content)
        with pytest.raises(IncompatibleError, match="not the weights of the start network"):
            network.trained_network()
