# SPDX-License-Identifier: MIT
"""Checkpoints: two kept, damage seen, nothing run."""

from __future__ import annotations

import logging
import math
import resource
import zipfile

import numpy as np
import pytest
import torch

from sononerf.errors import InputError, StorageError
from sononerf.field.checkpoint_io import (
    DurableCheckpointIO,
    fault_of,
    load_weights,
    previous_of,
    save_weights,
)


@pytest.fixture
def path(tmp_path):
    io = DurableCheckpointIO()
    for step in range(3):
        io.save_checkpoint({"step": step, "w": torch.full((100,), float(step))}, tmp_path / "c")
    return tmp_path / "c"


def flip(path, offset, bit=0):
    data = bytearray(path.read_bytes())
    data[offset] ^= 1 << bit
    path.write_bytes(data)


def test_the_newest_is_loaded_and_the_one_before_kept(path):
    io = DurableCheckpointIO()
    assert io.load_checkpoint(path)["step"] == 2
    assert io.load_checkpoint(previous_of(path))["step"] == 1
    assert sorted(p.name for p in path.parent.iterdir()) == ["c", "c.previous"]


def test_a_damaged_newest_falls_back_with_a_warning(path, caplog):
    flip(path, path.read_bytes().index(b"\x00\x00\x00\x40" * 20) + 3)  # inside the tensor of twos
    with caplog.at_level(logging.WARNING, "sononerf"):
        assert DurableCheckpointIO().load_checkpoint(path)["step"] == 1
    assert "damaged" in caplog.text
    assert "c.previous" in caplog.text


@pytest.mark.parametrize("content", [b"", b"PK", b"no archive"])
def test_a_torn_newest_falls_back(path, content):
    path.write_bytes(content)
    assert DurableCheckpointIO().load_checkpoint(path)["step"] == 1


def test_a_damaged_one_does_not_replace_the_good_one_before(path):
    path.write_bytes(b"torn")
    io = DurableCheckpointIO()
    io.save_checkpoint({"step": 3}, path)
    assert io.load_checkpoint(path)["step"] == 3
    assert io.load_checkpoint(previous_of(path))["step"] == 1


def test_no_flipped_bit_changes_what_is_loaded(path):
    whole = path.read_bytes()
    previous_of(path).unlink()
    generator = np.random.default_rng(0)
    refused = 0
    for offset in generator.integers(0, len(whole), 200).tolist():
        flip(path, offset, int(generator.integers(8)))
        try:
            content = DurableCheckpointIO().load_checkpoint(path)
        except InputError:
            refused += 1
        else:
            assert content["step"] == 2
            assert torch.equal(content["w"], torch.full((100,), 2.0))
        path.write_bytes(whole)
    assert refused > 100  # most of the file is under a checksum


def test_none_whole_is_one_clear_line(path):
    path.write_bytes(b"torn")
    previous_of(path).write_bytes(b"torn")
    with pytest.raises(InputError, match="no whole one before it") as caught:
        DurableCheckpointIO().load_checkpoint(path)
    assert "\n" not in str(caught.value)


class Payload:
    def __reduce__(self):
        return print, ("code ran",)


def test_code_is_refused_whatever_the_caller_asks(path, capsys):
    torch.save({"step": 0, "evil": Payload()}, path)
    with pytest.raises(InputError, match="no checkpoint of plain data") as caught:
        DurableCheckpointIO().load_checkpoint(path, weights_only=False)
    assert "\n" not in str(caught.value)
    assert "code ran" not in capsys.readouterr().out


def test_a_full_disk_is_a_storage_error_and_keeps_both(path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(StorageError, match="size limit"):
            DurableCheckpointIO().save_checkpoint({"w": torch.ones(100_000)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [fault_of(path), fault_of(previous_of(path))] == [None, None]
    assert sorted(p.name for p in path.parent.iterdir()) == ["c", "c.previous"]


class _Refusing:
    def __reduce__(self):
        raise RuntimeError("of its own")


def test_other_errors_in_saving_stay_themselves(path):
    with pytest.raises(Exception, match="pickle"):
        DurableCheckpointIO().save_checkpoint({"f": lambda: 0}, path)
    with pytest.raises(RuntimeError, match="of its own"):
        DurableCheckpointIO().save_checkpoint({"f": _Refusing()}, path)
    assert DurableCheckpointIO().load_checkpoint(path)["step"] == 2


@pytest.mark.parametrize("url", ["https://host/c", "memory://c", "zip::c"])
def test_urls_are_refused(url):
    io = DurableCheckpointIO()
    for call in (io.load_checkpoint, io.remove_checkpoint, lambda u: io.save_checkpoint({}, u)):
        with pytest.raises(InputError, match="URL"):
            call(url)


def test_remove_takes_both(path):
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


def test_every_bit_of_an_archives_directory_is_checked(tmp_path):
    """Its own checksums do not reach there, and torch reads other numbers after some flips."""
    path = tmp_path / "last.ckpt"
    DurableCheckpointIO().save_checkpoint({"state_dict": {"w": torch.arange(200.0)}}, path)
    assert fault_of(path) is None
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        start = archive.start_dir
    unsigned = []
    for place in range(start, len(data)):
        for bit in range(8):
            changed = bytearray(data)
            changed[place] ^= 1 << bit
            path.write_bytes(changed)
            if fault_of(path) is None:
                unsigned.append(place - len(data))
                found = DurableCheckpointIO().load_checkpoint(path)
                assert torch.equal(found["state_dict"]["w"], torch.arange(200.0))
    # Without its length the signature is none, and nothing else has changed.
    assert set(unsigned) <= {-34, -33}


def test_a_checkpoint_of_an_older_version_is_read(tmp_path):
    torch.save({"state_dict": {"w": torch.ones(3)}}, tmp_path / "last.ckpt")
    found = DurableCheckpointIO().load_checkpoint(tmp_path / "last.ckpt")
    assert torch.equal(found["state_dict"]["w"], torch.ones(3))
