# SPDX-License-Identifier: MIT
"""Processes that are killed, and calls to the system that fail: what is left, and what follows."""

from __future__ import annotations

import builtins
import errno
import mmap
import os
import random
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import wavfile

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import SonoNerfError
from sononerf.geometry.poses import Poses
from tools.tortures.harness import (
    AFTER,
    FIT,
    SIMULATE,
    Outcome,
    Report,
    contents,
    differences,
    give,
    leftovers,
    prepared,
)

CODES = (errno.ENOSPC, errno.EIO, errno.EACCES)
CALLS = ("fsync", "replace", "rename", "link", "mkdir", "write", "pwrite", "ftruncate", "unlink")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
SETTINGS = """\
ears: {directivity: omnidirectional, receivers: [[0, 0.02, 0], [0, -0.02, 0]]}
spectrogram: {frequency_min: 20000.0, frequency_max: 80000.0}
import: {validation: 1, heldout: 1}
"""


def counted(
    number: int, act: Callable[[], object], folder: Path, tally: mmap.mmap | None = None
) -> Callable[[], None]:
    """Return what lets the N-th call that writes below a folder act otherwise.

    Args:
        number: Number of the call, from 1; 0 for none.
        act: Called before it; the call is done where this returns.
        folder: The process's; calls on paths elsewhere do not count.
        tally: Memory that other processes see, for the number of calls.
    """
    inside = str(folder.resolve())

    def install() -> None:
        made = 0

        def tick() -> None:
            nonlocal made
            made += 1
            if tally is not None:
                tally[:8] = made.to_bytes(8, "little")
            if made == number:
                act()

        def counts(target: Any) -> bool:
            if isinstance(target, int):
                return target > 2
            return str(Path(os.fsdecode(target)).absolute()).startswith(inside)

        def wrapped(real: Callable[..., Any]) -> Callable[..., Any]:
            def call(*given: Any, **options: Any) -> Any:
                if counts(given[0]):
                    tick()
                return real(*given, **options)

            return call

        for name in CALLS:
            setattr(os, name, wrapped(getattr(os, name)))
        real_open, real_low = builtins.open, os.open

        def opened(file: Any, mode: str = "r", *given: Any, **options: Any) -> Any:
            if set(mode) & set("wax+") and not isinstance(file, int) and counts(file):
                tick()
            return real_open(file, mode, *given, **options)

        def low(path: Any, flags: int, *given: Any, **options: Any) -> int:
            if flags & WRITES and counts(path):
                tick()
            return real_low(path, flags, *given, **options)

        builtins.open, os.open = opened, low  # type: ignore[assignment]

    return install


def _calls(words: tuple[str, ...], folder: Path) -> int:
    """Return how many calls that write a command makes."""
    tally = mmap.mmap(-1, 8)
    outcome = give(words, folder, before=counted(0, _die, folder, tally))
    assert outcome.code == 0, outcome.said
    return int.from_bytes(tally[:8], "little")


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def kill_simulate(count: int, seed: int, keep: Path) -> Report:
    """Kill `simulate`; see :func:`_kills`."""
    return _kills("store", SIMULATE, count, seed, keep)


def kill_fit(count: int, seed: int, keep: Path) -> Report:
    """Kill `fit` with all that follows it; see :func:`_kills`."""
    return _kills("run", FIT, count, seed, keep)


def _kills(name: str, words: tuple[str, ...], count: int, seed: int, keep: Path) -> Report:
    """Kill a command at random moments and at its writes, and give it again until it ends.

    Args:
        name: Name of the folder that the command makes.
        words: The command.
        count: Number of kills.
        seed: Seed of the moments.
        keep: Folder that keeps the runs that were a fault.
    """
    report, rng = Report(f"kills of {words[0]}", seed), random.Random(seed)
    with prepared(SIMULATE, *([] if words == SIMULATE else [words])) as folder:
        whole = folder / "whole"
        whole.mkdir()
        give(SIMULATE, whole)
        once = give(words, _fresh(folder, "once", whole, name))
        assert once.code == 0, once.said
        expected = contents(folder / "once" / name)
        calls = _calls(words, _fresh(folder, "counted", whole, name))
        report.counts[f"calls that write and {once.seconds:.1f} s a {words[0]}"] = calls
        done = trials = 0
        place, known = _fresh(folder, "0", whole, name), set[int]()
        while done < count:
            trials += 1
            # Mostly soon, for what was done before is not done again.
            part = rng.choice((0.2, 0.2, 0.2, 1.0))
            if rng.random() < 0.5:
                after, before = rng.uniform(0, part * once.seconds), None
            else:
                number = rng.randint(1, max(1, int(part * calls)))
                after, before = None, counted(number, _die, place)
            outcome = give(words, place, kill_after=after, before=before)
            done += outcome.code == -signal.SIGKILL
            fault = _after_kill(outcome, place / name, known, name)
            if not fault and outcome.code == 0:
                wrong = differences(contents(place / name), expected) + leftovers(place)
                fault = f"{len(wrong)} files differ or are left, as {wrong[0]}" if wrong else ""
            if fault:
                report.fault(f"trial {trials}: {fault}")
                shutil.copytree(place, keep / f"{name}-{trials}", dirs_exist_ok=True)
            if fault or outcome.code == 0:
                report.count("brought to their end and compared")
                shutil.rmtree(place)
                place, known = _fresh(folder, str(trials), whole, name), set()
            if trials % 50 == 0:
                print(f"  {report.name}: {done} of {count}", flush=True)
        report.count("kills", done)
    return report


def _fresh(folder: Path, label: str, whole: Path, name: str) -> Path:
    """Return a new working folder; one of a fit has the store."""
    place = folder / label
    place.mkdir()
    if name == "run":
        (place / "store").symlink_to(whole / "store")
    return place


def _after_kill(outcome: Outcome, path: Path, known: set[int], name: str) -> str:
    """Say what is wrong after a command ended or was killed."""
    if outcome.code not in (0, -signal.SIGKILL):
        return f"exit {outcome.code}: {outcome.said[-200:]!r}"
    if name != "store" or not (path / "zarr.json").is_file():
        return ""
    try:
        store = EnsembleStore.open(path)
        there = set(range(len(store))) - set(store.missing())
        for index in there:
            store.read_pose(index)
    except SonoNerfError as error:
        return f"unreadable: {error}"
    lost = known - there
    known |= there
    return f"{len(lost)} committed poses are lost" if lost else ""


def _recordings(folder: Path) -> None:
    """Write recordings of eight poses, echoes of a point."""
    poses, rate = Poses.sphere(8, radius=0.3), 250_000
    rng = np.random.default_rng(0)
    (folder / "heard").mkdir()
    names = [f"ping_{index}.wav" for index in range(len(poses))]
    header, *rows = poses.table().splitlines()
    columns = ["x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg"]
    del header
    lines = [",".join(["file", *columns]), *map(",".join, zip(names, rows, strict=True))]
    (folder / "heard" / "poses.csv").write_text("\n".join(lines) + "\n")
    (folder / "heard" / "import.yaml").write_text(SETTINGS)
    for name in names:
        sound = 20.0 * rng.standard_normal((700, 2))
        sound[430:450] += 8000.0 * np.sin(2 * np.pi * 5e4 * np.arange(20) / rate)[:, None]
        wavfile.write(folder / "heard" / name, rate, sound.astype(np.int16))


def disk(count: int, seed: int, keep: Path) -> Report:
    """Let calls that write fail, one each time, and files reach a size limit.

    Args:
        count: Number of faults; 0 means all calls of all commands in turn.
        seed: Seed of the calls and errors.
        keep: Folder that keeps what was a fault.
    """
    report, rng = Report("disk", seed), random.Random(seed)
    with prepared() as folder:
        whole = folder / "whole"
        whole.mkdir()
        _recordings(whole)
        commands = {
            "simulate": SIMULATE,
            "import": ("import", "recordings", "heard", "--output", "imported"),
            "fit": FIT,
            **AFTER,
        }
        starts: dict[str, Path] = {}
        calls: dict[str, int] = {}
        for name, words in commands.items():
            starts[name] = folder / f"before-{name}"
            shutil.copytree(whole, starts[name])
            calls[name] = _calls(words, whole)
        ends = {
            name: _ended(commands[name], starts[name], folder / f"end-{name}") for name in commands
        }
        every = [(name, number) for name in commands for number in range(1, calls[name] + 1)]
        report.count("calls that write in all", len(every))
        for trial in range(count or len(every)):
            name, number = every[trial] if not count else rng.choice(every)
            code = rng.choice(CODES)
            place = folder / "place"
            shutil.copytree(starts[name], place)
            old = contents(place, leaving=())
            if rng.random() < 0.85:
                what = f"call {number} of {calls[name]}, {errno.errorcode[code]}"
                before = counted(number, _refusal(code), place)
            else:
                size = rng.choice((64, 300, 3000, 20_000, 100_000))
                what, before = f"files of {size} bytes at most", _limit(size)
            outcome = give(commands[name], place, before=before)
            fault = _after_fault(outcome, place, old, ends[name])
            if not fault and rng.random() < 0.3:
                again = give(commands[name], place)
                wrong = differences(_plain(place), ends[name]) + leftovers(place)
                if again.code or wrong:
                    fault = f"again, exit {again.code}; {wrong[:3]} differ; {again.said[-200:]!r}"
            if fault:
                report.fault(f"{name}, {what}: {fault}")
                shutil.copytree(place, keep / f"disk-{trial}", dirs_exist_ok=True)
            report.count("ends with 4" if outcome.code == 4 else "tolerated")
            shutil.rmtree(place)
            if trial % 50 == 49:
                print(f"  disk: {trial + 1} of {count or len(every)}", flush=True)
    return report


def _ended(words: tuple[str, ...], start: Path, place: Path) -> dict[str, str]:
    shutil.copytree(start, place)
    outcome = give(words, place)
    assert outcome.code == 0, outcome.said
    found = _plain(place)
    shutil.rmtree(place)
    return found


def _plain(place: Path) -> dict[str, str]:
    """Return the contents of all stores and runs of a folder."""
    found = {}
    for name in ("store", "imported", "run"):
        if (place / name).is_dir():
            found |= {f"{name}/{file}": data for file, data in contents(place / name).items()}
    return found


def _refusal(code: int) -> Callable[[], None]:
    def refuse() -> None:
        raise OSError(code, os.strerror(code))

    return refuse


def _limit(size: int) -> Callable[[], None]:
    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    return limit


def _after_fault(outcome: Outcome, place: Path, old: dict[str, str], end: dict[str, str]) -> str:
    """Say what is wrong after a call failed."""
    if outcome.faults:
        return f"{', '.join(outcome.faults)}: {outcome.said[-300:]!r}"
    if outcome.code == 0:  # a call whose failure costs nothing, such as the removal of a leftover
        wrong = differences(_plain(place), end)
        return f"ends with 0, and {wrong[:3]} differ" if wrong else ""
    if outcome.code != 4:
        return f"exit {outcome.code}: {outcome.said[-300:]!r}"
    now = contents(place, leaving=())
    gone = [name for name in old if name not in now and not _may_go(name)]
    return f"{gone[:3]} are gone" if gone else ""


def _may_go(name: str) -> bool:
    """Tell whether a command removes a file on its way, to write it anew or because it is old."""
    return name.endswith(("read_out.json", ".lock"))
