# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from sononerf.refinement.optics import Optics
from sononerf.refinement.remesh import unit
from sononerf.refinement.tracer import StillSurface
from sononerf.run.simulate import head_of
from sononerf.simulation.hearing import hearing_of
from tests.refinement.conftest import RADIUS, given


def hear(optics, mesh, poses):
    surface = StillSurface(mesh, optics)
    pieces, heads, middle = surface.listen(poses.positions, poses.rotations)
    area = surface.operators.areas(surface.vertices)
    return pieces, heads, (surface.vertices - middle).float(), area.float()


@pytest.mark.parametrize(
    ("call", "front"),
    [
        ({"kind": "impulse"}, "stft"),
        ({"kind": "impulse"}, "on a support"),
        ({"kind": "linear"}, "stft"),
        ({"kind": "linear", "frequency_end": 25e3, "harmonics": [1.0, 0.5]}, "stft"),
        ({"kind": "impulse"}, "gammatone"),
    ],
)
def test_a_sphere_sounds_as_the_simulator_says(call, front, ball, poses, simulated):
    support = {"point": (0.0, 0.0, -1.5 * RADIUS)} if front == "on a support" else {}
    kind = "stft" if support else front
    spectrogram = {"range_min": 0.2, "range_max": 0.4, "kind": kind}
    settings = given(call=call, spectrogram=spectrogram, support=support)
    optics = Optics(head_of(settings))
    fine = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    wanted = simulated(fine, settings, poses)
    found = StillSurface(fine, optics).render(poses.positions, poses.rotations)
    high = optics.frequencies > 40e3
    errors = []
    for a, b in zip(found[..., high], wanted[..., high], strict=True):
        floor = b.max() / 10
        a, b = 20 * np.log10(1 + a / floor), 20 * np.log10(1 + b / floor)
        errors.append(np.abs(a - b)[(a >= 3) | (b >= 3)].mean())
    assert np.mean(errors) < 0.7


def test_gradients_are_those_of_finite_differences(optics, ball, poses):
    pieces, heads, points, area = hear(optics, ball, poses)
    normals = unit(area)
    way = torch.as_tensor(np.random.default_rng(0).standard_normal(len(points))).float()
    way = (way * (points[:, 2] > 0))[:, None] * normals

    floor = 1e-3 * optics.render(points, area, pieces, heads).power.max()

    def value(points, area):
        heard = optics.render(points, area, pieces, heads)
        return torch.log(heard.power + floor).double().mean()

    points.requires_grad_(True)
    area.requires_grad_(True)
    value(points, area).backward()
    step = 3e-5
    with torch.no_grad():
        ends = [float(value(points + sign * step * way, area)) for sign in (1, -1)]
        wanted = (ends[0] - ends[1]) / (2 * step)
        assert float((points.grad * way).sum()) == pytest.approx(wanted, rel=0.1)
        grown = area * way.norm(dim=1, keepdim=True)
        ends = [float(value(points, area + sign * 0.02 * grown)) for sign in (1, -1)]
        wanted = (ends[0] - ends[1]) / 0.04
        assert float((area.grad * grown).sum()) == pytest.approx(wanted, rel=0.05)


def test_a_plate_seen_straight_on_is_at_its_mirror_point_and_one_on_edge_is_not(optics):
    points = torch.tensor([[0.0, 0.0, 0.0]])
    head = torch.tensor([[0.3, 0.0, 0.0]])
    flat = torch.zeros(1, 6)
    on = optics.near_mirror(points, torch.tensor([[1e-6, 0.0, 0.0]]), flat, head, head)
    slant = optics.near_mirror(points, torch.tensor([[0.8e-6, 0.6e-6, 0.0]]), flat, head, head)
    away = optics.near_mirror(points, torch.tensor([[-1e-6, 0.0, 0.0]]), flat, head, head)
    assert bool(on[0])
    assert bool(slant[0])
    assert not bool(away[0])
    assert float(on[4]) < 1e-6
    # The path's slope is 1.2, and over the plate it bends by twice cos² of 37 degrees over 0.3 m.
    assert float(slant[2]) == pytest.approx(0.5 * 1.2**2 / (2 * 0.8**2 / 0.3), rel=0.02)


def test_a_piece_whose_squared_area_is_zero_in_single_precision_is_no_error(optics):
    place, tiny = (
        torch.tensor([[0.015, 0.033, -0.002]]),
        torch.tensor([[-1.44e-23, -1.32e-23, 0.0]]),
    )
    emitter, ear = torch.tensor([[-0.349, 0.141, -0.130]]), torch.tensor([[-0.358, 0.157, -0.122]])
    found = optics.near_mirror(place, tiny, torch.zeros(1, 6), emitter, ear)
    assert all(bool(torch.isfinite(part).all()) for part in found[1:])


def test_gains_are_those_of_the_tables(optics):
    ears = hearing_of(optics.head).ears
    row, column = 40, 100
    level = np.cos(ears.elevation[row])
    way = [
        level * np.cos(ears.azimuth[column]),
        level * np.sin(ears.azimuth[column]),
        np.sin(ears.elevation[row]),
    ]
    found = optics.gains(torch.tensor([1]), torch.tensor([way]).float(), torch.eye(3)[None])
    assert np.allclose(found[0], ears.ears[0, optics.kept_nodes, row, column], rtol=2e-3)
