# SPDX-License-Identifier: MIT
"""How a run's surface is best found is remembered of one fit alone."""

from __future__ import annotations

import json

import pytest
import safetensors.torch
import torch

from sononerf.experiment.borne_out import NAME, borne_out


@pytest.fixture
def run(tmp_path):
    (tmp_path / "model.json").write_text(json.dumps({"sha256": "a" * 64}))
    return tmp_path


def remember(run, model="a" * 64, **tensors):
    (run / NAME).write_bytes(safetensors.torch.save(tensors, {"model": model}))


def test_the_hull_is_remembered(run):
    assert borne_out(run) == "auto"  # nothing was found out yet
    remember(run, hull=torch.tensor(True))
    assert borne_out(run) == "hull"
    remember(run, hull=torch.tensor(False))
    assert borne_out(run) == "auto"
    remember(run, share=torch.tensor(1.0))  # of before there was a choice
    assert borne_out(run) == "auto"


def test_of_another_fit_nothing_is_remembered(run):
    remember(run, hull=torch.tensor(True), model="b" * 64)
    assert borne_out(run) == "auto"


@pytest.mark.parametrize("tensors", [{}, {"hull": torch.tensor([True, False])}])
def test_what_is_damaged_tells_nothing(run, tensors):
    remember(run, **tensors)
    data = (run / NAME).read_bytes()
    (run / NAME).write_bytes(data if tensors else data[:20])
    assert borne_out(run) == "auto"
