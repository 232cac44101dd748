# SPDX-License-Identifier: MIT
"""One page of HTML that contains its pictures and meshes: it opens offline and can be mailed."""

from __future__ import annotations

import base64
import html
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.io import wavfile

from sononerf.echoes.echoes import Echoes
from sononerf.evaluation.numbers import Evaluation
from sononerf.evaluation.prediction import Prediction
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import compress
from sononerf.head.head import Head
from sononerf.numerics import Floats
from sononerf.report.figure import camera_for
from sononerf.report.mesh_picture import confidence_png, mesh_png
from sononerf.report.spectrogram_picture import spectrogram_picture
from sononerf.scene.scene import Scene
from sononerf.start.surface import Surface

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

        copies = {name: mesh.copy() for name, mesh in meshes.items()}
        for mesh in copies.values():
            mesh.apply_transform(_camera_frame())
        scenes = {name: trimesh.Scene([mesh]) for name, mesh in copies.items()}
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


STRETCH = 10.0
"""Factor by which an echo is longer and lower in pitch: 20 to 100 kHz become 2 to 10 kHz."""
RATE = 44_100
"""Sampling rate, Hz; every player supports it."""
PAUSE = 0.25
"""Silence before and after the echo, s, because some players cut off the first milliseconds."""
LOUDEST = 0.8
"""Largest sample, as a fraction of full scale, so that nothing clips."""


def echo_wav(
    magnitude: ArrayLike, range_m: ArrayLike, frequency_hz: ArrayLike, speed_of_sound: float
) -> bytes:
    """Return the echo of a pose as a WAV file, ten times longer and lower.

    A spectrogram has no phase. The sound is a sum of one tone per frequency; each tone has the
    magnitude of the spectrogram over time, and a random phase that is the same in every call. The
    left channel is the left ear.

    In: magnitude (E, R, F), range_m ((R,), m), frequency_hz ((F,), Hz), speed_of_sound (m/s).
    """
    heard = np.asarray(magnitude, dtype=np.float64)[:2]
    ranges, frequencies = np.asarray(range_m, dtype=float), np.asarray(frequency_hz, dtype=float)
    arrival = STRETCH * 2.0 * (ranges - ranges[0]) / speed_of_sound
    time = np.arange(int(arrival[-1] * RATE) + 1) / RATE
    low = frequencies / STRETCH
    audible = low < RATE / 2
    phase = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(low))
    tones = np.cos(2.0 * np.pi * low * time[:, None] + phase) * audible
    place = np.interp(time, arrival, np.arange(len(ranges)))
    before = np.minimum(place.astype(int), max(len(ranges) - 2, 0))
    after, part = np.minimum(before + 1, len(ranges) - 1), (place - before)[:, None]
    waves = np.stack(
        [(tones * ((1 - part) * one[before] + part * one[after])).sum(axis=1) for one in heard],
        axis=1,
    )
    top = np.abs(waves).max()
    silence = np.zeros((int(PAUSE * RATE), waves.shape[1]))
    samples = np.concatenate([silence, waves * (LOUDEST / top if top > 0 else 0.0), silence])
    file = io.BytesIO()
    wavfile.write(file, RATE, (samples * 32767).astype(np.int16))
    return file.getvalue()


def html_of(thing: object) -> str:
    """Return the HTML of an object: its kind, its numbers, and its picture where it has one."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
        for name, value in rows_of(thing)
    )
    text = f"<b>{type(thing).__name__}</b><table>{rows}</table>"
    png = png_of(thing)
    if png is not None:
        data = base64.b64encode(png).decode()
        text += f"<img style='max-width:480px' alt='' src='data:image/png;base64,{data}'>"
    return text


@singledispatch
def rows_of(thing: object) -> Rows:
    """Return name and value of an object's numbers, as text."""
    return [("", repr(thing))]


@singledispatch
def png_of(thing: object, **options: Any) -> bytes | None:
    """Return the picture of an object as a PNG file; None where it has none."""
    del thing, options
    return None


def _extent(positions: np.ndarray[Any, Any]) -> str:
    return " x ".join(f"{1e3 * size:.4g}" for size in np.ptp(positions, axis=0)) + " mm"


@rows_of.register
def _(thing: Scene) -> Rows:
    return [
        ("triangles", f"{len(thing.mesh.faces):,}"),
        ("size", _extent(thing.mesh.vertices)),
        ("materials", str(len(thing.materials))),
    ]


@png_of.register
def _(thing: Scene, **options: Any) -> bytes | None:
    del options
    return mesh_png(thing.mesh)


@rows_of.register
def _(thing: Poses) -> Rows:
    distance = np.linalg.norm(thing.positions, axis=1)
    return [
        ("poses", str(len(thing))),
        ("distance from the origin", f"{distance.min():.4g} to {distance.max():.4g} m"),
    ]


@rows_of.register
def _(thing: Head) -> Rows:
    low, high = thing.frequency[[0, -1]] / 1e3
    near, far = thing.range[[0, -1]]
    return [
        ("receivers", f"{len(thing.receivers)}, {thing.ears.directivity}"),
        ("call", thing.call.kind),
        ("frequency", f"{low:.1f} to {high:.1f} kHz, {len(thing.frequency)} bins"),
        ("range", f"{near:.3f} to {far:.3f} m, {len(thing.range)} slices"),
        ("range resolution", f"{1e3 * thing.resolution:.2g} mm"),
        ("speed of sound", f"{thing.speed_of_sound:.1f} m/s"),
    ]


@rows_of.register
def _(thing: Echoes) -> Rows:
    train, validation, test = np.bincount(thing.store.split, minlength=3)
    counts = f"{train} train, {validation} validate, {test} held out"
    floor = thing.store.attributes.get("noise_floor_mae_db")
    known = [] if floor is None else [("noise floor", f"{floor:.2g} dB")]
    return [("poses", f"{len(thing)}: {counts}"), *rows_of(thing.head), *known]


@png_of.register
def _(thing: Echoes, *, pose: int | None = None, prediction: Prediction | None = None) -> bytes:
    number = int([*thing.store.indices("test"), 0][0]) if pose is None else pose
    measured = compress(thing.spectrogram(number), thing.reference)
    levels: tuple[Any, Any] = (measured, None)
    if prediction is not None:
        row = thing.numbers_of(prediction.poses).tolist().index(number)
        levels = (measured, compress(prediction.magnitude[row], thing.reference))
    return spectrogram_picture(*levels, thing.head.range, thing.head.frequency, f"pose {number}")


@rows_of.register
def _(thing: Surface) -> Rows:
    rows: Rows = [
        ("triangles", f"{len(thing.mesh.faces):,}"),
        ("size", _extent(thing.mesh.vertices)),
        ("found as", thing.method),
        ("refined", "yes" if thing.refined else "no"),
    ]
    if thing.error_db is not None:
        rows.append(("mismatch on validation poses", f"{thing.error_db:.2f} dB"))
    return rows


@png_of.register
def _(thing: Surface, **options: Any) -> bytes | None:
    del options
    seen = thing.confidence
    return mesh_png(thing.mesh) if seen is None else confidence_png(thing.mesh, seen)


@rows_of.register
def _(thing: Prediction) -> Rows:
    rows: Rows = [
        ("poses", str(len(thing.poses))),
        ("weight of traced echoes", f"{thing.traced_weight:.2f}"),
    ]
    return rows if thing.traced_fault is None else [*rows, ("not traced", thing.traced_fault)]


@png_of.register
def _(thing: Prediction, *, pose: int = 0) -> bytes:
    level = compress(thing.magnitude[pose], thing.reference)
    return spectrogram_picture(None, level, thing.range, thing.frequency, f"pose {pose}")


@rows_of.register
def _(thing: Evaluation) -> Rows:
    return [*thing.rows()]
