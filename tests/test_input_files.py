# SPDX-License-Identifier: MIT
"""Devices and pipes are refused at once, wherever a file can be named."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sononerf.input_files import require_regular

SETTINGS = str(Path(__file__).resolve().parent.parent / "configs" / "smoke.yaml")


def test_an_ordinary_file_and_a_link_to_one_are_read(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    require_regular(tmp_path / "file")
    require_regular(tmp_path / "link")
    with pytest.raises(FileNotFoundError):
        require_regular(tmp_path / "none")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("words", "kind"),
    [
        (("simulate", SETTINGS, "poses.arrangement=path", "poses.path=PIPE"), "a pipe"),
        pytest.param(
            ("simulate", SETTINGS, "poses.arrangement=path", "poses.path=/dev/zero"),
            "a device",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("simulate", SETTINGS, "ears.directivity=file", "ears.file=/dev/zero"),
            "a device",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("import", "recordings", ".", "--settings", "PIPE"),
            "a pipe",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_file_that_never_ends_is_refused_at_once(words, kind, tmp_path):
    os.mkfifo(tmp_path / "PIPE")
    before = sorted(tmp_path.iterdir())
    done = subprocess.run(
        [sys.executable, "-m", "sononerf.cli", *words, "--output", "out"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode in (2, 3), done.stderr
    assert f"is {kind}, expected a file" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before
