# SPDX-License-Identifier: MIT
"""What a step costs is measured, grows with the batch, and leaves the module as it was."""

from __future__ import annotations

import numpy as np
import torch

from sononerf.echoes.echoes import Echoes
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.fitting import step_cost
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.settings.schema import SpectrogramSettings


def echoes():
    """Twenty poses that hear a point at the origin."""
    head = Head(spectrogram=SpectrogramSettings(range_min=0.25, range_max=0.35))
    places = 0.3 * np.random.default_rng(0).normal(size=(20, 3))
    places *= 0.3 / np.linalg.norm(places, axis=1, keepdims=True)
    loud = np.exp(-(((head.range - 0.3) / 0.004) ** 2))
    heard = np.broadcast_to(loud[None, None, :, None], (20, 2, len(loud), len(head.frequency)))
    return Echoes.from_arrays(heard, Poses.looking_at(places), head)


def test_it_grows_with_the_batch_and_changes_nothing():
    given = echoes()
    module = EchoModule.for_echoes(given, region=((-0.02,) * 3, (0.02,) * 3))
    before = {name: values.clone() for name, values in module.state_dict().items()}
    drawn = torch.random.get_rng_state()
    few, many = (
        step_cost(module, EchoDataModule(given, {"batch_poses": count})) for count in (1, 16)
    )
    parameters = sum(each.numel() * each.element_size() for each in module.parameters())
    assert few.memory > 4 * parameters
    own, others = few.memory - 4 * parameters, many.memory - 4 * parameters
    np.testing.assert_allclose(others, 16 * own, rtol=0.2)
    assert 0.0 < few.seconds < 10.0
    assert all(torch.equal(values, before[name]) for name, values in module.state_dict().items())
    assert torch.equal(torch.random.get_rng_state(), drawn)
