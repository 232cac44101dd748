# SPDX-License-Identifier: MIT
"""Files that settings name are copied once and used from there."""

from __future__ import annotations

from pathlib import Path

import pytest

from sononerf.errors import InputError
from sononerf.head.call_file import attach
from sononerf.run.build import with_attached
from sononerf.settings.loading import validate_settings


@pytest.fixture
def settings(tmp_path):
    ears, call = tmp_path / "bat.sofa", tmp_path / "call.wav"
    ears.write_bytes(b"an ear")
    call.write_bytes(b"a call")
    sections = {
        "scene": {"name": "three_spheres"},
        "ears": {"directivity": "file", "file": str(ears)},
        "call": {"kind": "file", "file": str(call)},
    }
    return validate_settings(sections, "test")


def test_copies_are_used_when_the_files_are_gone(settings, tmp_path):
    attach(settings, tmp_path / "run")
    settings.ears.file.unlink()
    settings.call.file.unlink()
    found = with_attached(settings, tmp_path / "run")
    assert found.ears.file.read_bytes() == b"an ear"
    assert found.call.file.read_bytes() == b"a call"
    assert found.ears.file.suffix == ".sofa"
    assert found.spectrogram == settings.spectrogram


def test_a_copy_is_not_replaced(settings, tmp_path):
    attach(settings, tmp_path / "run")
    settings.call.file.write_bytes(b"another")
    attach(settings, tmp_path / "run")
    assert with_attached(settings, tmp_path / "run").call.file.read_bytes() == b"a call"


def test_without_copies_the_settings_stay(settings, tmp_path):
    assert with_attached(settings, tmp_path / "elsewhere") is settings
    plain = validate_settings({"scene": {"name": "ua"}}, "test")
    attach(plain, tmp_path / "plain")
    assert not (tmp_path / "plain").exists()


def test_a_missing_file_is_named_and_nothing_is_written(settings, tmp_path):
    settings.ears.file.unlink()
    with pytest.raises(InputError, match=r"bat\.sofa: cannot be read \(No such file"):
        attach(settings, tmp_path / "run")
    assert not Path(tmp_path / "run").exists()
