# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.directivity.read import content_hash, read_directivity
from sononerf.head.directivity.sofa import write_sofa
from tests.head.directivity.patterns import (
    batslam_fields,
    pair,
    sononerf_fields,
    write_v5,
    write_v73,
)


def write_table(path):
    known = pair()
    x, y, z = known.directions.T
    angles = np.degrees([np.arctan2(y, x), np.arcsin(z)]).T
    lines = ["receiver,azimuth_deg,elevation_deg,frequency_hz,gain"]
    for name, gains in (("0", known.gains[0]), ("1", known.gains[1]), ("emitter", known.beam)):
        lines += [
            f"{name},{a:.9f},{e:.9f},{frequency:.9g},{gain:.17g}"
            for (a, e), row in zip(angles, gains, strict=True)
            for frequency, gain in zip(known.frequency, row, strict=True)
        ]
    path.write_text("\n".join(lines))


WRITERS = {
    "sofa": lambda path: write_sofa(path, pair()),
    "sononerf v5": lambda path: write_v5(path, sononerf_fields()),
    "sononerf v7.3": lambda path: write_v73(path, sononerf_fields()),
    "batslam v5": lambda path: write_v5(path, batslam_fields()),
    "batslam v7.3": lambda path: write_v73(path, batslam_fields()),
    "table": write_table,
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
def test_formats_are_told_apart_by_content(tmp_path, write):
    path = tmp_path / "any.dat"
    write(path)
    assert len(read_directivity(path).gains) == 2


def test_a_file_is_read_once_until_it_changes(tmp_path):
    path = tmp_path / "a.sofa"
    write_sofa(path, pair())
    first, hashed = read_directivity(path), content_hash(path)
    assert read_directivity(path) is first
    write_sofa(path, pair(beam=False))
    assert read_directivity(path).beam is None
    assert content_hash(path) != hashed


def test_what_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_directivity(tmp_path / "a.sofa")
    with pytest.raises(InputError, match="cannot be read"):
        read_directivity(tmp_path)
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="columns none"):
        read_directivity(tmp_path / "empty")
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
