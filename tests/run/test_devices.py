# SPDX-License-Identifier: MIT
"""Two processes on one machine: Lightning starts the second with the same command."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SMOKE = Path(__file__).parents[2] / "configs" / "smoke.yaml"


@pytest.mark.slow
def test_two_devices_fit_what_one_fits(tmp_path):
    found = []
    for devices in ("1", "2"):
        folder = f"run-{devices}"
        command = [sys.executable, "-m", "sononerf.cli", "fit", str(SMOKE), "--output", folder]
        command += ["--accelerator", "cpu", "--devices", devices]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        found.append(json.loads((tmp_path / folder / "metrics.json").read_text())["prediction"])
    one, two = found
    # Sums over half batches round differently; 120 steps of Adam let that grow, here to 0.02 dB.
    # What is traced off the mesh of so short a fit hangs on where its surface is torn.
    assert two["rendered_mae_db"] == pytest.approx(one["rendered_mae_db"], abs=0.1)
    assert two["mae_db"] < 0.7 * two["mean_predictor_mae_db"]
