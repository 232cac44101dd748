# SPDX-License-Identifier: MIT
"""One page of HTML that contains its pictures and meshes: it opens offline and can be mailed."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from sononerf.numerics import Floats
from sononerf.report.pictures.shading import camera_for

Rows = list[tuple[str, ...]]
BASELINES = ("backprojection", "voxels")
"""Names of the baselines in ``metrics.json``."""
NONE = "-"
"""Text for a number that does not apply or is not known yet."""


@dataclass(frozen=True)
class KeyNumber:
    """A number of ``metrics.json``."""

    label: str  # Its name, with its unit
    key: str  # Its keys in the file, from the outside in, separated by slashes
    factor: float = 1.0  # From the file's unit to the label's
    form: str = ".2f"  # Format of the number

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


STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222a33; background: #fff;
       max-width: 76rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.7rem; margin: 0.5rem 0; } h2 { font-size: 1.25rem; margin: 2rem 0 0.5rem; }
h3 { font-size: 1.05rem; margin: 1.2rem 0 0.3rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.5rem 0; font-size: 0.92rem; }
th, td { padding: 0.25rem 0.8rem; border-bottom: 1px solid #d5dae0; text-align: right;
         font-variant-numeric: tabular-nums; vertical-align: top; }
th:first-child, td:first-child { text-align: left; } thead th { border-bottom: 2px solid #8a94a0; }
img { max-width: 100%; height: auto; } figure { margin: 0.6rem 0; }
figcaption { font-size: 0.9rem; color: #55606c; }
.side { display: flex; flex-wrap: wrap; gap: 0.8rem; align-items: flex-start; }
.side figure { flex: 1 1 18rem; margin: 0; min-width: 0; }
.view { height: min(92vw, 34rem); width: 100%; border: 1px solid #d5dae0; box-sizing: border-box; }
pre { overflow-x: auto; background: #f4f6f8; padding: 0.8rem; font-size: 0.85rem; }
code { background: #f4f6f8; padding: 0 0.2rem; overflow-wrap: anywhere; }
select { font: inherit; margin: 0.3rem 0; max-width: 100%; }
"""

SWITCH = """
const page = %s, shapes = %s;
const frame = document.getElementById("view"), choice = document.getElementById("shape");
const show = () => { frame.srcdoc = page.replace("$SHAPE", () => shapes[choice.value]); };
choice.addEventListener("change", show);
show();
"""


class Page:
    """A page; each method adds a part at its end.

    Attributes:
        parts: HTML, one part after the other.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.parts = [f"<h1>{html.escape(title)}</h1>"]

    def heading(self, text: str, level: int = 2) -> None:
        """Begin a section; the page's title has level 1."""
        self.parts.append(f"<h{level}>{html.escape(text)}</h{level}>")

    def say(self, text: str) -> None:
        """Add a paragraph; text between backticks is shown as code."""
        self.parts.append(f"<p>{_inline(text)}</p>")

    def code(self, text: str) -> None:
        """Add lines unchanged."""
        self.parts.append(f"<pre>{html.escape(text)}</pre>")

    def table(self, rows: Sequence[Sequence[str]]) -> None:
        """Add a table; its first row has the heads of the columns."""
        head, *body = ["".join(f"<td>{_inline(cell)}</td>" for cell in row) for row in rows]
        head = head.replace("td>", "th>")
        lines = "".join(f"<tr>{row}</tr>" for row in body)
        self.parts.append(
            f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{lines}</tbody></table></div>"
        )

    def pictures(self, pictures: Mapping[str, bytes]) -> None:
        """Add PNG files by their captions, side by side where there is room."""
        figures = "".join(
            f'<figure><img src="data:image/png;base64,{base64.b64encode(png).decode()}" '
            f'alt="{html.escape(caption)}"><figcaption>{_inline(caption)}</figcaption></figure>'
            for caption, png in pictures.items()
        )
        self.parts.append(f'<div class="side">{figures}</div>')

    def view(self, meshes: Mapping[str, trimesh.Trimesh]) -> None:
        """Add a 3D view of coloured meshes that turns by mouse and touch; once per page."""
        from trimesh.exchange.gltf import export_glb
        from trimesh.viewer.notebook import scene_to_html

        turned = {name: mesh.copy() for name, mesh in meshes.items()}
        for mesh in turned.values():
            mesh.apply_transform(_camera_frame())
        scenes = {name: trimesh.Scene([mesh]) for name, mesh in turned.items()}
        for scene in scenes.values():
            _ = scene.camera  # made at first use; the viewer needs the one in the file
        first = next(iter(scenes.values()))
        plain = base64.b64encode(first.export(file_type="glb")).decode()
        viewer = scene_to_html(first).replace(plain, "$SHAPE")
        shapes = {
            name: base64.b64encode(export_glb(scene, tree_postprocessor=_matt)).decode()
            for name, scene in scenes.items()
        }
        options = "".join(
            f'<option value="{html.escape(name)}">{html.escape(name)}</option>' for name in shapes
        )
        script = SWITCH % tuple(json.dumps(one).replace("</", "<\\/") for one in (viewer, shapes))
        self.parts.append(
            f'<label>Show <select id="shape">{options}</select></label>'
            f'<iframe class="view" id="view" title="mesh in three dimensions"></iframe>'
            f"<script>{script}</script>"
        )

    def html(self) -> str:
        """Return the whole page."""
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title>"
            '<link rel="icon" href="data:,">'
            f"<style>{STYLE}</style></head><body>\n" + "\n".join(self.parts) + "\n</body></html>\n"
        )


def _matt(tree: dict[str, Any]) -> None:
    """Give all meshes of a glTF file a matt material, because the default material is metal.

    Colours are halved, because the viewer's light is too strong.
    """
    half = [0.5, 0.5, 0.5, 1.0]
    surface = {"metallicFactor": 0.0, "roughnessFactor": 0.9, "baseColorFactor": half}
    tree["materials"] = [{"pbrMetallicRoughness": surface, "doubleSided": True}]
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            part["material"] = 0


def _camera_frame() -> Floats:
    """Return the rotation (4, 4) after which a camera on the z axis, y up, sees the front."""
    towards, right, up = camera_for(np.eye(3), size=(1, 1)).axes
    frame = np.eye(4)
    frame[:3, :3] = right, up, towards
    return frame


def _inline(text: str) -> str:
    return re.sub("`([^`]*)`", r"<code>\1</code>", html.escape(text))
