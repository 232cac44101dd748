# SPDX-License-Identifier: MIT
"""Checkpoints: whole or the old one, nothing run."""

from __future__ import annotations

import math
import resource

import pytest
import torch

from sononerf.errors import InputError, StorageError
from sononerf.field.checkpoint_io import DurableCheckpointIO, load_weights, save_weights


@pytest.fixture
def path(tmp_path):
    io = DurableCheckpointIO()
    for step in range(3):
        io.save_checkpoint({"step": step, "w": torch.full((100,), float(step))}, tmp_path / "c")
    return tmp_path / "c"


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive"])
def test_a_damaged_one_is_one_clear_line(path, content):
    path.write_bytes(content)
    with pytest.raises(InputError, match="start the fit again with --overwrite") as caught:
        DurableCheckpointIO().load_checkpoint(path)
    assert "\n" not in str(caught.value)


def test_a_full_disk_is_a_storage_error_and_keeps_the_old_one(path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(StorageError, match="size limit"):
            DurableCheckpointIO().save_checkpoint({"w": torch.ones(100_000)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert DurableCheckpointIO().load_checkpoint(path)["step"] == 2
    assert [p.name for p in path.parent.iterdir()] == ["c"]


def test_remove_leaves_nothing(path):
    DurableCheckpointIO().remove_checkpoint(path)
    assert list(path.parent.iterdir()) == []


def test_nan_in_weights_is_refused_with_their_name(path):
    state = {"field.table": torch.tensor([1.0, math.nan]), "hull.first": torch.tensor([-math.inf])}
    DurableCheckpointIO().save_checkpoint({"state_dict": state}, path)
    with pytest.raises(InputError, match=r"field\.table holds NaN; repeat the fit"):
        DurableCheckpointIO().load_checkpoint(path)
    save_weights(path.parent, state, {"echo_hash": "x"})
    with pytest.raises(InputError, match=r"model\.safetensors: field\.table holds NaN"):
        load_weights(path.parent)
