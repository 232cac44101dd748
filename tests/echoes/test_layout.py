# SPDX-License-Identifier: MIT
"""Layout of a store: zarr's writing goes through the one write path."""

from __future__ import annotations

import asyncio

import pytest
from zarr.core.buffer import default_buffer_prototype

from sononerf.echoes.layout import DurableStore


def test_a_store_of_zarr_commits_and_keeps_what_is_there(tmp_path):
    first, second = (default_buffer_prototype().buffer.from_bytes(x) for x in (b"one", b"two"))
    store = DurableStore(tmp_path)
    asyncio.run(store.set("a/key", first))
    asyncio.run(store.set_if_not_exists("a/key", second))
    assert (tmp_path / "a" / "key").read_bytes() == b"one"
    asyncio.run(store.set_if_not_exists("b/key", second))
    assert (tmp_path / "b" / "key").read_bytes() == b"two"
    reading = DurableStore(tmp_path, read_only=True)
    with pytest.raises(ValueError, match="read-only"):
        reading.set_sync("a/key", second)
    assert (tmp_path / "a" / "key").read_bytes() == b"one"
