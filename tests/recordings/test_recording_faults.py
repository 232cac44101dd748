# SPDX-License-Identifier: MIT
"""Faults that people make with recordings: each ends with one line that names the cause.

The recordings are exact echoes of two spheres that nothing of sononerf made.
"""

from __future__ import annotations

import logging
import re
import resource
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile

from sononerf.errors import SonoNerfError
from sononerf.run.import_recordings import check_before, describe_plan, plan_import, write_import
from tests.recordings.two_spheres import RATE, SAMPLES, write_folder, write_long

PINGS = 48


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings") / "sound"
    write_folder(folder, PINGS)
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "recordings")


def ping(folder, number=5):
    return folder / f"ping_{number:03d}.wav"


def rewrite(file, change, rate=RATE):
    """Change the samples (S, E) of a WAV file."""
    _, samples = wavfile.read(file)
    wavfile.write(file, rate, change(samples))


def every(change, rate=RATE):
    """Return a fault that changes the samples of all pings."""

    def fault(folder):
        for file in sorted(folder.glob("ping_*.wav")):
            rewrite(file, change, rate)

    return fault


def every_file(rate):
    """Return a recorder's fault: all its files state another rate."""

    def fault(folder):
        for file in folder.glob("*.wav"):
            rewrite(file, lambda samples: samples, rate)

    return fault


def one(change, rate=RATE):
    """Return a fault that changes one ping."""
    return lambda folder: rewrite(ping(folder), change, rate)


def table(change):
    """Return a fault that changes the header and the rows of the table."""

    def fault(folder):
        header, *rows = (folder / "poses.csv").read_text().splitlines()
        names, cells = change(header.split(","), [row.split(",") for row in rows])
        lines = [",".join(names), *(",".join(row) for row in cells)]
        (folder / "poses.csv").write_text("\n".join(lines) + "\n")

    return fault


def cell(row, column, value):
    """Return a fault that writes one cell."""

    def change(names, rows):
        rows[row][names.index(column)] = value
        return names, rows

    return table(change)


def renamed(**names):
    """Return a fault that renames columns."""
    return table(lambda header, rows: ([names.get(name, name) for name in header], rows))


def paired(order):
    """Return a fault that gives the pings other rows' poses."""
    return table(
        lambda names, rows: (
            names,
            [[row[0], *rows[other][1:]] for row, other in zip(rows, order, strict=True)],
        )
    )


def settings(*lines):
    """Return a fault that appends to import.yaml, or replaces a text in it."""

    def fault(folder):
        file = folder / "import.yaml"
        text = file.read_text()
        for old, new in lines:
            assert old in text
            text = text.replace(old, new)
        file.write_text(text)

    return fault


def with_nan(samples):
    found = samples.astype("float32") / 32768
    found[700, 1] = np.nan
    return found


def without_channel(samples, noise=0.0):
    found = samples.astype("float32")
    rng = np.random.default_rng(int(np.abs(samples[:9]).sum()))
    found[:, 2] = noise * rng.normal(size=len(found))
    return np.round(found).astype("int16")


def background(samples=SAMPLES, rate=RATE, channels=4):
    def fault(folder):
        wavfile.write(folder / "empty.wav", rate, np.zeros((samples, channels), "int16"))
        settings(("compress: true", "compress: true, background: empty.wav"))(folder)

    return fault


def flat_ears(folder):
    lines = ["azimuth_deg,elevation_deg,frequency_hz,gain,receiver"]
    lines += [
        f"{azimuth},0,{frequency},1,{ear}"
        for azimuth in range(-180, 180, 10)
        for frequency in (20e3, 80e3)
        for ear in range(4)
    ]
    (folder / "ears.csv").write_text("\n".join(lines) + "\n")
    settings(("directivity: omnidirectional", "directivity: file\n  file: ears.csv"))(folder)


def long_file(change):
    """Return a fault in one long recording in place of many files."""

    def fault(folder):
        shutil.rmtree(folder)
        write_long(folder, PINGS)
        table(change)(folder)

    return fault


def times(factor=1.0, name="time_s"):
    def change(names, rows):
        place = names.index("time_s")
        for row in rows:
            row[place] = repr(float(row[place]) * factor)
        return [name if each == "time_s" else each for each in names], rows

    return change


def same_time(names, rows):
    rows[7][names.index("time_s")] = rows[3][names.index("time_s")]
    return names, rows


FIRST = list(range(PINGS))
SHUFFLED = np.random.default_rng(3).permutation(PINGS).tolist()
FAULTS = {
    # Files.
    "no table": (lambda f: (f / "poses.csv").unlink(), r"poses\.csv: no table of poses"),
    "no ping": (lambda f: ping(f).unlink(), r"1 poses have no recording, .*ping_005\.wav"),
    "a ping has no pose": (
        lambda f: shutil.copy(ping(f), ping(f, 999)),
        r"1 recordings have no pose, such as ping_999\.wav",
    ),
    "truncated": (
        lambda f: ping(f).write_bytes(ping(f).read_bytes()[:5000]),
        r"ping_005\.wav: damaged or truncated",
    ),
    "no sound": (lambda f: ping(f).write_text("hello"), r"ping_005\.wav: no WAV file"),
    "short": (one(lambda s: s[:700]), r"ping_005\.wav: has 700 samples .*is it cut off\?"),
    "NaN": (every(with_nan), r"ping_000\.wav and 47 more: holds samples that are NaN"),
    "another rate": (one(lambda s: s, 384_000), r"ping_005\.wav: 4 channels at 384000 Hz"),
    "a channel less": (one(lambda s: s[:, :3]), r"ping_005\.wav: 3 channels"),
    "channels less": (every(lambda s: s[:, :3]), r"3 channels, and the settings describe 4"),
    "silent channel": (every(without_channel), r"channel 2 is silent in all pings"),
    "doubled channel": (every(lambda s: s[:, [0, 1, 1, 3]]), r"channels 1 and 2 hold the same"),
    "all silent": (every(lambda s: 0 * s), r"silent"),
    "clipped": (
        every(lambda s: np.clip(s.astype(int) * 9, -9000, 9000).astype("int16")),
        r"all 48 pings are clipped",
    ),
    "other background": (background(rate=192_000), r"empty\.wav: 4 channels at 192000 Hz"),
    "background of a channel": (background(channels=1), r"empty\.wav: 1 channels"),
    "time-expanded": (every(lambda s: s, 40_000), r"frequency_max.*sampling_rate|above half"),
    "no call": (lambda f: (f / "call.wav").unlink(), r"call\.wav: no such file"),
    "silent call": (
        lambda f: wavfile.write(f / "call.wav", RATE, np.zeros(400, "int16")),
        r"call\.wav: is silent",
    ),
    # Tables.
    "no unit": (renamed(x_mm="x"), r"column x has no unit; name it x_m or set import\.length"),
    "unknown column": (renamed(z_mm="depth_mm"), r"unknown column 'depth_mm'"),
    "NaN in the table": (cell(3, "x_mm", "nan"), r"poses\.csv.*x_mm.*(finite|nan)"),
    "text in the table": (cell(3, "qw", "none"), r"poses\.csv:5: column qw|poses\.csv.*qw.*none"),
    "no quaternion": (cell(3, "qw", "3.0"), r"the quaternion of row 4 has length"),
    "a column less": (
        table(lambda names, rows: (names[:-1], [row[:-1] for row in rows])),
        r"column qz is missing",
    ),
    "a ping twice": (cell(3, "file", "ping_005.wav"), r"ping_003\.wav|2 pings in ping_005\.wav"),
    # Settings.
    "unknown key": (settings(("frame: ned", "frames: ned")), r"frames.*did you mean frame"),
    "no such channel": (
        settings(("compress: true", "compress: true, channels: [0, 1, 2, 7]")),
        r"import\.channels: no channel 7; the recordings have 0 to 3",
    ),
    "range beyond the end": (
        settings(("frequency_min: 20000.0", "range_max: 2.0, frequency_min: 20000.0")),
        r"the recordings end .* before spectrogram\.range_max",
    ),
    # One long file.
    "ms for s": (long_file(times(1e-3)), r"check column time and its unit"),
    "s for ms": (long_file(times(1e3)), r"lies after the end .*column time, its unit"),
    "one time twice": (long_file(same_time), r"rows 4 and 8 have the same time of emission"),
}
WARNED = {
    "unplugged channel": (
        every(lambda s: without_channel(s, 30.0)),
        r"channel 2 heard echoes in \d+ of 48 pings",
    ),
    "faint channel": (
        every(lambda s: (s * [1, 1, 1, 0.002]).astype("float32")),
        r"channel 3 is 5\d dB fainter",
    ),
    "flat directivity": (flat_ears, r"ears\.csv: the directivity is measured in one plane"),
    "off by one": (paired([*FIRST[1:], 0]), r"pose one row earlier; .* off by one"),
    "shuffled": (paired(SHUFFLED), r"\d+ of \d+ first echoes contradict the others"),
    "north and east": (renamed(x_mm="y_mm", y_mm="x_mm"), r"another convention of poses"),
    "wrong frame": (settings(("frame: ned", "frame: enu")), r"left and right|another convention"),
    "millimetres for metres": (renamed(x_mm="x_m", y_mm="y_m", z_mm="z_m"), r"lengths in mm\?"),
    "scalar last": (renamed(qw="qz", qx="qw", qy="qx", qz="qy"), r"scalar is its last number"),
    "swapped channels": (every(lambda s: s[:, [2, 1, 0, 3]]), r"channels 0 and 2 swapped"),
    "wrong rate": (every_file(500_000), r"sampling rate"),
    "late": (
        every(lambda s: np.concatenate((np.zeros((600, 4), "int16"), s[:-600]))),
        r"time of the emission|sampling rate",
    ),
}


@pytest.fixture(autouse=True)
def four_gigabytes():
    """A fault that takes 4 GB of memory, with the half that the command starts with, fails."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    used = sum(1024 * int(line.split()[1]) for line in lines if line.startswith("VmData:"))
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (used + 3_500_000_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def said_of(folder, output, caplog):
    """Return what an import says, and how long it takes, s."""
    begun = time.monotonic()
    with caplog.at_level(logging.WARNING, "sononerf"):
        known = plan_import("recordings", folder, output)
        lines = [line for line in describe_plan(known) if line.startswith("warning")]
        lines += [check_before(known).message]
    lines += [record.getMessage() for record in caplog.records]
    return "\n".join(lines).strip(), time.monotonic() - begun


def test_a_sound_set_raises_no_alarm(folder, tmp_path, caplog):
    assert said_of(folder, tmp_path / "store", caplog)[0] == ""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_refused_with_one_line_and_leaves_nothing(name, folder, tmp_path):
    fault, words = FAULTS[name]
    fault(folder)
    store = tmp_path / "store"
    begun = time.monotonic()
    with pytest.raises(SonoNerfError, match=words) as caught:
        write_import(plan_import("recordings", folder, store), store)
    assert time.monotonic() - begun < 10.0
    assert "\n" not in str(caught.value)
    assert not store.exists() or not any(store.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("name", WARNED)
def test_a_fault_is_named_in_a_warning(name, folder, tmp_path, caplog):
    fault, words = WARNED[name]
    fault(folder)
    said, seconds = said_of(folder, tmp_path / "store", caplog)
    assert seconds < 20.0
    assert re.search(words, said), said


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_sound_sets_raise_no_alarm(seed, tmp_path, caplog):
    folder: Path = tmp_path / "recordings"
    (write_long if seed % 4 == 3 else write_folder)(folder, 30 + 3 * seed, seed)
    assert said_of(folder, tmp_path / "store", caplog)[0] == ""
