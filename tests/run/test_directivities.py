# SPDX-License-Identifier: MIT
"""A fit with the right measured ear is better than with the wrong one, whatever the format."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sononerf.head.directivity.directivity_files import write_sofa
from tests.command import succeed
from tests.head.directivity.patterns import FREQUENCY, pair, sononerf_fields, write_v5

SHARPER = 4


def write_csv(path, ears, order=(0, 1)):
    """Write a table of gains; an order of (1, 0) gives each ear the other one's."""
    x, y, z = ears.directions.T
    azimuth = np.degrees(np.arctan2(y, x)).round(6)
    elevation = np.degrees(np.arcsin(z)).round(6)
    lines = ["receiver,azimuth_deg,elevation_deg,frequency_hz,gain"]
    for number, ear in enumerate(order):
        for m in range(len(x)):
            lines += [
                f"{number},{azimuth[m]},{elevation[m]},{frequency},{ears.gains[ear, m, f]:.9f}"
                for f, frequency in enumerate(FREQUENCY)
            ]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.slow
def test_the_right_ear_fits_better(tmp_path):
    ears = pair(beam=False)
    # Narrow lobes, so that much depends on them.
    ears = replace(ears, gains=ears.gains**SHARPER)
    sides = sononerf_fields()["array_struct"]
    for side in ("left_struct", "right_struct"):
        table = sides[side]["hrtf_gridded_array"]
        sides[side] = {**sides[side], "hrtf_gridded_array": table**SHARPER}
    write_sofa(tmp_path / "right.sofa", ears)
    write_v5(tmp_path / "right.mat", {"array_struct": sides})
    write_csv(tmp_path / "right.csv", ears)
    write_csv(tmp_path / "wrong.csv", ears, (1, 0))

    run = partial(succeed, tmp_path)
    places = "ears.receivers=[[0, 0.01, 0.002], [0, -0.01, 0.002]]"
    run(
        *("simulate", "scene.name=three_spheres", "poses.count=40", "simulation.rays=5000"),
        *("simulation.noise_floor_poses=0", "ears.directivity=file", "ears.file=right.sofa"),
        *(places, "--output", "direct", "--waveforms", "recordings"),
    )
    error = {}
    for name in ("right.sofa", "right.mat", "right.csv", "wrong.csv"):
        run("import", "recordings", "recordings", f"ears.file={name}", "--output", f"s-{name}")
        run(
            *("fit", f"data.store=s-{name}", "fit.epochs=3", "prediction.traced=off"),
            *("reconstruction.refine=false", "--output", f"r-{name}"),
        )
        metrics = json.loads((tmp_path / f"r-{name}/metrics.json").read_text())
        error[name] = metrics["prediction"]["mae_db_active"]
    right = max(error[name] for name in error if name.startswith("right"))
    assert right < 0.9 * error["wrong.csv"]
    assert right < 1.1 * error["right.sofa"]
