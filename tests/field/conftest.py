# SPDX-License-Identifier: MIT
"""A head whose gains are known in closed form, so that a slow loop can do without tables."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sononerf.field.field import Field
from sononerf.geometry.meshes import Plane
from sononerf.head.head import PointEcho


class Head:
    """Numbers and formulas; a table is exact where gains are bilinear in the two angles."""

    frequency = np.array([30e3, 50e3, 80e3])
    alpha = np.array([0.1, 0.2, 0.4])  # Np/m
    emitter = np.array([0.002, 0.0, -0.010])
    ears = np.array([[-0.010, 0.010, 0.005], [-0.010, -0.010, 0.005]])
    window = np.hamming(64)
    rate, speed = 1e6, 343.0
    per_sample = speed / rate / 2
    step = 4 * per_sample
    range = 0.25 + np.arange(120) * step

    @staticmethod
    def beam(azimuth, elevation):
        """Gain of the emission, (F,), over angles in parts of a straight one and a right one."""
        shape = (1.0 - 0.4 * abs(azimuth)) * (1.0 - 0.3 * elevation)
        return np.array([1.0, 1.5, 0.5]) * shape

    @staticmethod
    def ear(number, azimuth, elevation):
        """Gain of one ear, (F,)."""
        slope = (1, -1)[number] * np.array([0.2, 0.5, 0.7])
        return (1.0 + slope * azimuth) * (1.0 + 0.2 * elevation)

    @classmethod
    def towards(cls, vector):
        """Gains of the beam, (F,), and of both ears, (E, F), towards a vector in the head frame."""
        x, y, z = vector / np.linalg.norm(vector)
        unit = math.atan2(y, x) / math.pi, math.asin(z) / (math.pi / 2)
        return cls.beam(*unit), np.stack([cls.ear(number, *unit) for number in (0, 1)])


@dataclass(frozen=True)
class Listener:
    """What a renderer reads of a head, as tensors in double precision."""

    frequency: torch.Tensor
    range: torch.Tensor
    window: torch.Tensor
    sampling_rate: float
    speed_of_sound: float
    row_absorption: torch.Tensor
    row_gains: SimpleNamespace
    emitter: torch.Tensor
    receivers: torch.Tensor
    resolution: float
    lag: torch.Tensor | None = None
    plane: Plane | None = None


def table(gain):
    values = [[gain(a, e) for a in np.linspace(-1, 1, 181)] for e in np.linspace(-1, 1, 91)]
    return torch.from_numpy(np.array(values)).permute(2, 0, 1).contiguous()  # (F, L, A)


class Formula(Field):
    """A field given by a function of places and directions, on a lattice of its own spacing."""

    def __init__(self, region, frequency, function, spacing=0.005):
        super().__init__(region, frequency)
        self.function, self.spacing = function, spacing

    @property
    def resolution(self):
        return self.spacing

    def forward(self, positions, directions):
        return self.function(positions, directions) * self.inside(positions)[..., None]


class Pair(torch.nn.Module):
    """Field and renderer in one, so that gradients are checked in all parameters at once."""

    def __init__(self, field, renderer):
        super().__init__()
        self.field, self.renderer = field, renderer

    def forward(self, *given):
        return self.renderer(self.field, *given)


def check_gradients(field, renderer, *given):
    """Compare gradients in all parameters with finite differences, in double precision."""
    pair = Pair(field, renderer).double()
    names = [name for name, _ in pair.named_parameters()]

    def heard(*values):
        return torch.func.functional_call(pair, dict(zip(names, values, strict=True)), given)

    assert heard(*pair.parameters()).detach().max() > 1e-6
    return torch.autograd.gradcheck(heard, tuple(pair.parameters()), fast_mode=True)


@pytest.fixture(scope="session")
def gradients_are_right():
    return check_gradients


@pytest.fixture(scope="session")
def head():
    return Head


@pytest.fixture(scope="session")
def formula():
    return Formula


@pytest.fixture(scope="session")
def listener():
    """That head as a renderer reads it."""
    ears = [table(lambda a, e, n=number: Head.ear(n, a, e)) for number in (0, 1)]
    return Listener(
        frequency=torch.from_numpy(Head.frequency),
        range=torch.from_numpy(Head.range),
        window=torch.from_numpy(Head.window).expand(3, -1),
        sampling_rate=Head.rate,
        speed_of_sound=Head.speed,
        row_absorption=torch.from_numpy(Head.alpha),
        row_gains=SimpleNamespace(beam=table(Head.beam), ears=torch.stack(ears)),
        emitter=torch.from_numpy(Head.emitter),
        receivers=torch.from_numpy(Head.ears),
        resolution=PointEcho(Head.window**2, Head.per_sample, 1.0).resolution,
    )
