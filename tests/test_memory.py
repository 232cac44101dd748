# SPDX-License-Identifier: MIT
from sononerf.memory import available_memory


def test_available_memory_is_plausible():
    free = available_memory()
    assert free is None or 10_000_000 < free < 10**15
