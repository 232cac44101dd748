# SPDX-License-Identifier: MIT
"""The plugins of docs/extending.md hold what they promise, and learn."""

from __future__ import annotations

import re
from pathlib import Path

import lightning
import numpy as np
import pytest

import sononerf as sn
from sononerf import testing
from sononerf.field.fitting import quiet_lightning
from sononerf.run.scenes import TEMPLATES

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "extending.md").read_text()
FIELD, RENDERER = (
    (TEMPLATES / kind / f"my_{kind}.py").read_text(encoding="utf-8")
    for kind in ("field", "renderer")
)
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def names_of(code):
    names = {}
    exec(compile(code, "guide", "exec"), names)
    return names


HASH_GRID = names_of(next(block for block in BLOCKS if "class HashGrid" in block))["HashGrid"]


@pytest.fixture(scope="module")
def splats():
    return names_of(next(block for block in BLOCKS if "class SplatField" in block))


def test_the_page_shows_the_field_that_is_written():
    assert FIELD in BLOCKS


def test_fields_and_renderers_hold(splats):
    testing.check_field(names_of(FIELD)["make"], width=16)
    testing.check_renderer(names_of(RENDERER)["make"])
    testing.check_field(HASH_GRID, entries=64)
    testing.check_field(splats["SplatField"])
    testing.check_renderer(splats["SplatRenderer"], field=splats["SplatField"])


@pytest.fixture(scope="module")
def echoes():
    """Of three places in front of a head without beams: a short tone at the range of each."""
    head = sn.Head(
        ears={"directivity": "omnidirectional", "beam_radius": 0},
        spectrogram={
            "range_min": 0.2,
            "range_max": 0.3,
            "frequency_min": 30e3,
            "frequency_max": 60e3,
        },
    )
    poses = sn.Poses.sphere(60, radius=0.25)
    heard = np.zeros((60, 2, len(head.range), len(head.frequency)))
    for place in ((0.0, 0.0, 0.015), (0.01, 0.0, -0.01), (-0.01, 0.01, 0.0)):
        emitters, receivers = head.places(poses.positions, poses.rotations)
        out = np.linalg.norm(emitters - place, axis=-1)[:, None]
        back = np.linalg.norm(receivers - place, axis=-1)
        apart = head.range - (out + back)[..., None] / 2
        heard += np.exp(-((apart / 0.004) ** 2))[..., None]
    return sn.Echoes.from_arrays(heard, poses, head)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "left"), [("siren", 0.95), ("hash", 0.97), ("splats", 0.9)])
def test_they_learn(kind, left, echoes, splats, tmp_path):
    quiet_lightning()
    field, renderer, options = names_of(FIELD)["make"], "profile", {"width": 64}
    if kind == "hash":
        field, options = HASH_GRID, {"entries": 4096}
    elif kind == "splats":
        field, renderer, options = splats["SplatField"], splats["SplatRenderer"], {"count": 50}
    model = sn.EchoModule.for_echoes(
        echoes, field, renderer, region=((-0.02,) * 3, (0.02,) * 3), field_options=options,
        options={"steps_per_epoch": 100},
    )  # fmt: skip
    errors = []

    class Errors(lightning.Callback):
        def on_train_epoch_end(self, trainer, pl_module):
            errors.append(float(trainer.callback_metrics["val/mae_db"]))

    lightning.Trainer(
        max_epochs=3, callbacks=[Errors()], logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, default_root_dir=tmp_path,
    ).fit(model, sn.EchoDataModule(echoes))  # fmt: skip
    assert errors[-1] < left * errors[0], errors
