# SPDX-License-Identifier: MIT
import subprocess
import sys

import pytest

from sononerf.errors import ResourceError
from sononerf.memory import available_memory, require_disk, require_memory


def test_available_memory_is_plausible():
    free = available_memory()
    assert free is None or 10_000_000 < free < 10**15


def run(code):
    """Run Python in a process of its own and return what it says."""
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    return found.stdout + found.stderr


def test_work_that_needs_too_much_is_refused_with_the_figure():
    require_memory(1e6, "a small thing", "nothing")
    with pytest.raises(ResourceError, match=r"a fit needs about 1,000,000 GB of memory, and .* GB"):
        require_memory(1e15, "a fit", "make it smaller")


def test_files_that_the_disk_does_not_hold_are_refused(tmp_path):
    require_disk(1e3, tmp_path / "new" / "store", "echoes", "lower it")
    with pytest.raises(
        ResourceError, match=r"^echoes needs about [\d,]+ GB of disk, and .*; lower"
    ):
        require_disk(1e18, tmp_path / "new" / "store", "echoes", "lower it")
    assert not (tmp_path / "new").exists()
