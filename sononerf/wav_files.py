# SPDX-License-Identifier: MIT
"""Read WAV files: the samples that are there, whatever the sizes in the header say."""

from __future__ import annotations

import logging
import re
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import InputError
from sononerf.storage import require_regular, wrong_kind

logger = logging.getLogger("sononerf")

FORMS = (b"RIFF", b"RIFX", b"RF64", b"BW64")
UNSTATED = 0xFFFF_FFFF
"""Size of a chunk, bytes, that another chunk states, or that was never written."""
PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
KINDS = {(PCM, 1): "u1", (PCM, 2): "i2", (PCM, 3): "i4", (PCM, 4): "i4", (FLOAT, 4): "f4"}
KINDS |= {(FLOAT, 8): "f8"}
"""Type of a sample by format and bytes; 24 bits become the upper ones of 32."""


@dataclass(frozen=True, eq=False)
class Wav:
    """A WAV file.

    Attributes:
        rate (Hz): Sampling rate in the header.
        samples (S, E): As they are stored; they stay on disk, but for those of 24 bits.
        true_rate (Hz): Sampling rate of the recorder, where metadata (GUANO) state another, as of a
            time expansion; None elsewhere.
    """

    rate: int
    samples: NDArray[Any]
    true_rate: int | None = None


def read_wav(path: Path) -> Wav:
    """Read a WAV file: RIFF, RIFX, RF64 or BW64, of integers or floats.

    Raises:
        InputError: If it is none, or its header contradicts itself or the file; naming the field.
    """
    try:
        require_regular(path)
        content = np.zeros(12, np.uint8)
        if path.stat().st_size >= len(content):
            content = np.asarray(np.memmap(path, np.uint8, "r"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if content[:4].tobytes() not in FORMS or content[8:12].tobytes() != b"WAVE":
        raise wrong_kind(path, "WAV file")
    chunks = _chunks(path, content)
    if b"data" not in chunks or chunks.get(b"fmt ", (0, 0))[1] < 16:
        name = "samples (data)" if b"fmt " in chunks else "format (fmt)"
        raise InputError(f"{path}: damaged or truncated WAV file; it holds no {name}")
    order = _order(content)
    begin, stated = chunks[b"fmt "]
    fields = content[begin : begin + stated].tobytes()
    form, channels, rate, _, align, bits = struct.unpack(f"{order}HHIIHH", fields[:16])
    if form == EXTENSIBLE and len(fields) >= 26:
        form = struct.unpack(f"{order}H", fields[24:26])[0]
    if not rate or not channels:
        raise InputError(
            f"{path}: has a sampling rate of {rate} Hz and {channels} channels; write the file anew"
        )
    width = -(-bits // 8)
    if align not in (0, width * channels):
        raise InputError(
            f"{path}: its header states {channels} channels of {bits} bits and a block align of "
            f"{align} bytes, which contradict each other; write the file anew"
        )
    if (form, width) not in KINDS:
        raise InputError(
            f"{path}: holds samples of format {form} with {8 * width} bits, which is not read; "
            "save it as PCM of 16, 24 or 32 bits"
        )
    begin, size = _samples(path, content, chunks)
    size -= size % (width * channels)
    samples = np.asarray(content[begin : begin + size])
    if width == 3:
        wide = np.zeros((size // 3, 4), np.uint8)
        wide[:, 1:] = samples.reshape(-1, 3)[:, :: 1 if order == "<" else -1]
        samples, order = wide.reshape(-1), "<"
    samples = samples.view(f"{order}{KINDS[form, width]}").reshape(-1, channels)
    return Wav(rate, samples, _true_rate(content, chunks, rate))


def _order(content: NDArray[np.uint8]) -> Literal["<", ">"]:
    return ">" if content[:4].tobytes() == b"RIFX" else "<"


def _chunks(path: Path, content: NDArray[np.uint8]) -> dict[bytes, tuple[int, int]]:
    """Return where each chunk begins, and its size in bytes as the header states it."""
    chunks: dict[bytes, tuple[int, int]] = {}
    at = 12
    while at + 8 <= len(content):
        name, size = struct.unpack(f"{_order(content)}4sI", content[at : at + 8].tobytes())
        at += 8
        if name == b"data" and size == UNSTATED and chunks.get(b"ds64", (0, 0))[1] >= 16:
            size = int(content[chunks[b"ds64"][0] :][8:16].view("<u8")[0])
        if name == b"data" and name in chunks:
            raise InputError(
                f"{path}: holds two chunks of samples (data), expected one; write the file anew"
            )
        chunks.setdefault(name, (at, size))
        at += size
        if size % 2 and at < len(content) and content[at] == 0:  # some leave the padding out
            at += 1
    return chunks


def _samples(
    path: Path, content: NDArray[np.uint8], chunks: dict[bytes, tuple[int, int]]
) -> tuple[int, int]:
    """Return where the samples begin, and how many bytes they are."""
    begin, stated = chunks[b"data"]
    there = len(content) - begin
    rest = content[begin + stated : begin + stated + 5].tobytes().removeprefix(b"\0")
    has_chunk = re.match(rb"[\w ]{4}", rest) is not None
    if stated == UNSTATED or (stated < there and (there - stated) % 2**32 == 0):
        unfinished = True  # the size was never written, or ran over 32 bits
    else:
        unfinished = stated == 0 and there > 0 and not has_chunk
    if unfinished:
        _say(path.parent, stated)
        return begin, there
    if stated > there:
        raise InputError(
            f"{path}: damaged or truncated WAV file: it states {stated} bytes of samples and holds "
            f"{there}; copy it again"
        )
    if stated < there and not has_chunk and np.any(content[begin + stated :]):
        raise InputError(
            f"{path}: its header states {stated} bytes of samples (data), and {there - stated} "
            "more follow that are no chunk; write the file anew, or correct the size"
        )
    return begin, stated


@lru_cache
def _say(folder: Path, stated: int) -> None:
    """Say once for each folder that headers are unfinished."""
    logger.warning(
        "%s: the headers of WAV files were never finished (%s bytes of samples stated); they are "
        "read to the end",
        *(folder, stated),
    )


def _true_rate(
    content: NDArray[np.uint8], chunks: dict[bytes, tuple[int, int]], rate: int
) -> int | None:
    """Return the sampling rate that the metadata state, if it is not that of the header."""
    begin, size = chunks.get(b"guan", (0, 0))
    text = content[begin : begin + min(size, 100_000)].tobytes().decode("utf-8", errors="replace")
    stated = re.search(r"(?m)^\s*Samplerate\s*:\s*(\d+)", text)
    return int(stated[1]) if stated and int(stated[1]) not in (0, rate) else None
