# SPDX-License-Identifier: MIT
"""Processes that end while results are on their way."""

import subprocess
import sys

import pytest

SCRIPT = """
import numpy as np
from contextlib import closing
from sononerf.geometry.poses import Poses
from sononerf.simulation.workers import in_processes
from tests.simulation.test_workers import Loud

poses = Poses(np.zeros((64, 3)), np.tile(np.eye(3), (64, 1, 1)))
for _ in range(40):
    with closing(in_processes(Loud(), poses, list(range(64)), lambda i: i, 2)) as results:
        next(results)
print("done")
"""


class Loud:
    """Answers at once, with so much that it does not fit into a pipe."""

    engine = None

    def spectrogram(self, position, rotation, *, seed):
        import numpy as np

        return np.full((2, 900, 470), seed, np.float32)


@pytest.mark.thorough
def test_workers_that_are_stopped_while_they_answer_keep_nobody_waiting():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.stdout, done.returncode) == ("done\n", 0), done.stderr
