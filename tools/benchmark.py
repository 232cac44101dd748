#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Measure what sononerf costs and how well it does.

    python tools/benchmark.py simulate [--scene ua] [--rays 300000] [--poses 400]
    python tools/benchmark.py cost configs/three_spheres.yaml [--poses 20]
    python tools/benchmark.py noise [--scene ua] [--poses 20]
    python tools/benchmark.py physics
    python tools/benchmark.py exact [--scene three_spheres] [--engines hybrid rays] [--poses 8]
    python tools/benchmark.py wave [--bodies spheres leaf beaker] [--poses 8]
    python tools/benchmark.py dechirp
    python tools/benchmark.py shapes [--count 20] [--first 0] [--seconds 60]
    python tools/benchmark.py poses [--scene three_spheres] [--counts 12 25 50 100 200 400]
    python tools/benchmark.py paper [--scene three_spheres] [--minutes 60] [--steps N]
    python tools/benchmark.py variants [--scene three_spheres] [--epochs 10]
    python tools/benchmark.py scale [--counts 100 400 1600] [--axes poses slices size places]
    python tools/benchmark.py surfaces [--only NAME ...] [--seeds 0 1 2] [--exact STORE]
    python tools/benchmark.py step [--accelerator cpu] [--compare OLD.json]
    python tools/benchmark.py fit [--scene three_spheres] [--error 0.45] [--compare OLD.json]
    python tools/benchmark.py reconstruct RUN [RUN ...] [--spacings 0.002 0.001]
    python tools/benchmark.py prey [--placements 20] [--others 5] [--conditions NAME ...]

``simulate``: seconds per pose, against those that embreex alone needs for the same rays, those for
visibility included, and the greatest memory. ``cost``: CPU seconds per pose of a configuration, the
low band of all its poses included; set OMP_NUM_THREADS=1 first. ``noise``: by how much two
simulations differ that have other rays, 16 times as many, or twice as many; with the reported
decibels, on active cells.
``physics``: both engines against exact solutions. ``exact``: engines against exact multiple
scattering of spheres, by band, and what they put before the first echo. ``wave``: bem against exact
spheres, then the others against bem on a leaf and a beaker; some ten minutes. ``dechirp``: where
and how long a point echo is in the rows of a dechirped sweep.

``step``: what a step of a fit costs for each field through each renderer, medians of at least
five, beside equation 17 of the paper written down as it stands (which takes 9 GB of memory), the
machine's matrix product and its copying. ``fit``: how long the default takes to a held-out error.
``reconstruct``: how long fitted runs take to be read out. The files of these three are named by
version, machine and device, and ``--compare`` prints what has changed.

``shapes``: the whole default experiment for shapes that nobody chose, each from its seed.
``poses``: the same for one scene and ever more calls. ``paper``: how much sooner the default gets
to the held-out error to which the paper's own field, renderer and training come in so many minutes,
or steps. ``variants``: the paper's settings with one thing after the other as its published code
has it. ``scale``: what simulation, a step, reading out and memory come to with ever more poses,
range slices, room and places. ``prey``: whether leaves with a dragonfly at places from seeds are
told from the empty leaf, and how far off it is looked for, with fewer and more calls, without ears,
in noise and amid clutter; about two minutes for each case on two cores. ``surfaces``: how good the
surfaces of all kinds of scenes are, some under changed conditions; one line of JSON for each run.
What is ``scaled`` is measured in the unscaled world's metres. All seven leave runs, a table
as JSON and logs in a folder (``--output``), share ensembles (``--data``), go on where they were
interrupted, and lay KEY=VALUE over the settings (``--set``).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # the parts of this command, and the tests' exact solutions

from tools.benchmarks.cost import cost  # noqa: E402
from tools.benchmarks.exact import exact  # noqa: E402
from tools.benchmarks.fit import fit  # noqa: E402
from tools.benchmarks.paper import paper  # noqa: E402
from tools.benchmarks.physics import dechirp, physics  # noqa: E402
from tools.benchmarks.poses import COUNTS, poses  # noqa: E402
from tools.benchmarks.prey import CONDITIONS, prey  # noqa: E402
from tools.benchmarks.reconstruct import reconstruct  # noqa: E402
from tools.benchmarks.scale import COUNTS as SCALE_COUNTS  # noqa: E402
from tools.benchmarks.scale import scale  # noqa: E402
from tools.benchmarks.shapes import shapes  # noqa: E402
from tools.benchmarks.simulator import noise, simulate  # noqa: E402
from tools.benchmarks.step import step  # noqa: E402
from tools.benchmarks.surfaces import CASES, surfaces  # noqa: E402
from tools.benchmarks.variants import variants  # noqa: E402
from tools.benchmarks.wave import wave  # noqa: E402

MAIN_HELP = "places of prey under the conditions 100-calls and clutter (20)"
OTHER_HELP = "places of prey under every other condition (5)"
CONDITIONS_HELP = "fewer or more calls, no ears, noise (signal to noise in dB), clutter; all"
SECONDS_HELP = "fits that take longer are marked in the table (60)"
ERROR_HELP = "over all cells of held-out poses, dB (0.45)"
ONLY_HELP = "rows of the table; all, but exact only with --exact"
SEEDS_HELP = "of the fits of three_spheres, ua and leaf; of all others the first alone (0 1 2)"
EXACT_HELP = "ensemble of exact echoes of three_spheres, 100 calls, analysed up to 80 kHz"
SPACINGS_HELP = "voxel sizes in metres; by default the run's own"
SET_HELP = "laid over the settings of every run"


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for run, default in ((simulate, 400), (noise, 20), (physics, None), (dechirp, None)):
        command = commands.add_parser(run.__name__, help=(run.__doc__ or "").strip())
        command.set_defaults(run=run)
        if default is not None:
            command.add_argument("--scene", default="ua")
            command.add_argument("--poses", type=int, default=default)
            command.add_argument("--bounces", type=int, default=3)
        if run is simulate:
            command.add_argument("--rays", type=int, default=300_000)
    command = commands.add_parser(cost.__name__, help=(cost.__doc__ or "").strip())
    command.set_defaults(run=cost)
    command.add_argument("config", type=Path)
    command.add_argument("--poses", type=int, default=20, help="that are traced (20)")
    command = commands.add_parser(exact.__name__, help=(exact.__doc__ or "").strip())
    command.set_defaults(run=exact)
    command.add_argument("--scene", default="three_spheres")
    command.add_argument("--engines", nargs="+", default=["hybrid", "rays", "kirchhoff"])
    command.add_argument("--poses", type=int, default=8)
    command = commands.add_parser(wave.__name__, help=(wave.__doc__ or "").strip())
    command.set_defaults(run=wave)
    names = ("spheres", "leaf", "beaker")
    command.add_argument("--bodies", nargs="+", choices=names, help="those three")
    command.add_argument("--poses", type=int, default=8)
    for series in (shapes, poses, paper, variants, scale, prey, surfaces, step, fit, reconstruct):
        command = commands.add_parser(series.__name__, help=(series.__doc__ or "").split("\n")[0])
        command.set_defaults(run=series)
        if series is shapes:
            command.add_argument("--count", type=int, default=20, help="how many")
            command.add_argument("--first", type=int, default=0, help="the first seed")
        if series is prey:
            command.add_argument("--placements", type=int, default=20, help=MAIN_HELP)
            command.add_argument("--others", type=int, default=5, help=OTHER_HELP)
            names = [condition.name for condition in CONDITIONS]
            command.add_argument("--conditions", nargs="+", choices=names, help=CONDITIONS_HELP)
        if series is surfaces:
            names = [case.name for case in CASES]
            command.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=ONLY_HELP)
            command.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help=SEEDS_HELP)
            command.add_argument("--exact", type=Path, metavar="STORE", help=EXACT_HELP)
        if series is step:
            command.add_argument("--accelerator", choices=("auto", "cpu", "gpu"), default="auto")
        if series in (step, fit, reconstruct):
            command.add_argument("--compare", type=Path, metavar="OLD.json", help="print ratios")
        if series is fit:
            command.add_argument("--error", type=float, default=0.45, help=ERROR_HELP)
        if series is reconstruct:
            command.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="fitted runs")
            command.add_argument("--spacings", type=float, nargs="+", help=SPACINGS_HELP)
        if series in (poses, paper, variants, step, fit):
            command.add_argument("--scene", default="three_spheres")
        if series is scale:
            command.add_argument("--counts", type=int, nargs="+", default=SCALE_COUNTS)
            axes = ("poses", "slices", "size", "places")
            command.add_argument("--axes", nargs="+", choices=axes, help="what grows; all")
        if series is poses:
            command.add_argument("--counts", type=int, nargs="+", default=COUNTS)
        if series is paper:
            command.add_argument("--minutes", type=float, default=60.0, help="of the paper's fit")
            command.add_argument("--steps", type=int, help="of the paper's fit; none are timed")
        elif series is variants:
            command.add_argument("--epochs", type=int, default=10, help="of each fit (10)")
        elif series not in (scale, surfaces, step, fit, reconstruct):
            command.add_argument("--seconds", type=float, default=60.0, help=SECONDS_HELP)
        command.add_argument("--output", type=Path, help="folder of runs and table")
        if series is reconstruct:
            continue
        command.add_argument("--data", type=Path, help="folder of the ensembles; DIR/data")
        command.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help=SET_HELP)
    arguments = parser.parse_args()
    found = arguments.run(arguments)
    print(found if isinstance(found, str) else json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
