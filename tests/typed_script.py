# SPDX-License-Identifier: MIT
"""A user's script with every public name, for mypy --strict; it is checked, not run."""

from __future__ import annotations

import lightning
import numpy as np
import torch
import trimesh
from torch import Tensor

import sononerf as sn


class Constant(sn.Field):
    """Reflects the same everywhere."""

    def __init__(self, region: Tensor, frequency: Tensor, *, level: float = 0.1) -> None:
        super().__init__(region, frequency)
        self.level = torch.nn.Parameter(torch.tensor(level))

    @property
    def resolution(self) -> float:
        return 0.01

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        inside = self.inside(positions)[..., None]
        return self.level * inside * torch.ones_like(self.frequency)


class Silent(sn.Renderer):
    """Hears nothing."""

    def forward(
        self,
        field: sn.Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        count = len(self.frequency) if bins is None else len(bins)
        return self.log_gain.exp() * torch.zeros(len(rows), len(self.ears), rows.shape[1], count)


def main() -> None:
    scene: sn.Scene = sn.Scene.load("mug.stl", unit="mm", material="leaf")
    soft = sn.Scene(trimesh.creation.box((0.1, 0.1, 0.1)), sn.Material(reflection=(0.5,)))
    poses: sn.Poses = sn.Poses.sphere(40, radius=0.4)[3:20]
    head = sn.Head(air={"temperature_c": 20.0}, call={"kind": "linear"})
    echoes: sn.Echoes = sn.simulate(soft, poses, head, options={"rays": 1000}, output="store")
    mine = sn.Echoes.from_arrays(np.zeros((17, 2, 3, 4)), poses, head, split=["train"] * 17)
    mine.save("mine")
    recorded = sn.read_recordings("recordings", "data/mine", options={"air": {"temperature_c": 20}})
    model = sn.EchoModule.for_echoes(echoes, Constant, Silent, options={"epochs": 3})
    data = sn.EchoDataModule(echoes)
    lightning.Trainer(max_epochs=1).fit(model, data)
    again: sn.EchoModule = sn.fit(recorded, sn.EchoModule.for_echoes(recorded))
    surface: sn.Surface = sn.refine(sn.reconstruct(again, recorded), recorded)
    heard: sn.Prediction = sn.predict(model, surface, echoes.poses("test"))
    numbers: sn.Evaluation = sn.evaluate(surface, scene, echoes)
    proposed: sn.Poses = sn.next_poses(surface, recorded, 3, within="cap")
    print(len(proposed), numbers["chamfer_m"], sn.compare(heard, echoes)["mae_db"], sn.__version__)
    run: sn.Run = sn.open_run("runs/ua")
    difference: sn.Comparison = sn.compare(run, sn.open_run("runs/other"))
    print(difference.score, run.predict(poses, traced=False).level_db.shape)
    echoes.plot(0, heard).save("pose.png")
    surface.save("mesh.ply")
