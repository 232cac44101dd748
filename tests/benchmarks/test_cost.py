# SPDX-License-Identifier: MIT
import argparse
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from tools.benchmarks import simulator as module

pytestmark = pytest.mark.thorough


class Some(NamedTuple):
    positions: Any
    rotations: Any

    def __len__(self):
        return len(self.positions)


def test_solving_is_shared_by_all_poses_and_the_first_call_is_not_counted(monkeypatch, tmp_path):
    """A clock that stands still but where something works: 8 s to solve, 5 s first, then 1 s."""
    now, asked = [0.0], []

    def prepare(positions, rotations):
        assert len(positions) == len(rotations) == 4
        now[0] += 8.0

    def spectrogram(position, rotation, *, seed):
        now[0] += 1.0 if asked else 5.0
        asked.append(float(position[0]))

    engine = SimpleNamespace(prepare=prepare)
    simulator = SimpleNamespace(engine=engine, spectrogram=spectrogram)
    monkeypatch.setattr(module.time, "process_time", lambda: now[0])
    monkeypatch.setattr(module, "simulator_of", lambda scene, settings: simulator)
    poses = Some(np.arange(4.0)[:, None], np.zeros((4, 3, 3)))
    monkeypatch.setattr(module, "ensemble_poses", lambda settings: (poses, None))
    config = tmp_path / "some.yaml"
    config.write_text("scene:\n  name: three_spheres\n")
    found = module.cost(argparse.Namespace(config=config, poses=2))
    assert asked == [0.0, 0.0, 3.0]
    assert (found["solved_s"], found["traced_s"], found["pose_s"]) == (2.0, 1.0, 3.0)
