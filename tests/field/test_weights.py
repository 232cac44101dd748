# SPDX-License-Identifier: MIT
"""What is handed on: data with a checksum, or one clear line."""

from __future__ import annotations

import hashlib
import json

import pytest
import torch

from sononerf.errors import IncompatibleError, InputError
from sononerf.field.checkpoint_io import (
    DESCRIPTION_NAME,
    WEIGHTS_NAME,
    load_weights,
    model_checksum,
    save_weights,
)

STATE = {"grid": torch.arange(6.0).reshape(2, 3).T, "bias": torch.ones(2, dtype=torch.complex64)}


@pytest.fixture
def folder(tmp_path):
    save_weights(tmp_path, STATE, {"field": {"kind": "grid"}})
    return tmp_path


def test_round_trip(folder):
    assert (
        model_checksum(folder) == hashlib.sha256((folder / WEIGHTS_NAME).read_bytes()).hexdigest()
    )
    state, description = load_weights(folder)
    assert state.keys() == STATE.keys()
    for name, tensor in STATE.items():
        assert torch.equal(state[name], tensor)
    assert description["field"] == {"kind": "grid"}
    assert description["schema_version"] == 1


def test_same_weights_same_bytes(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    save_weights(other, STATE, {"field": {"kind": "grid"}})
    for name in (WEIGHTS_NAME, DESCRIPTION_NAME):
        assert (folder / name).read_bytes() == (other / name).read_bytes()


def test_every_flipped_byte_is_refused(folder):
    path = folder / WEIGHTS_NAME
    whole = path.read_bytes()
    for offset in range(0, len(whole), 7):
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 1]) + whole[offset + 1 :])
        with pytest.raises(InputError, match="damaged"):
            load_weights(folder)


def test_missing_files_are_named(folder):
    (folder / WEIGHTS_NAME).unlink()
    with pytest.raises(InputError, match=WEIGHTS_NAME):
        load_weights(folder)
    (folder / DESCRIPTION_NAME).unlink()
    with pytest.raises(InputError, match=DESCRIPTION_NAME):
        load_weights(folder)


@pytest.mark.parametrize(
    ("version", "error"), [(2, IncompatibleError), (0, InputError), ("1", InputError)]
)
def test_other_schema_versions_are_refused(folder, version, error):
    path = folder / DESCRIPTION_NAME
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": version}))
    with pytest.raises(error, match="schema_version"):
        load_weights(folder)
