# SPDX-License-Identifier: MIT
"""What each thing is worth in which the paper and its published code differ.

One fit of the paper's settings for each, the same number of epochs and the same seed; the first is
the paper's way, and every other one takes the code's in one thing. Figures are those of each run's
``metrics.json``; what is traced off a mesh is left out of them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

from sononerf import storage
from sononerf.errors import SettingsError
from tools.benchmarks.experiment import Row, aligned, ending, origin, run_experiment
from tools.benchmarks.paper import PAPER


class Variant(NamedTuple):
    """One way of the published code, by the settings for it."""

    name: str
    settings: tuple[str, ...]


VARIANTS = (
    Variant("paper", ()),
    Variant("angles", ("field.options.inputs=angles", "renderer.options.direction=sensor")),
    Variant("call-spectrum", ("renderer.options.call_spectrum=learned",)),
    Variant("silent-share", ("fit.silent_share=0.2",)),
    Variant("loss", ("fit.loss=l1_4l2",)),
    Variant("100-calls", ("poses.count=100",)),
    Variant(
        "volume",
        (
            "poses.arrangement=volume",
            "poses.half_angle_deg=180",
            "poses.radius=0.3",
            "poses.radius_max=0.6",
            "poses.aim_jitter_deg=0",
        ),
    ),
    Variant("500-slices", ("spectrogram.range_max=0.493",)),
    Variant("chirp", ("call.kind=hyperbolic",)),
    Variant("one-place", ("ears.left=[-0.010, 0, 0.005]",)),
    Variant("smoothed", ("reconstruction.smoothing=0.045",)),
    Variant("28.6-mm", ("scene.options.radius=0.0286",)),
)


def variants(arguments: argparse.Namespace) -> str:
    """Fit the paper's settings as its text and as its code have them, one difference at a time."""
    output = arguments.output or Path("runs") / f"variants-{arguments.scene}"
    data = arguments.data or output / "data"
    file = output / "variants.json"
    rows: list[Row] = []
    for variant in VARIANTS:
        length = f"fit.epochs={arguments.epochs}"
        settings = [f"scene.name={arguments.scene}", length, *arguments.set, *variant.settings]
        with ending(output):
            try:
                metrics = run_experiment(
                    output / variant.name, data, settings, config=PAPER, enough="prediction"
                )
                row = row_of(metrics)
            except (RuntimeError, SettingsError) as error:
                if isinstance(error, SettingsError) and not variant.settings:
                    raise  # wrong for all of them; not every scene has a radius
                row = {"failed": str(error)}
        rows.append({"name": variant.name, "settings": settings, **row})
        print(f"{output / variant.name}: {row.get('failed', 'done')}", file=sys.stderr, flush=True)
        storage.commit_json(file, {**origin(), "scene": arguments.scene, "rows": rows})
    return f"{table(rows)}\nwrote {file}"


def row_of(metrics: dict[str, Any]) -> Row:
    """Return what is compared; None for what a run does not have."""
    cost, prediction, geometry = (
        metrics.get(part) or {} for part in ("cost", "prediction", "geometry")
    )
    return {
        "fit_s": cost.get("fit_s"),
        "steps": cost.get("steps"),
        "mae_db": prediction.get("rendered_mae_db"),
        "mae_db_active": prediction.get("rendered_mae_db_active"),
        "mean_mae_db": prediction.get("mean_predictor_mae_db"),
        "mean_mae_db_active": prediction.get("mean_predictor_mae_db_active"),
        "fscore_5mm": geometry.get("fscore", {}).get("0.005"),
        "chamfer_m": geometry.get("chamfer_m"),
        "parts": geometry.get("components"),
    }


TITLES = ("variant", "steps", "fit/s", "all/dB", "mean", "active/dB", "mean", "F 5mm", "Chamfer/mm")
COLUMNS = (
    ("steps", "d", 1),
    ("fit_s", ".0f", 1),
    ("mae_db", ".2f", 1),
    ("mean_mae_db", ".2f", 1),
    ("mae_db_active", ".2f", 1),
    ("mean_mae_db_active", ".2f", 1),
    ("fscore_5mm", ".2f", 1),
    ("chamfer_m", ".1f", 1000),
)


def table(rows: list[Row]) -> str:
    """Return one line for each variant, and one for each that failed."""
    lines = [list(TITLES)]
    lines += [
        [row["name"]]
        + [
            "-" if row.get(key) is None else f"{scale * row[key]:{form}}"
            for key, form, scale in COLUMNS
        ]
        for row in rows
    ]
    failed = [f"{row['name']}: {row['failed']}" for row in rows if "failed" in row]
    return "\n".join([*aligned(lines), *failed])
