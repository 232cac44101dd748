# SPDX-License-Identifier: MIT
"""The start surface of the network: what it sees, what it gives, and how it is trained."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file

from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.range_levels import RangeLevels
from sononerf.errors import InputError, NumericalError
from sononerf.geometry.lattice import Lattice
from sononerf.geometry.plane import Plane
from sononerf.surface.start import learned
from sononerf.surface.start.evidence import Evidence
from sononerf.surface.start.learned import (
    BLOCK,
    FEATURES,
    LOGIT,
    OPEN,
    VECTORS,
    StartNetwork,
    expected_level,
    features,
    lattice_of,
)
from sononerf.surface.start.occupancy import Gathered, clearance_grid
from tools.learning.bodies import KINDS, body
from tools.learning.examples import true_distance
from tools.learning.training import Example, crop, loss, train, weights_file

RADIUS, RESOLUTION = 0.02, 0.006


def around(count, distance=0.4):
    number = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * number / count), np.pi * (1 + 5**0.5) * number
    way = np.column_stack(
        (np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar))
    )
    return distance * way


def sphere_heard(count=200, scale=1.0):
    """Evidence of a sphere: each pose hears the point next to it, and its onset is there."""
    sources = around(count) * scale
    way = sources / np.linalg.norm(sources, axis=1, keepdims=True)
    radius = RADIUS * scale
    first = np.linalg.norm(sources, axis=1)[:, None] - radius
    hull = EchoHull(sources, sources[:, None], first, -way)
    evidence = Evidence(radius * way, way, np.ones(count), np.arange(count))
    lattice = Lattice.over(np.full(3, -0.04 * scale), np.full(3, 0.04 * scale), 0.002 * scale)
    bound = (-clearance_grid(hull, lattice) / lattice.spacing).astype(np.float32)
    thin = np.zeros(lattice.shape, np.float32)
    resolution = RESOLUTION * scale
    ranges = scale * (0.3 + 0.001 * np.arange(200))
    pulse = np.exp(-(((ranges - first) / (0.4 * resolution)) ** 2))
    levels = RangeLevels.of(
        pulse[:, None, :, None],
        sources,
        sources[:, None],
        first=ranges[0],
        spacing=ranges[1] - ranges[0],
        resolution=resolution,
    )
    weight = np.ones(count)
    return Gathered(
        evidence, weight, evidence.points, lattice, thin, bound, hull, resolution, levels
    )


def gap(sources, plane=None):
    first = np.linalg.norm(sources, axis=1)[:, None] - RADIUS
    hull = EchoHull(sources, sources[:, None], first, -sources, plane=plane)
    return learned.gap_of_poses(hull, np.zeros(3))


@pytest.mark.parametrize("count", [12, 100, 400])
def test_poses_from_all_around_leave_no_gap(count):
    random = np.random.default_rng(count).standard_normal((count, 3))
    assert gap(around(count)) < 1.0
    assert 0.5 < gap(0.4 * trimesh.unitize(random)) < learned.GAP


def test_the_image_of_a_support_closes_the_gap_below_it():
    above = around(200)[:100]
    table = Plane((0.0, 0.0, -RADIUS), (0.0, 0.0, 1.0))
    assert gap(above, table) < learned.GAP < gap(above)


def test_the_network_is_not_asked_about_what_was_heard_from_a_ring():
    known = sphere_heard()
    low = np.abs(known.hull.emitters[:, 2]) < 0.2
    first = np.where(low[:, None], known.hull.first, -np.inf)
    hull = EchoHull(known.hull.emitters, known.hull.receivers, first, known.hull.axes)
    with pytest.raises(NumericalError, match="from all around"):
        learned.learned_surface(dataclasses.replace(known, hull=hull))


def test_a_sphere_is_seen_as_one():
    found = learned.learned_surface(sphere_heard())
    assert found.is_watertight
    assert found.body_count == 1
    off = np.abs(np.linalg.norm(found.vertices, axis=1) - RADIUS)
    assert off.mean() < 0.25 * RESOLUTION


def test_the_network_sees_lengths_in_range_resolutions():
    one, large = sphere_heard(), sphere_heard(scale=3.0)
    a, b = lattice_of(one), lattice_of(large)
    assert a.shape == b.shape
    assert all(size % BLOCK == 0 for size in a.shape)
    assert b.spacing == pytest.approx(3 * a.spacing)
    seen = features(one, a)
    assert seen.shape == (FEATURES, *a.shape)
    # Rounding decides to which voxel a place on a line of sight belongs, here and there.
    off = np.abs(features(large, b) - seen)
    assert off.mean() < 1e-4
    assert np.quantile(off, 0.999) < 0.01


def test_a_large_body_gets_a_coarser_lattice(monkeypatch):
    monkeypatch.setattr(learned, "LARGEST", 4000)
    known = sphere_heard()
    assert np.prod(lattice_of(known).shape) < 20_000
    assert learned.learned_surface(known).is_watertight


def test_each_channel_of_a_block_is_a_voxel_of_it():
    network = StartNetwork()
    with torch.no_grad():
        network.leave.weight.zero_()
        network.leave.bias.copy_(torch.arange(8.0))
        found = network(torch.zeros(1, FEATURES, BLOCK, 2 * BLOCK, BLOCK))[0]
    assert found.shape == (BLOCK, 2 * BLOCK, BLOCK)
    x, y, z = np.indices(found.shape) % 2
    np.testing.assert_array_equal(found.numpy(), 2.0 * (4 * x + 2 * y + z))


def test_an_untrained_network_gives_the_mean_of_open_and_filled():
    seen = torch.zeros(1, FEATURES, BLOCK, BLOCK, BLOCK)
    seen[:, OPEN], seen[:, OPEN + 1] = 0.5, -0.1
    with torch.no_grad():
        found = StartNetwork()(seen)
    np.testing.assert_allclose(found.numpy(), 0.2 * 1.5 / learned.VOXEL, rtol=1e-5)


def test_the_level_gives_the_expected_volume():
    steps = np.linalg.norm(np.indices((40, 40, 40)) - 19.5, axis=0) - 12.0
    assert abs(expected_level(steps.clip(-4, 4))) < 0.15  # a sharp surface stays in its place
    wire = np.full((40, 40, 40), 4.0)
    wire[:, 15:21, 15:21] = np.linspace(0.3, 1.5, 36).reshape(6, 6)  # nowhere likelier than air
    chance = 1 / (1 + np.exp(wire[:, 15:21, 15:21] / LOGIT))
    inside = (wire < expected_level(wire)).sum()
    assert inside == pytest.approx(chance.sum(), rel=0.1)


def test_many_points_are_seen_as_few_of_the_same_density(monkeypatch):
    known = sphere_heard()
    lattice = lattice_of(known)
    whole = features(known, lattice)
    monkeypatch.setattr(learned, "MOST", 100)
    some = features(known, lattice)
    assert some[9].sum() == pytest.approx(whole[9].sum(), rel=0.2)


def test_without_room_for_a_body_there_is_no_surface():
    known = sphere_heard()
    with pytest.raises(NumericalError, match="no room"):
        learned.learned_surface(dataclasses.replace(known, bound=known.bound + 100))


def test_without_the_echoes_there_is_no_surface():
    with pytest.raises(NumericalError, match="needs the echoes"):
        learned.learned_surface(dataclasses.replace(sphere_heard(), levels=None))


def test_a_crop_turns_its_vectors_with_it():
    lattice = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), 0.0008)
    true = true_distance(trimesh.creation.icosphere(3, RADIUS), lattice)
    true += np.tensordot([0.1, -0.3, 0.2], np.indices(true.shape), 1)
    seen = np.zeros((FEATURES, *true.shape))
    for vector in range(VECTORS):
        first = FEATURES - 3 * (VECTORS - vector)
        seen[first : first + 3] = np.gradient(true)
    example, random = Example(seen, true, "blob", 0), np.random.default_rng(1)
    inner = (slice(25, 40),) * 3
    for _ in range(8):
        made, aim = crop(example, random)
        for vector in range(VECTORS):
            first = FEATURES - 3 * (VECTORS - vector)
            for axis, slope in enumerate(np.gradient(aim.astype(np.float64))):
                np.testing.assert_allclose(made[first + axis][inner], slope[inner], atol=0.1)


def test_the_weights_are_small_and_fit_the_network():
    assert learned.WEIGHTS.stat().st_size < 5_000_000
    state = load_file(learned.WEIGHTS)
    assert state.keys() == StartNetwork().state_dict().keys()
    assert all(bool(part.isfinite().all()) for part in state.values())


@pytest.mark.parametrize("seed", range(len(KINDS)))
def test_a_body_is_closed_and_that_of_its_seed(seed):
    kind, mesh = body(seed)
    assert kind == KINDS[seed].__name__
    assert mesh.is_watertight
    assert mesh.volume > 0
    np.testing.assert_array_equal(body(seed)[1].vertices, mesh.vertices)


def test_the_true_distance_is_negative_inside():
    lattice = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), 0.002)
    found = true_distance(trimesh.creation.icosphere(4, RADIUS), lattice)
    expected = (np.linalg.norm(lattice.points(), axis=1) - RADIUS) / 0.002
    np.testing.assert_allclose(found.ravel(), np.minimum(expected, 6.0).clip(-6.0), atol=0.05)


def test_without_examples_nothing_is_trained():
    with pytest.raises(InputError, match="no examples to train on"):
        train([], steps=1, seed=0, tell=lambda line: None)


@pytest.mark.slow
def test_training_lowers_the_loss_and_its_weights_are_read_again(tmp_path):
    known = sphere_heard(60)
    lattice = lattice_of(known)
    seen = features(known, lattice).astype(np.float16)
    true = true_distance(trimesh.creation.icosphere(4, RADIUS), lattice).astype(np.float16)
    seen[OPEN : OPEN + 2] += 0.3  # as if both beliefs made the body too small
    examples = [Example(seen, true, "blob", seed) for seed in (0, 4)]
    network = train(examples, steps=60, seed=0, tell=lambda line: None)
    given, aim = torch.from_numpy(seen.astype(np.float32))[None], torch.from_numpy(true)[None]
    with torch.no_grad():
        made = (StartNetwork()(given), network(given))
    before, after = (float(loss(found, aim.float())) for found in made)
    assert after < 0.7 * before
    weights_file(network, tmp_path / "weights.safetensors")
    state = load_file(tmp_path / "weights.safetensors")
    for name, part in network.state_dict().items():
        torch.testing.assert_close(state[name].float(), part, atol=1e-3, rtol=1e-3)
