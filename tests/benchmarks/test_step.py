# SPDX-License-Identifier: MIT
from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

import pytest

from tools.benchmarks import step as module
from tools.benchmarks.step import CONFIG, PAIRS, PAPER, Pair

pytestmark = pytest.mark.thorough

ECHOES = [
    "scene.options.radius=0.02",
    "poses.count=8",
    "poses.validation=2",
    "poses.heldout=2",
    "simulation.rays=500",
    "simulation.sources=60",
    "simulation.noise_floor_poses=1",
    "spectrogram.range_min=0.34",
    "spectrogram.range_max=0.45",
]
FEW = ("renderer.options.directions=40", "fit.batch_slices=20")
SMALL = ("field.options.finest=0.01", "fit.batch_poses=2", "renderer.options.points=30")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """One step of three pairs on next to nothing."""
    pairs = (
        Pair(PAIRS[0].name, PAPER, FEW, 1, 2),
        Pair(PAIRS[1].name, PAPER, FEW, 1, 2),
        Pair(PAIRS[3].name, CONFIG, SMALL, 1, 2),
        Pair("half", PAPER, (*FEW, "field.options.precision=bfloat16"), 1, 2),
    )
    output = tmp_path_factory.mktemp("step")
    given = Namespace(
        output=output, data=None, scene="sphere", set=ECHOES, accelerator="cpu", compare=None
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "PAIRS", pairs)
        patch.setattr(
            module, "matrix_rate", lambda device, kind: {"float32": 1e9, "bfloat16": 2e9}[kind]
        )
        text = module.step(given)
    (file,) = output.glob("step-*-cpu.json")
    return text, json.loads(file.read_text())


@pytest.mark.slow
def test_equation_17_as_it_stands_has_the_loss_of_the_shell_renderer(measured):
    _, found = measured
    assert found["loss_of_equation_17_differs_by"] < 1e-4


def test_rates_follow_from_what_was_counted_and_timed(measured):
    _, found = measured
    naive, shell, default, half = found["rows"]
    assert 0 < half["loss_differs"] < 0.02
    assert half["points"] == shell["points"]
    assert naive["points"] == 20 * 40  # every direction of every slice
    assert 0 < shell["points"] < naive["points"]
    assert "flop" not in naive
    assert half["over_matrix_rate"] == pytest.approx(half["flop"] / half["step_s"] / 2e9)
    for row in (shell, default):
        assert row["points_per_s"] == pytest.approx(row["points"] / row["step_s"])
        assert row["over_matrix_rate"] == pytest.approx(row["flop"] / row["step_s"] / 1e9)
    # Backward takes twice the products of forward, but for the embedding, which has no gradient.
    weights = 180 * 256 + 3 * 256**2 + (256 + 180) * 256 + 256**2 + (256 + 180) * 256 + 256 * 128
    forward = 2 * (weights + 128 * 94) * shell["points"]
    assert 2 * forward < shell["flop"] < 3.5 * forward


def test_the_table_says_how_many_times_as_fast(measured):
    text, found = measured
    ratio = found["rows"][0]["step_s"] / found["rows"][1]["step_s"]
    assert f"fourier, shell: {ratio:.1f} times as fast as equation 17" in text
    assert [line.strip().split("  ")[0] for line in text.splitlines()[1:5]] == [
        "equation 17",
        "fourier, shell",
        "grid, profile",
        "half",
    ]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"scene": "nosuch"}, "error: unknown scene 'nosuch'"),
        ({"compare": Path("nofile.json")}, "error: nofile.json"),
    ],
)
def test_what_is_wrong_is_told_in_one_line_before_any_step_is_timed(tmp_path, wrong, said):
    plain = {"output": tmp_path, "data": None, "scene": "sphere", "set": [], "compare": None}
    with pytest.raises(SystemExit, match=f"^{said}"):
        module.step(Namespace(**{**plain, "accelerator": "cpu", **wrong}))
    assert list(tmp_path.iterdir()) == []


def test_each_field_goes_through_each_renderer_with_settings_that_are_known():
    from sononerf.settings.loading import load_settings

    kinds = set()
    for pair in PAIRS[1:]:
        settings = load_settings(pair.config, pair.settings)
        kinds.add((settings.field.kind, settings.renderer.kind))
        assert pair.timed >= 5
    assert kinds == {(f, r) for f in ("fourier", "grid") for r in ("shell", "profile")}
