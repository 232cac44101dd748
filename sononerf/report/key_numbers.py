# SPDX-License-Identifier: MIT
"""Key numbers of a run, with their units, as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

Rows = list[tuple[str, ...]]
BASELINES = ("backprojection", "voxels")
"""Names of the baselines in ``metrics.json``."""
NONE = "-"
"""Text for a number that does not apply or is not known yet."""


@dataclass(frozen=True)
class KeyNumber:
    """A number of ``metrics.json``.

    Attributes:
        label: Its name, with its unit.
        key: Its keys in the file, from the outside in, separated by slashes.
        factor: From the file's unit to the label's.
        form: Format of the number.
    """

    label: str
    key: str
    factor: float = 1.0
    form: str = ".2f"

    def text(self, metrics: Mapping[str, Any]) -> str:
        """Return the number of a run as text."""
        value: Any = metrics
        for part in self.key.split("/"):
            value = (value or {}).get(part)
        return NONE if value is None else format(self.factor * value, self.form)


PREDICTION = (
    KeyNumber("held-out error, all cells, dB", "prediction/mae_db"),
    KeyNumber("held-out error, active cells, dB", "prediction/mae_db_active"),
    KeyNumber("field alone, all cells, dB", "prediction/rendered_mae_db"),
    KeyNumber("field alone, active cells, dB", "prediction/rendered_mae_db_active"),
    KeyNumber("mean spectrogram, all cells, dB", "prediction/mean_predictor_mae_db"),
    KeyNumber("mean spectrogram, active cells, dB", "prediction/mean_predictor_mae_db_active"),
    KeyNumber("noise floor, all cells, dB", "prediction/noise_floor_mae_db"),
    KeyNumber("noise floor, active cells, dB", "prediction/noise_floor_mae_db_active"),
)
SHAPE = (
    KeyNumber("Chamfer distance, mm", "chamfer_m", 1e3),
    KeyNumber("thickness bias, mm", "thickness_bias_m", 1e3, "+.2f"),
    KeyNumber("volume over true volume", "volume_ratio"),
    KeyNumber("intersection over union", "iou"),
    KeyNumber("normal consistency", "normal_consistency"),
    KeyNumber("parts", "components", form=".0f"),
    KeyNumber("parts in truth", "components_true", form=".0f"),
)
COST = (
    KeyNumber("steps", "cost/steps", form=".0f"),
    KeyNumber("fit, s", "cost/fit_s", form=".0f"),
    KeyNumber("surface, s", "cost/reconstruct_s", form=".0f"),
    KeyNumber("memory at most, GB", "cost/peak_memory_bytes", 1e-9, ".1f"),
    KeyNumber("parameters", "cost/parameters", form=".0f"),
)


def run_rows(runs: Sequence[Mapping[str, Any]]) -> Rows:
    """Return label and one text per run's metrics; rows that no run has are left out."""
    numbers = [*PREDICTION, *_shapes(runs, "geometry", "")]
    target = {limit for run in runs for limit in _scores(run, "geometry/target")}
    numbers += [_fscore(limit, "geometry/target", "target alone: ") for limit in _sorted(target)]
    for baseline in BASELINES:
        numbers += _shapes(runs, f"baseline/{baseline}", f"{baseline}: ")
    rows = [(n.label, *(n.text(run) for run in runs)) for n in [*numbers, *COST]]
    return [row for row in rows if set(row[1:]) != {NONE}]


def _shapes(runs: Sequence[Mapping[str, Any]], key: str, prefix: str) -> list[KeyNumber]:
    """Return the numbers of a surface: F-scores first, then the others."""
    limits = _sorted({limit for run in runs for limit in _scores(run, key)})
    others = [replace(n, label=prefix + n.label, key=f"{key}/{n.key}") for n in SHAPE]
    return [*(_fscore(limit, key, prefix) for limit in limits), *others]


def _scores(run: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found: Any = run
    for part in [*key.split("/"), "fscore"]:
        found = (found or {}).get(part)
    return found or {}


def _sorted(limits: set[str]) -> list[str]:
    return sorted(limits, key=float)


def _fscore(limit: str, key: str, prefix: str) -> KeyNumber:
    return KeyNumber(f"{prefix}F-score at {1e3 * float(limit):g} mm", f"{key}/fscore/{limit}")
