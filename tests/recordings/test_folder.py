# SPDX-License-Identifier: MIT
"""A folder of sound files and a table: each ping has a pose, each pose a ping."""

from __future__ import annotations

import subprocess
import sys
import unicodedata

import h5py
import numpy as np
import pytest
from scipy.io import wavfile

from sononerf.errors import InputError
from sononerf.recordings.readers import read_arrays, read_folder
from sononerf.recordings.recording import Cutter
from sononerf.settings.sections import ImportSettings

RATE = 100_000
PLAIN = ImportSettings()


def wav(path, channels=2, rate=RATE, value=0.0):
    wavfile.write(path, rate, np.full((60, channels), value, "float32"))


@pytest.fixture
def folder(tmp_path):
    """Three pings in a file each, with a table."""
    for index in range(3):
        wav(tmp_path / f"{index}.wav", value=index / 10)
    write(tmp_path, ["file,x_m,y_m,z_m", *(f"{index}.wav,{index},0,0" for index in range(3))])
    return tmp_path


def write(folder, lines):
    (folder / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_one_file_per_ping(folder):
    found = read_folder(folder, PLAIN)
    assert found.labels == ("0.wav", "1.wav", "2.wav")
    assert found.sampling_rate == RATE
    np.testing.assert_allclose(found.read(2), 0.2)
    assert found.emission.tolist() == [0, 0, 0]
    assert read_folder(folder / "poses.csv", PLAIN).labels == found.labels


def test_one_long_file_with_times(tmp_path):
    wav(tmp_path / "long.wav")
    write(tmp_path, ["time_ms,x_m", "0.1,0", "0.3,1"])
    found = read_folder(tmp_path, PLAIN)
    np.testing.assert_allclose(found.emission, [1e-4, 3e-4])
    assert found.labels == ("long.wav, row 1", "long.wav, row 2")
    named = read_folder(tmp_path, ImportSettings(file="long.wav"))
    assert named.labels == found.labels


def test_npz_and_hdf5_are_files_too(folder):
    np.savez(folder / "0.npz", waveform=np.ones((2, 60)), sampling_rate=RATE)
    with h5py.File(folder / "1.h5", "w") as file:
        file["waveform"], file["sampling_rate"] = np.full((2, 60), 2.0), RATE
    (folder / "0.wav").unlink()
    (folder / "1.wav").unlink()
    write(folder, ["file,x_m", "0.npz,0", "1.h5,0", "2.wav,0"])
    found = read_folder(folder, PLAIN)
    assert [float(found.read(index)[0, 0]) for index in range(2)] == [1.0, 2.0]


def test_a_rate_may_be_corrected(folder):
    """Recorders of ultrasound write a tenth of their rate, so that it can be heard."""
    assert read_folder(folder, ImportSettings(sampling_rate=1e6)).sampling_rate == 1e6


def test_files_that_are_named_unlike_pings_are_none(folder):
    """The call, background and reference lie beside the pings; other files are listed."""
    wav(folder / "empty.wav")
    wav(folder / "ball.wav")
    wav(folder / "call.wav")
    ball = {"file": "ball.wav", "radius": 0.02, "distance": 0.5}
    settings = ImportSettings(background="empty.wav", reference=ball)
    found = read_folder(folder, settings, [folder / "call.wav"])
    assert (len(found), found.notes) == (3, ())
    assert read_folder(folder, settings).notes == ("call.wav: no pings, as their names say",)


def test_the_long_file_lies_beside_others(folder):
    for index in (0, 1):
        (folder / f"{index}.wav").unlink()
    wav(folder / "call.wav")
    write(folder, ["time_ms,x_m", "0.1,0", "0.3,1"])
    found = read_folder(folder, PLAIN, [folder / "call.wav"])
    assert found.labels[0] == "2.wav, row 1"


def test_a_ping_of_a_long_file_ends_when_the_next_call_leaves(tmp_path):
    wav(tmp_path / "long.wav")
    write(tmp_path, ["time_ms,x_m", "0.3,0", "0.1,1", "0.4,2"])
    found = read_folder(tmp_path, PLAIN)
    np.testing.assert_allclose(found.until, [4e-4, 3e-4, np.inf])
    assert [Cutter(found).samples(index) for index in range(3)] == [10, 20, 20]
    write(tmp_path, ["time_ms,x_m", "0.3,0", "0.1,1", "0.3,2"])
    with pytest.raises(InputError, match=r"rows 1 and 3 have the same time of emission in long"):
        read_folder(tmp_path, PLAIN)


def test_what_has_no_partner_is_refused_or_skipped(folder):
    (folder / "1.wav").unlink()
    with pytest.raises(InputError, match=r"1 poses have no recording, such as 1\.wav"):
        read_folder(folder, PLAIN)
    wav(folder / "7.wav")
    found = read_folder(folder, ImportSettings(missing="skip"))
    assert found.labels == ("0.wav", "2.wav")
    assert found.columns.values["x"].tolist() == [0, 2]
    assert found.notes == ("1 poses without a recording are left out",)
    (folder / "1.wav").write_bytes((folder / "0.wav").read_bytes())
    with pytest.raises(InputError, match=r"1 recordings have no pose, such as 7\.wav"):
        read_folder(folder, PLAIN)


def test_names_are_found_in_other_spellings_and_a_near_one_is_told(folder):
    (folder / "1.wav").rename(folder / unicodedata.normalize("NFD", "é 1.wav"))
    (folder / "sub").mkdir()
    (folder / "2.wav").rename(folder / "sub" / "2.wav")
    names = ["0.wav", unicodedata.normalize("NFC", "é 1.wav"), r"sub\2.wav"]
    write(folder, ["file,x_m,y_m,z_m", *(f"{name},1,0,0" for name in names)])
    np.testing.assert_allclose(read_folder(folder, PLAIN).read(2), 0.2)
    (folder / "0.wav").rename(folder / "0.WAV")
    with pytest.raises(InputError, match=r"such as 0\.wav \(0\.WAV is in "):
        read_folder(folder, PLAIN)


def test_lines_before_the_header_are_left(folder):
    lines = (folder / "poses.csv").read_text().splitlines()
    for before in (["sep=,"], ["# made by hand", "# in June"]):
        write(folder, [*before, *lines])
        assert len(read_folder(folder, PLAIN)) == 3
    write(folder, ["sep=,", *lines, "1.wav,x,0,0"])
    with pytest.raises(InputError, match=r"poses\.csv:6: column x_m is 'x'"):
        read_folder(folder, PLAIN)


def test_hdf5_that_another_process_writes_is_told(folder):
    path = folder / "1.h5"
    with h5py.File(path, "w") as file:
        file["waveform"] = np.zeros((2, 60))
    code = f"import h5py; file = h5py.File({str(path)!r}, 'a'); print('open', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(InputError, match="another process has it open"):
            read_arrays(path)
        other.communicate("\n")
    assert set(read_arrays(path)) == {"waveform"}


def test_a_matlab_file_is_called_one(folder):
    (folder / "a.npz").write_bytes(b"MATLAB 7.3 MAT-file".ljust(600))
    with pytest.raises(InputError, match=r"a\.npz: no \.npz; it is a MATLAB file; save it as HDF5"):
        read_arrays(folder / "a.npz")


def test_what_differs_or_is_missing_is_told(folder):
    def told(words):
        with pytest.raises(InputError) as caught:
            read_folder(folder, PLAIN)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)

    wav(folder / "1.wav", channels=1)
    told("1.wav: 1 channels at 100000 Hz, 0.wav has 2 at 100000 Hz")
    wav(folder / "1.wav", rate=96_000)
    told("1.wav: 2 channels at 96000 Hz")
    wav(folder / "1.wav")
    write(folder, ["x_m", "1", "2", "3"])
    told("no column file, and 3 recordings")
    write(folder, ["file,x_m", ",1"])
    told("column file of row 1 is empty")
    write(folder, ["file,x_m", *["0.wav,1"] * 2, "1.wav,2", "2.wav,3"])
    told("2 pings in 0.wav and no column time")
    (folder / "0.wav").rename(folder / "0.mp3")
    write(folder, ["file,x_m", "0.mp3,1", "1.wav,2", "2.wav,3"])
    told("0.mp3: unknown kind of file")
    (folder / "poses.csv").unlink()
    told("no table of poses")
