# SPDX-License-Identifier: MIT
"""Damaged files for every reader: no traceback, no hang, no gigabyte, no change that passes."""

from __future__ import annotations

import json
import os
import random
import re
import resource
import signal
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from sononerf.errors import SonoNerfError
from tools.tortures.harness import Report
from tools.tortures.samples import Sample, make_run, make_store, read_run, read_store, samples

HANG_SECONDS = 5
HANGS = f"hangs for {HANG_SECONDS} s, twice"
MOST_BYTES = 1_000_000_000
BATCH = 200
"""Files that one process reads."""
TOKENS = (
    *(b"\xff" * 8, b"\x00" * 16, b"\x7f\xff\xff\xff", b"nan", b"-inf", b"1e999", b"-1", b"0"),
    *(b"99999999999999999999", b"1e-320", b"\n", b",", b"\xef\xbb\xbf", b"{", b"]", b"&a *a"),
    *(b"../../etc/passwd", b"http://example.org/x", b"!!python/object:os.system", b"\xed\xa0\x80"),
)
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return data with one to four changes of the kinds that disks, links and strangers make."""
    found = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        size = len(found)
        if not size:
            return b""
        place, span = rng.randrange(size), rng.randint(1, max(1, min(64, size // 4)))
        kind = rng.randrange(9)
        if kind == 0:
            found[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            found[place] = rng.randrange(256)
        elif kind == 2:
            del found[place:]
        elif kind == 3:
            del found[place : place + span]
        elif kind == 4:
            found[place:place] = found[place : place + span]
        elif kind == 5:
            found[place : place + rng.choice((0, span))] = rng.choice(TOKENS)
        elif kind == 6:
            found[place : place + span] = bytes(span)
        elif kind == 7:
            other = rng.randrange(size)
            part = found[other : other + span]
            found[place : place + len(part)] = part
        else:
            numbers = list(NUMBER.finditer(bytes(found)))
            if numbers:
                where = rng.choice(numbers)
                found[where.start() : where.end()] = rng.choice(TOKENS)
    return bytes(found)


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Return data with one bit changed."""
    found = bytearray(data)
    found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


class _HangError(BaseException):
    pass


def _alarm(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise _HangError


def _judged(read: Callable[[], object], same: Callable[[object], bool] | None) -> str:
    """Read; return what is wrong with that, or empty text."""
    signal.setitimer(signal.ITIMER_REAL, HANG_SECONDS)
    try:
        found = read()
    except SonoNerfError as error:
        said = str(error)
        return "an error without a word" if not said.strip() else ""
    except _HangError:
        return HANGS
    except Exception as error:
        import traceback

        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:120]!r} in {where.filename}:{where.lineno}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "" if same is None or same(found) else "a change passes"


Trial = tuple[str, Callable[[], object], Callable[[object], bool] | None, bytes]


def judged_apart(trials: Callable[[int], Trial], numbers: list[int], keep: Path) -> list[str]:
    """Judge trials in processes of their own; one that dies is a fault, and the rest goes on."""
    faults, left = [], list(numbers)
    while left:
        heard, tells = os.pipe()
        pid = os.fork()
        if pid == 0:
            try:
                os.close(heard)
                _work(trials, left, tells, keep)
            finally:
                os._exit(0)
        os.close(tells)
        with os.fdopen(heard) as lines:
            done = [json.loads(line) for line in lines]
        _, status = os.waitpid(pid, 0)
        faults += [one["fault"] for one in done if one.get("fault")]
        begun = [one["begun"] for one in done if "begun" in one]
        ended = sum("ended" in one for one in done)
        if ended == len(left):
            return faults
        if not begun or len(begun) == ended:
            faults.append(f"the process ends with {os.waitstatus_to_exitcode(status)}")
            return faults
        code = os.waitstatus_to_exitcode(status)
        faults.append(f"{begun[-1]}: the process ends with {code}")
        left = left[ended + 1 :]
    return faults


def _work(trials: Callable[[int], Trial], numbers: list[int], tells: int, keep: Path) -> None:
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _alarm)
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    used = sum(1024 * int(line.split()[1]) for line in lines if line.startswith("VmData:"))
    resource.setrlimit(resource.RLIMIT_DATA, (used + MOST_BYTES, resource.RLIM_INFINITY))
    for number in numbers:
        name, read, same, data = trials(number)
        line = json.dumps({"begun": f"trial {number}, {name}"})
        os.write(tells, f"{line}\n".encode())
        fault = _judged(read, same)
        if fault == HANGS:  # other work on this machine may have held it up
            fault = _judged(read, same)
        if fault:
            (keep / f"{number}").write_bytes(data)
            line = json.dumps({"fault": f"trial {number}, {name}: {fault}"})
            os.write(tells, f"{line}\n".encode())
        os.write(tells, f'{{"ended": {number}}}\n'.encode())


def _batches(report: Report, trials: Callable[[int], Trial], count: int, keep: Path) -> None:
    said = time.monotonic()
    for start in range(0, count, BATCH):
        numbers = list(range(start, min(start + BATCH, count)))
        for line in judged_apart(trials, numbers, keep):
            report.fault(line)
        if time.monotonic() - said > 30:
            said = time.monotonic()
            print(f"  {report.name}: {numbers[-1] + 1} of {count}", flush=True)


def fuzz(count: int, seed: int, keep: Path) -> Report:
    """Give damaged files to every reader.

    Args:
        count: Number of files.
        seed: Seed of the damage.
        keep: Folder that keeps the files that were a fault.
    """
    return _given(Report("fuzz", seed), damaged, count, keep, all_kinds=True)


def flips(count: int, seed: int, keep: Path) -> Report:
    """Flip single bits of what sononerf writes; what is read then is right or refused.

    Args:
        count: Number of bits.
        seed: Seed of their places.
        keep: Folder that keeps the files that were a fault.
    """
    return _given(Report("flips", seed), flipped, count, keep, all_kinds=False)


def _given(
    report: Report,
    damage: Callable[[bytes, random.Random], bytes],
    count: int,
    keep: Path,
    *,
    all_kinds: bool,
) -> Report:
    """Damage files one way and give them to their readers: all kinds, or those with checksums."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        kinds = [kind for kind in samples(folder) if all_kinds or kind.is_checked]
        sound = [kind.read(_put(folder, kind, "sound", kind.data)) for kind in kinds]
        whole = {name: folder / name for name in ("store", "run")}
        make_store(whole["store"])
        make_run(whole["run"])
        readers = {"store": read_store, "run": read_run}
        expected = {name: readers[name](path) for name, path in whole.items()}

        def trial(number: int) -> Trial:
            rng = random.Random(f"{report.seed} {number}")
            row = rng.randrange(len(kinds) + 4)  # stores and runs have many files
            if row < len(kinds):
                kind = kinds[row]
                data = damage(kind.data, rng)
                path = _put(folder, kind, "damaged", data)
                same = (lambda found: found == sound[row]) if kind.is_checked else None
                return kind.name, lambda: kind.read(path), same, data
            name = "store" if row % 2 else "run"
            file, data = _damaged_file(whole[name], rng, damage)
            return (
                f"{name}: {file.relative_to(whole[name])}",
                _with(file, data, lambda: readers[name](whole[name])),
                lambda found: found == expected[name],
                data,
            )

        _batches(report, trial, count, keep)
        report.count(f"files of {len(kinds) + 2} kinds", count)
    return report


def _put(folder: Path, kind: Sample, name: str, data: bytes) -> Path:
    path = folder / f"{name}{kind.suffix}"
    path.unlink(missing_ok=True)  # a new file, lest a reader knows the old one
    path.write_bytes(data)
    return path


def _damaged_file(
    folder: Path, rng: random.Random, damage: Callable[[bytes, random.Random], bytes]
) -> tuple[Path, bytes]:
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.stat().st_size)
    file = rng.choice(files)
    return file, damage(file.read_bytes(), rng)


def _with(file: Path, data: bytes, read: Callable[[], object]) -> Callable[[], object]:
    """Return a reading that finds other data in a file; the file is as before afterwards."""

    def trial() -> object:
        before = file.read_bytes()
        file.write_bytes(data)
        try:
            return read()
        finally:
            file.write_bytes(before)

    return trial
