# SPDX-License-Identifier: MIT
from types import SimpleNamespace

import pytest
import torch

from sononerf.callbacks import epoch as threads
from sononerf.callbacks.epoch import WORTH_THREADS, ThreadsCallback


@pytest.fixture
def two_threads(monkeypatch):
    monkeypatch.setattr(threads, "echo_module", lambda module: module)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("places", "poses", "costly", "expected"),
    [
        (WORTH_THREADS // 4 - 1, 4, False, 1),
        (WORTH_THREADS // 4, 4, False, 2),
        (100, 4, True, 2),  # a network
        (None, 4, False, 2),  # not known: as torch would
    ],
)
def test_small_steps_take_one_thread(two_threads, places, poses, costly, expected):
    callback = ThreadsCallback()
    module = SimpleNamespace(
        renderer=SimpleNamespace(places_per_pose=places), field=SimpleNamespace(costly=costly)
    )
    callback.on_train_batch_start(None, module, SimpleNamespace(pose=range(poses)), 0)
    assert torch.get_num_threads() == expected
    callback.teardown(None, module, "fit")
    assert torch.get_num_threads() == 2
