# SPDX-License-Identifier: MIT
"""A share of `tools/torture.py` finds no fault, and what it looks for is seen where it is."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sononerf.errors import InputError
from tools.tortures import fuzz as fuzz_module
from tools.tortures.fuzz import damaged, flipped, judged_apart
from tools.tortures.mutants import mutated, places

ROOT = Path(__file__).resolve().parent.parent
SHARES = [
    ("fuzz", 60),
    *(
        pytest.param(*share, marks=pytest.mark.slow)
        for share in (
            ("flips", 100),
            ("kill-simulate", 8),
            ("attacks", 12),
            ("mistakes", 12),
            ("disk", 5),
            ("kill-fit", 3),
        )
    ),
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


def refuse():
    raise InputError("x.csv: is empty")


READERS = {
    "refuses": (refuse, ""),
    "right": (lambda: 7, ""),
    "changed": (lambda: 8, "a change passes"),
    "traceback": (lambda: 1 / 0, "ZeroDivisionError"),
    "hangs": (lambda: time.sleep(9), "hangs"),
    "memory": (lambda: bytes(2 * 10**9), "MemoryError"),
    "dies": (lambda: os._exit(9), "the process ends with 9"),
}


def test_what_a_reader_may_not_do_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz_module, "HANG_SECONDS", 0.3)
    names = list(READERS)

    def trial(number):
        return names[number], READERS[names[number]][0], lambda found: found == 7, b"data"

    faults = judged_apart(trial, list(range(len(names))), tmp_path)
    wanted = {name: said for name, (_, said) in READERS.items() if said}
    assert len(faults) == len(wanted)
    for name, said in wanted.items():
        assert any(name in fault and said in fault for fault in faults), (name, faults)


def test_damage_is_drawn_from_its_seed():
    import random

    data = bytes(range(200))
    for damage in (damaged, flipped):
        once, again, other = (damage(data, random.Random(seed)) for seed in (1, 1, 2))
        assert once == again != data
        assert other != once


def test_each_mutant_differs_in_one_place():
    source = (
        "def f(a: int = 3, b=True):\n    '''Doc.'''\n    if a < 2 and not b:\n        raise X\n"
    )
    source += "    return -a + 1\n"
    found = [mutated(source, number) for number in range(places(source))]
    assert len(found) == len({text for text, _ in found}) == 8
    assert all(what.startswith("line ") for _, what in found)
    assert mutated(source, len(found))[1] == ""
