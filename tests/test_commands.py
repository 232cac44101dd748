# SPDX-License-Identifier: MIT
"""Every command of the pages on recordings, receivers and calls runs, on small data."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sononerf.head.call import call_waveform
from sononerf.recordings.recording import wav_bytes
from sononerf.settings.schema import CallSettings
from tests.command import succeed

ROOT = Path(__file__).resolve().parent.parent
SMALL = (
    *("poses.count=24", "poses.validation=2", "poses.heldout=2", "simulation.rays=2000"),
    *("simulation.noise_floor_poses=0", "fit.epochs=2", "fit.steps_per_epoch=20"),
)
FITTED = ("fit.epochs=2", "reconstruction.refine=false")
"""Settings that make the commands of the pages short; what is imported has no simulation."""


def commands(page):
    """Return the shell commands of a page, one list of words each, and its Python blocks."""
    text = (ROOT / "docs" / page).read_text()
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).splitlines()
    inline = re.findall(r"`(sononerf fit [^`\n]*=[^`\n]*)`", text)
    shell = [shlex.split(line, comments=True) for line in (*lines, *inline)]
    return [words for words in shell if words[:1] == ["sononerf"]], re.findall(
        r"```python\n(from pathlib.*?)```", text, re.DOTALL
    )


def shortened(words):
    """Return the words of a command with settings that make it short."""
    words = ["three_spheres" if word == "CONFIG" else word for word in words]
    if words[1] == "simulate" or (words[1] == "fit" and "data.store" not in " ".join(words)):
        return [*words, *SMALL]
    return [*words, *FITTED] if words[1] == "fit" else words


def test_the_pages_have_commands():
    found = {page: len(commands(page)[0]) for page in ("recordings.md", "calls.md", "receivers.md")}
    assert found["recordings.md"] >= 10
    assert found["calls.md"] >= 2
    assert found["receivers.md"] >= 1


@pytest.mark.slow
@pytest.mark.parametrize("page", ["recordings.md", "receivers.md", "calls.md"])
def test_the_commands_of_a_page_run(page, tmp_path):
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    call = CallSettings(kind="linear", duration=5e-4, frequency_start=100e3, frequency_end=20e3)
    (tmp_path / "call.wav").write_bytes(wav_bytes(call_waveform(call, 1e6)[None], 1e6))
    shell, blocks = commands(page)
    runs = 0
    for words in shell:
        given = shortened(words)
        if given[1] == "fit" and "--output" not in given:
            given += ["--output", f"run{(runs := runs + 1)}"]
        succeed(tmp_path, *given[1:])
    for block in blocks:
        done = subprocess.run(
            [sys.executable, "-c", block], cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
