# SPDX-License-Identifier: MIT
"""Devices and pipes are refused at once, wherever a file can be named."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from sononerf.errors import InputError
from sononerf.storage import require_regular, require_whole_wav

SETTINGS = str(Path(__file__).resolve().parent.parent / "configs" / "smoke.yaml")


def test_an_ordinary_file_and_a_link_to_one_are_read(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    require_regular(tmp_path / "file")
    require_regular(tmp_path / "link")
    with pytest.raises(FileNotFoundError):
        require_regular(tmp_path / "none")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "kind"),
    [
        (("simulate", SETTINGS, "poses.arrangement=path", "poses.path=PIPE"), "a pipe"),
        (("simulate", SETTINGS, "poses.arrangement=path", "poses.path=/dev/zero"), "a device"),
        (("simulate", SETTINGS, "ears.directivity=file", "ears.file=/dev/zero"), "a device"),
        (("import", "recordings", ".", "--settings", "PIPE"), "a pipe"),
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


def wav(path, *, stated=None, order="<", long=None):
    """Write a WAV file of 100 samples that states another number of bytes."""
    kind = {"<": b"RIFF", ">": b"RIFX"}[order] if long is None else b"RF64"
    data = struct.pack(f"{order}I", 200 if stated is None else stated)
    form = struct.pack(f"{order}IHHIIHH", 16, 1, 1, 8000, 16000, 2, 16)
    sizes = b"" if long is None else b"ds64" + struct.pack("<IQQQI", 28, 0, long, 0, 0)
    body = sizes + b"note" + struct.pack(f"{order}I", 3) + b"abc\0" + b"fmt " + form
    path.write_bytes(kind + bytes(4) + b"WAVE" + body + b"data" + data + bytes(200))
    return path


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_wav_file_that_states_more_samples_than_it_holds_is_refused(tmp_path, order):
    require_whole_wav(wav(tmp_path / "whole.wav", order=order))
    with pytest.raises(InputError, match="states 202 bytes of samples and holds 200"):
        require_whole_wav(wav(tmp_path / "short.wav", order=order, stated=202))


def test_the_sizes_of_a_wav_file_above_4_gb_are_known(tmp_path):
    require_whole_wav(wav(tmp_path / "whole.wav", stated=0xFFFFFFFF, long=200))
    with pytest.raises(InputError, match="states 9000000000 bytes"):
        require_whole_wav(wav(tmp_path / "short.wav", stated=0xFFFFFFFF, long=9_000_000_000))


def test_other_files_and_headers_alone_pass(tmp_path):
    for name, data in (("text.wav", b"hello"), ("head.wav", b"RIFF\0\0\0\0WAVEds64"), ("no", b"")):
        (tmp_path / name).write_bytes(data)
        assert require_whole_wav(tmp_path / name) is None
