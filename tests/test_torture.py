# SPDX-License-Identifier: MIT
"""A share of `tools/torture.py` finds no fault."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARES = [
    pytest.param(*share, marks=pytest.mark.slow)
    for share in (
        ("kill-simulate", 8),
        ("attacks", 12),
        ("mistakes", 12),
        ("disk", 5),
        ("kill-fit", 3),
    )
]


@pytest.mark.parametrize(("series", "count"), SHARES)
def test_a_share_of_each_series_finds_no_fault(series, count, tmp_path):
    tool = str(ROOT / "tools" / "torture.py")
    words = [series, "--count", str(count), "--seed", "1", "--output", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, tool, *words], cwd=tmp_path, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 faults" in done.stdout
