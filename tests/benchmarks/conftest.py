# SPDX-License-Identifier: MIT
from __future__ import annotations

import functools

import pytest

from sononerf.head import head as head_module


@pytest.fixture(scope="module")
def quick_ears():
    """Ears take a second each time, and most settings have the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(head_module, "analysed_ears", functools.cache(head_module.analysed_ears))
        yield
