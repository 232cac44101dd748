# SPDX-License-Identifier: MIT
"""Processes that end while results are on their way."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

SCRIPT = """
import numpy as np
from contextlib import closing
from sononerf.geometry.poses import Poses
from sononerf.simulation.simulator import simulated
from tests.simulation.test_workers import Loud

poses = Poses(np.zeros((64, 3)), np.tile(np.eye(3), (64, 1, 1)))
for _ in range(40):
    with closing(simulated(Loud(), poses, list(range(64)), lambda i: i, workers=2)) as results:
        next(results)
print("done")
"""


class Loud:
    """Answers at once, with so much that it does not fit into a pipe."""

    low = None

    def spectrogram(self, position, rotation, *, seed):
        return np.full((2, 900, 470), seed, np.float32)


class Plain:
    """A simulator of 4,000 rays."""

    low, rays = None, SimpleNamespace(rays=4000)


@pytest.mark.slow
def test_workers_that_are_stopped_while_they_answer_keep_nobody_waiting():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.stdout, done.returncode) == ("done\n", 0), done.stderr
