# SPDX-License-Identifier: MIT
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sononerf.errors import ResourceError
from sononerf.memory import available_memory, require_disk, require_memory
from sononerf.run.simulate import simulate
from sononerf.settings.loading import validate_settings


def test_available_memory_is_plausible():
    free = available_memory()
    assert free is None or 10_000_000 < free < 10**15


def run(code):
    """Run Python in a process of its own and return what it says."""
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    return found.stdout + found.stderr


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="Linux alone has such a limit")
@pytest.mark.parametrize(
    "allocation",
    ["numpy.zeros(free // 16)", "torch.empty(free // 8, dtype=torch.float32)"],
)
def test_more_memory_than_there_is_gives_one_line(allocation):
    """NumPy and torch fail where the system would else kill the process."""
    said = run(
        "import numpy, torch\n"
        "from sononerf.errors import ResourceError\n"
        "from sononerf.memory import available_memory, memory_limited\n"
        "free = available_memory()\n"
        "try:\n"
        "    with memory_limited():\n"
        f"        kept = [{allocation} for _ in range(4)]  # untouched, twice what is free\n"
        "except ResourceError as error:\n"
        "    print(error, error.exit_code)\n"
    )
    assert re.match(r"this needs more memory than there is, of which [\d.]+ GB were free", said)
    assert said.strip().endswith(" 6")


def test_other_faults_stay_what_they_are():
    said = run(
        "from sononerf.memory import memory_limited\n"
        "with memory_limited():\n"
        "    raise RuntimeError('no memory of it')\n"
    )
    assert said.strip().endswith("RuntimeError: no memory of it")


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


@pytest.mark.parametrize(
    ("count", "words"),
    [(10**9, "drawing 1,000,015 poses|drawing 1,000,000,0"), (3 * 10**5, "disk")],
)
def test_too_many_poses_are_refused_at_once(count, words, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=10**9))
    settings = validate_settings({"scene": {"name": "sphere"}, "poses": {"count": count}}, "test")
    with pytest.raises(ResourceError, match=words):
        simulate(settings, output=tmp_path / "store")
    assert not (tmp_path / "store").exists()
