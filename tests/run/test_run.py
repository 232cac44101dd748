# SPDX-License-Identifier: MIT
"""A run that is opened from Python answers as its commands do."""

from __future__ import annotations

import numpy as np
import pytest

import sononerf as sn
from sononerf.errors import InputError
from sononerf.progress import Progress
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct

QUIET = Progress(quiet=True)


def test_an_opened_run_has_its_parts(run, no_projections):
    predict(run, accelerator="cpu", pictures=0)
    reconstruct(run, spacing=0.008, accelerator="cpu")
    opened = sn.open_run(run)
    assert opened.path == run
    assert len(opened.echoes) == 12
    assert opened.head is opened.model.head
    assert opened.metrics["prediction"]["poses"] == 2
    assert "prediction mae_db" in str(opened.metrics)
    assert len(opened.surface.confidence) == len(opened.surface.mesh.vertices)
    assert "mae_db" in opened._repr_html_()
    heard = opened.predict(opened.echoes.poses("test"), progress=QUIET)
    stored = np.load(run / "prediction" / "spectrograms.npz")
    np.testing.assert_array_equal(heard.magnitude, stored["predicted"])
    numbers = sn.compare(heard, opened.echoes)
    assert numbers["mae_db"] == pytest.approx(opened.metrics["prediction"]["mae_db"])


def test_what_is_no_run_is_refused(tmp_path, run):
    with pytest.raises(InputError, match="no fitted run"):
        sn.open_run(tmp_path)
    with pytest.raises(InputError, match="there is no surface"):
        sn.open_run(run).surface  # noqa: B018
    with pytest.raises(InputError, match="expected a Prediction and Echoes, or two runs"):
        sn.compare(sn.open_run(run), 3)
