# SPDX-License-Identifier: MIT
from __future__ import annotations

import functools

import pytest

from sononerf.run import build


@pytest.fixture(scope="module")
def quick_ears():
    """Ears take a second each time, and most settings have the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "analysed_ears", functools.cache(build.analysed_ears))
        yield
