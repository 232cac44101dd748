# SPDX-License-Identifier: MIT
"""Examples and training of the start network."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import load_file

from sononerf.errors import InputError
from sononerf.geometry.lattice import Lattice
from sononerf.surface.start.features import FEATURES
from sononerf.surface.start.network import StartNetwork
from tools.learning import examples, training
from tools.learning.bodies import KINDS, body
from tools.learning.examples import draw, load_example, make_example, true_distance
from tools.learning.training import train, weights_file

RADIUS = 0.02


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One example: a ball, heard from few poses."""
    there = tmp_path_factory.mktemp("examples")
    meshes = tmp_path_factory.mktemp("meshes")
    trimesh.creation.icosphere(4, RADIUS).export(meshes / "ball.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(examples, "POSES", 16)
        patch.setattr(examples, "VALIDATING", 2)
        assert make_example(0, there, meshes).startswith("0: ball, ")
    assert make_example(0, there, meshes) == "0: is there"
    return there


@pytest.mark.thorough
def test_an_example_keeps_levels_and_truth(folder):
    example = load_example(folder / "0.npz")
    assert (example.kind, example.number) == ("ball", 0)
    assert example.levels.level.shape[:2] == (14, 2)
    assert np.isfinite(example.onsets).mean() > 0.8
    middle = np.linalg.norm(example.lattice.points(), axis=1) < RADIUS
    assert ((example.true < 0).ravel() == middle).mean() > 0.99


@pytest.mark.thorough
def test_a_drawn_crop_is_turned_as_its_truth(folder, monkeypatch):
    example = load_example(folder / "0.npz")
    monkeypatch.setattr(examples, "_noisy", lambda level, random: level)
    for seed in range(3):
        crop = draw(example, np.random.default_rng(seed), 16)
        features, bound, true = crop.turned((1, 2, 0), (1, -1, 1))
        assert features.shape == (FEATURES, 16, 16, 16)
        assert true.shape == (32, 32, 32)
        if (true < -1).any():  # inside no place is in front of the onsets by much
            inside = true.reshape(16, 2, 16, 2, 16, 2).max(axis=(1, 3, 5)) < -1
            assert bound[inside].mean() < 0
            assert bound[inside].mean() < bound[~inside].mean()


@pytest.mark.slow
def test_training_lowers_the_loss_goes_on_and_is_read_again(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "BATCH", 1)
    monkeypatch.setattr(training, "WARM", 1)
    said = []
    train(folder, steps=6, seed=0, side=16, tell=said.append)
    network = train(folder, steps=30, seed=0, side=16, tell=said.append)
    assert said[0].startswith("step 6 of 6")
    assert said[-1].startswith("step 30 of 30")
    assert float(said[-1].split()[-1]) < 0.8 * float(said[0].split()[-1])
    weights_file(network, tmp_path / "weights.safetensors")
    state = load_file(tmp_path / "weights.safetensors")
    for name, part in network.state_dict().items():
        torch.testing.assert_close(state[name].float(), part, atol=1e-3, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_further_training_keeps_its_share_of_the_weights(folder, tmp_path, monkeypatch, share):
    monkeypatch.setattr(training, "BATCH", 1)
    monkeypatch.setattr(training, "WARM", 1)
    monkeypatch.setattr(training, "OLD", share)
    there = tmp_path / "examples"
    there.mkdir()
    (there / "0.npz").write_bytes((folder / "0.npz").read_bytes())
    start = StartNetwork()
    before = [part.detach().clone() for part in start.parameters()]
    after = train(there, steps=2, seed=0, side=16, start=start, tell=lambda line: None).parameters()
    same = [bool((old == new).all()) for old, new in zip(before, after, strict=True)]
    assert all(same) == (share == 1.0)


def test_without_examples_nothing_is_trained(tmp_path):
    with pytest.raises(InputError, match="no examples to train on"):
        train(tmp_path, steps=1, seed=0, tell=lambda line: None)


def test_a_new_network_adds_nothing_but_its_last_layer_to_the_bound():
    network = StartNetwork()
    with torch.no_grad():
        for part in network.leave[2].parameters():
            part.zero_()
        found = network(torch.zeros(1, FEATURES, 8, 8, 8), torch.full((1, 8, 8, 8), -1.5))
    np.testing.assert_allclose(found.numpy(), -1.5)


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
