# SPDX-License-Identifier: MIT
"""Headers as recorders and editors write them, right and wrong, over the same samples."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.recordings.readers import read_sound
from sononerf.settings.sections import ImportSettings
from sononerf.wav_files import read_wav

RATE = 250_000
TONE = np.sin(np.arange(200).reshape(100, 2)) * 0.9
PCM16 = np.round(TONE * 32767).astype("<i2").tobytes()
NOTES = b"GUANO|Version: 1.0\n"


def chunk(name, content, *, size=None, pad=True):
    stated = struct.pack("<I", len(content) if size is None else size)
    return name + stated + content + (b"\0" if pad and len(content) % 2 else b"")


def form(code=1, bits=16, channels=2, rate=RATE, more=b""):
    align = channels * -(-bits // 8)
    return chunk(
        b"fmt ", struct.pack("<HHIIHH", code, channels, rate, rate * align, align, bits) + more
    )


def write(tmp_path, data=PCM16, *, kind=b"RIFF", head=None, before=b"", after=b"", size=None):
    head = form() if head is None else head
    body = b"WAVE" + before + head + chunk(b"data", data, size=size) + after
    path = tmp_path / "a.wav"
    path.write_bytes(kind + struct.pack("<I", len(body)) + body)
    return path


def sizes(count):
    return chunk(b"ds64", struct.pack("<QQQI", 0, count, 0, 0))


GUID = bytes.fromhex("0000000010008000 00aa00389b71".replace(" ", ""))


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"before": chunk(b"bext", bytes(602)) + chunk(b"LIST", bytes(40))},
        {"after": chunk(b"LIST", b"INFO", size=99_999)},
        {"before": chunk(b"guan", NOTES)},
        {"before": chunk(b"guan", NOTES, pad=False)},
        {"after": chunk(b"guan", NOTES, pad=False)},
        {"after": bytes(5)},
        {"kind": b"RF64", "before": sizes(400), "size": 0xFFFFFFFF},
        {"kind": b"BW64", "before": sizes(400), "size": 0xFFFFFFFF},
        {"head": form(0xFFFE, more=struct.pack("<HHIH", 22, 16, 3, 1) + GUID)},
    ],
)
def test_the_samples_that_are_there_are_read(tmp_path, given, caplog):
    wav = read_wav(write(tmp_path, **given))
    assert (wav.rate, wav.samples.shape, wav.true_rate) == (RATE, (100, 2), None)
    np.testing.assert_allclose(wav.samples / 32767, TONE, atol=2e-5)
    assert not caplog.records


@pytest.mark.parametrize("size", [0, 0xFFFFFFFF])
def test_a_header_that_was_never_finished_is_told_once(tmp_path, size, caplog):
    for _ in range(2):
        wav = read_wav(write(tmp_path, size=size))
        np.testing.assert_allclose(wav.samples / 32767, TONE, atol=2e-5)
    (line,) = caplog.messages
    assert f"never finished ({size} bytes" in line
    assert str(tmp_path) in line


def test_floats_and_other_widths_mean_the_same(tmp_path):
    whole = np.round(TONE * (2**23 - 1)).astype("<i4")
    three = whole.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    for bits in (24, 20):
        wav = read_wav(write(tmp_path, three, head=form(bits=bits)))
        np.testing.assert_allclose(wav.samples / 2.0**31, TONE, atol=2e-7)
    for kind, bits in (("<f4", 32), ("<f8", 64)):
        wav = read_wav(write(tmp_path, TONE.astype(kind).tobytes(), head=form(3, bits)))
        np.testing.assert_allclose(wav.samples, TONE, atol=1e-7)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"size": 160}, "states 160 bytes of samples .data., and 240 more follow"),
        ({"size": 404}, "states 404 bytes of samples and holds 400"),
        ({"kind": b"RF64", "before": sizes(4000), "size": 0xFFFFFFFF}, "states 4000 bytes"),
        ({"head": form(7, 8)}, "format 7 with 8 bits.* save it as PCM"),
        ({"head": form(0x55)}, "format 85"),
        ({"head": form(rate=0)}, "a sampling rate of 0 Hz"),
        ({"head": form(channels=0)}, "and 0 channels"),
        ({"head": b""}, "holds no format"),
        ({"kind": b"FORM"}, "no WAV file; it is AIFF"),
        ({"after": chunk(b"data", PCM16)}, "two chunks of samples"),
        ({"head": form()[:20] + b"\3\0" + form()[22:]}, "of 16 bits and a block align of 3 bytes"),
    ],
)
def test_a_header_that_contradicts_the_file_is_named(tmp_path, given, words):
    with pytest.raises(InputError, match=words):
        read_wav(write(tmp_path, **given))


@pytest.mark.parametrize("fields", [b"TE: 10\nSamplerate: 2500000\n", b"Samplerate: 2500000"])
def test_a_time_expansion_is_named_with_the_setting_that_mends_it(tmp_path, fields):
    path = write(tmp_path, after=chunk(b"guan", NOTES + fields))
    with pytest.raises(InputError, match=r"250000 Hz.*set import\.sampling_rate=2500000"):
        read_sound(path, ImportSettings())
    for rate in (2_500_000, RATE):  # both pieces of advice, followed
        assert read_sound(path, ImportSettings(sampling_rate=rate))[0] == rate
