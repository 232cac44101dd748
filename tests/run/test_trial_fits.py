# SPDX-License-Identifier: MIT
"""A turntable's radius and a support's height are found by fits at several values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.errors import NumericalError, SettingsError
from sononerf.geometry.poses import cylinder_poses
from sononerf.head.head import Head
from sononerf.run.calibrate import calibrate
from sononerf.run.fit import fit
from sononerf.run.reconstruct import reconstruct
from sononerf.run.trial_fits import MOST, least_error
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import SpectrogramSettings
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.still_surface import StillSurface
from tests.run.conftest import TINY
from tests.surface.conftest import bumpy  # noqa: F401

ERROR = 0.006
"""What the radius is stated too large by, m: about one range resolution."""


@pytest.mark.parametrize("true", [-2.3, 0.2, 1.4, 3.0])
def test_the_least_error_is_found_with_few_fits(true):
    asked = []

    def error_at(step):
        asked.append(step)
        return 2.0 + 0.1 * (step - true) ** 2

    at, deviation = least_error(error_at)
    assert at == pytest.approx(true)
    assert deviation < 0.5
    assert len(asked) == len(set(asked)) <= 3 + abs(round(true))


def test_a_least_error_at_the_end_is_none():
    asked = []
    at, deviation = least_error(lambda step: asked.append(step) or -float(step))
    assert (at, deviation, len(asked)) == (MOST - 2, math.inf, MOST)
    with pytest.raises(NumericalError, match="no surface at any of the values"):
        least_error(lambda step: math.inf)


def test_a_value_without_a_surface_is_the_worst():
    at, _ = least_error(lambda step: math.inf if step < 0 else (step - 1.2) ** 2)
    assert at == pytest.approx(1.2)


@pytest.fixture
def run(bumpy, tmp_path):  # noqa: F811
    """A fit to a turntable whose radius is stated wrongly."""
    head = Head(analysis=SpectrogramSettings(range_min=0.24, range_max=0.42))
    rng, split = np.random.default_rng(0), np.arange(40) % 10 == 5
    poses = cylinder_poses(40, radius=0.3, heights=(0.0, 0.1), aim_jitter=0.0, generator=rng)
    heard = StillSurface(bumpy, Optics(head)).render(poses.positions, poses.rotations)
    stated = poses.positions * (1.0 + ERROR / 0.3 * np.array([1.0, 1.0, 0.0]))
    told = type(poses)(stated, poses.rotations)
    Echoes.from_arrays(heard, told, head, split=split.astype(int)).save(tmp_path / "store")
    sections = ("field", "renderer", "fit", "preview")
    plain = {name: TINY[name] for name in sections} | {"data": {"store": str(tmp_path / "store")}}
    made = fit(validate_settings(plain, "test"), tmp_path / "run")
    reconstruct(made)
    return tmp_path


@pytest.mark.slow
def test_each_radius_is_fitted_once(run):
    """A small body between few poses does not tell its radius; how well is in docs/results.md."""
    found = calibrate(run / "run", run / "out", ["radius"])
    assert found.lines[0].startswith("radius:")
    off = found.estimate.calibration.radius
    distance = np.linalg.norm(Echoes.open(run / "out").positions[:, :2], axis=1)
    np.testing.assert_allclose(distance, 0.3 + ERROR + off, atol=1e-5)
    made = {file: file.stat().st_mtime_ns for file in (run / "out-trials").rglob("*.safetensors")}
    assert len({file.parent for file in made}) >= 2
    (run / "out-trials").rename(run / "again-trials")
    again = calibrate(run / "run", run / "again", ["radius"])
    assert again.lines == found.lines
    now = {file.stat().st_mtime_ns for file in (run / "again-trials").rglob("*.safetensors")}
    assert now == set(made.values())


@pytest.mark.slow
def test_such_errors_are_found_alone(run):
    with pytest.raises(SettingsError, match="radius is found by fits at several values"):
        calibrate(run / "run", run / "out", ["radius", "gain"])
    assert not (run / "out").exists()
