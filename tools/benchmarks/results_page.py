# SPDX-License-Identifier: MIT
"""The page of results and the README's table, from the runs of `surfaces`."""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tools.benchmarks.experiment import ROOT, Row, rows_of
from tools.benchmarks.foreign import STARTS

PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"
MARKS = ("<!-- numbers -->", "<!-- end of the numbers -->")
"""Lines of the README between which its table stands."""
BOTH = ("three_spheres", "ua")
HEAD = """# Results

Written by `python tools/benchmark.py surfaces --page`
from runs of commit {commit}, where no other is named ({machine}, no GPU). Default settings, seed 0
of poses and fit, 400 training poses where no other number is named, and 20 held-out poses that were
drawn apart and never trained on. The echoes come from our own simulator. Decibels, active cells and
scores are explained in the README; how long it takes is in [performance.md](performance.md).

What was measured at other commits (few calls, real recordings, exact echoes, receivers and bands,
self-calibration, errors of vertices, next poses, earlier versions) is in
[notes/history.md](notes/history.md).
"""
FOREIGN = """
## Bodies of others

{count} closed bodies that a program of other people composed of boxes, cylinders, wedges and stones
(the random objects in the data of pybullet 3.2.7, every thirtieth from 302 on; turned at random,
their parts united, 35 to 140 mm large). None of them was used for a training or a constant. Others
of the program, with numbers up to 292, are 230 of the 540 bodies of the training of the start
network. Several versions were measured on these bodies, and the rule that compares planes with free
surfaces was chosen with these results in view, so the figures are slightly too good.

```sh
python tools/benchmark.py surfaces --foreign FOLDER --calls {calls}
```

Of echoes alone, without a field. `levels` and `fuller` are two levels of the network's probability,
`sheet` the one height that is fitted to it; the row of a start is that surface, not refined.
F-scores at 2 mm: median · least · mean. The boxes and wedges of a body touch or nearly touch; where
they do not overlap, the true number of parts is above one, though it sounds like one body.

"""
OWN = """
## Scenes of this project

Own scenes, of kinds that the start network was trained on.

```sh
python tools/benchmark.py surfaces --seeds 0 --only {names}
```
"""


def write_page(output: Path, page: Path = PAGE, readme: Path = README) -> str:
    """Write the page and the README's table from the rows and runs in a folder."""
    own = [row for row in rows_of(output / "surfaces.jsonl") if "failed" not in row]
    own = [row for row in own if row["seed"] == 0]
    foreign = rows_of(output / "foreign.jsonl")
    if not own and not foreign:
        raise SystemExit(f"error: {output}: holds no finished rows (surfaces.jsonl, foreign.jsonl)")
    usual = statistics.mode(row["commit"] for row in (*own, *foreign))
    for row in (*own, *foreign):
        if row["commit"] != usual:
            row["name"] += f" (commit {row['commit']})"
    machine = (own or foreign)[0]["machine"]
    text = HEAD.format(commit=usual, machine=machine)
    if foreign:
        calls = sorted({row["calls"] for row in foreign}, reverse=True)
        count = len({row["name"] for row in foreign})
        text += FOREIGN.format(count=count, calls=" ".join(map(str, calls)))
        text += _foreign_tables(foreign, calls)
    if own:
        names = " ".join(row["name"].partition(" ")[0] for row in own)
        text += OWN.format(names=names) + _own_table(own)
    runs = {name: output / f"{name}-0" / "metrics.json" for name in BOTH}
    if all(file.is_file() for file in runs.values()):
        metrics = {name: json.loads(file.read_text("utf-8")) for name, file in runs.items()}
        table = _both(metrics)
        text += "\n## Three spheres and UA\n\n" + table
        inside = f"{MARKS[0]}\n{table}{MARKS[1]}"
        old, pattern = readme.read_text(encoding="utf-8"), f"{MARKS[0]}.*{MARKS[1]}"
        readme.write_text(re.sub(pattern, lambda _: inside, old, flags=re.DOTALL), "utf-8")
    page.write_text(text, encoding="utf-8")
    return f"wrote {page} and {readme}"


def _table(lines: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * len(lines[0])
    return "".join(f"| {' | '.join(line)} |\n" for line in (lines[0], rule, *lines[1:]))


def _foreign_tables(rows: Sequence[Row], calls: Sequence[int]) -> str:
    """Return a table by number of calls, and one by body for the largest number."""

    def line(title: str, shown: Callable[[list[Row]], str]) -> list[str]:
        return [title, *(shown([row for row in rows if row["calls"] == one]) for one in calls)]

    def spread(some: Sequence[Row], start: str | None = None) -> str:
        surfaces = [row["starts"].get(start) if start else row["result"] for row in some]
        scores = [surface["fscore_2mm"] for surface in surfaces if surface]
        if not scores:
            return "-"
        of = "" if len(scores) == len(some) else f" (of {len(scores)})"
        middle, least, mean = statistics.median(scores), min(scores), statistics.fmean(scores)
        return f"{middle:.2f} · {least:.2f} · {mean:.2f}{of}"

    def median(some: Sequence[Row], key: str) -> float:
        return statistics.median(row["result"][key] for row in some)

    def torn(some: Sequence[Row]) -> str:
        return str(sum(row["result"]["parts"] > 1 for row in some))

    present = [name for name in STARTS if any(name in row["starts"] for row in rows)]
    summary = [
        ["", *(f"{one} calls" for one in calls)],
        line("**result**", lambda some: f"**{spread(some)}**"),
        *(line(f"start `{name}`", partial(spread, start=name)) for name in present),
        line("median Chamfer distance", lambda some: f"{1e3 * median(some, 'chamfer_m'):.2f} mm"),
        line("median F-score at 5 mm", lambda some: f"{median(some, 'fscore_5mm'):.2f}"),
        line("results of more than one part", torn),
        line("bodies", lambda some: str(len(some))),
    ]
    bodies = [["number", "start `levels`", "F 2 mm", "Chamfer", "parts (true)", "chosen"]]
    for row in sorted(rows, key=lambda row: str(row["name"])):
        if row["calls"] != calls[0]:
            continue
        result = row["result"]
        bodies.append(
            [
                row["name"].removeprefix("random"),
                f"{row['starts']['levels']['fscore_2mm']:.2f}",
                f"{result['fscore_2mm']:.2f}",
                f"{1e3 * result['chamfer_m']:.2f} mm",
                f"{result['parts']} ({result['parts_true']})",
                f"`{row['chosen']}`" + ("" if row["kept"] else ", unrefined"),
            ]
        )
    return f"{_table(summary)}\nBody by body, {calls[0]} calls:\n\n{_table(bodies)}"


def _own_table(rows: Sequence[Row]) -> str:
    lines = [["", "Chamfer", "F 1 · 2 · 5 mm", "parts (true)", "field alone", "all"]]
    for row in rows:
        scores = " · ".join(f"{row[f'fscore_{mm}mm']:.2f}" for mm in (1, 2, 5))
        lines.append(
            [
                row["name"],
                f"{1e3 * row['chamfer_m']:.2f} mm",
                scores,
                f"{row['parts']} ({row['parts_true']})",
                f"{row['rendered_mae_db_active']:.2f} dB",
                f"{row['heldout_mae_db']:.2f} · {row['heldout_mae_db_active']:.2f} dB",
            ]
        )
    said = "*Field alone*: active cells. *All*: with traced echoes, all · active cells."
    return f"\n{said}\n\n{_table(lines)}"


def _both(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of three_spheres and ua, with noise floor and baselines."""

    def row(title: str, of: Callable[[Mapping[str, Any]], str]) -> list[str]:
        return [title, *(of(metrics) for metrics in runs.values())]

    def error(metrics: Mapping[str, Any], cells: str) -> str:
        part = metrics["prediction"]
        names = (f"mae_db{cells}", f"mean_predictor_mae_db{cells}", f"noise_floor_mae_db{cells}")
        own, mean, floor = (part[name] for name in names)
        return f"{own:.2f} dB ({mean:.2f} · {floor:.2f})"

    def scores(part: Mapping[str, Any]) -> str:
        return " · ".join(f"{part['fscore'][f'0.00{mm}']:.2f}" for mm in (1, 2, 5))

    def distance(metrics: Mapping[str, Any]) -> str:
        own = metrics["geometry"]["chamfer_m"]
        others = " · ".join(
            f"{1e3 * metrics['baseline'][name]['chamfer_m']:.1f}"
            for name in ("backprojection", "voxels")
        )
        return f"{1e3 * own:.2f} mm ({others})"

    def rendered(metrics: Mapping[str, Any]) -> str:
        part = metrics["prediction"]
        return f"{part['rendered_mae_db']:.2f} · {part['rendered_mae_db_active']:.2f} dB"

    lines = [
        ["", *runs],
        row("the field's rendering alone, held-out, all · active cells", rendered),
        row(
            "field and traced echoes, all cells (mean spectrogram · noise floor)",
            lambda metrics: error(metrics, ""),
        ),
        row("the same, active cells", lambda metrics: error(metrics, "_active")),
        row("Chamfer distance (backprojection · voxel fit)", distance),
        row(
            "F-score at 1 · 2 · 5 mm (backprojection)",
            lambda m: f"{scores(m['geometry'])} ({scores(m['baseline']['backprojection'])})",
        ),
        row(
            "thickness bias · volume over true volume",
            lambda m: (
                f"{1e3 * m['geometry']['thickness_bias_m']:+.2f} mm · "
                f"{m['geometry']['volume_ratio']:.2f}"
                if m["geometry"]["volume_ratio"] is not None
                else "open"
            ),
        ),
        row(
            "parts (true)",
            lambda m: f"{m['geometry']['components']} ({m['geometry']['components_true']})",
        ),
    ]
    return _table(lines)
