#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Measure what sononerf costs and how well it does.

    python tools/benchmark.py exact [--bodies three_spheres balls leaf beaker]
    python tools/benchmark.py surfaces [--only NAME ...] [--seeds 0 1 2] [--exact STORE]
    python tools/benchmark.py surfaces --foreign FOLDER [--calls 400 100 25]
    python tools/benchmark.py surfaces --page [--output FOLDER]
    python tools/benchmark.py step [--accelerator cpu] [--compare OLD.json]
    python tools/benchmark.py errors RUN [RUN ...] [--calibrate]

``exact``: the simulator against frozen solutions of the wave equation, by band, and what it puts
before the first echo.

``step``: what a step of a fit costs for each field through each renderer, medians of at least
five, beside equation 17 of the paper written down as it stands (which takes 9 GB of memory), the
machine's matrix product and its copying. Its file is named by version, machine and device, and
``--compare`` prints what has changed.

``errors``: the fractions of vertices and of held-out cells that the errors of finished runs hold,
and the area under the sparsification error, beside that of the numbers of poses and, where runs of
seeds 1 to 4 lie beside that of seed 0, of how far their surfaces lie apart.

``surfaces``: how good the surfaces of all kinds of scenes are, some under changed conditions; one
line of JSON for each run. With ``--foreign`` all bodies of a folder are reconstructed instead, of
echoes alone, and each start surface and each candidate of the refinement is compared with the truth
too. It leaves runs, a table and logs in a folder (``--output``), shares ensembles (``--data``),
goes on where it was interrupted, and lays KEY=VALUE over the settings (``--set``).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # the parts of this command, and the tests' exact solutions

from tools.benchmarks.errors import errors  # noqa: E402
from tools.benchmarks.exact import exact  # noqa: E402
from tools.benchmarks.step import step  # noqa: E402
from tools.benchmarks.surfaces import CASES, surfaces  # noqa: E402

BODIES = ["three_spheres", "balls", "leaf", "beaker"]
ONLY_HELP = "rows of the table; all, but exact only with --exact"
SEEDS_HELP = "of the fits of three_spheres, ua and leaf; of all others the first alone (0 1 2)"
EXACT_HELP = "ensemble of exact echoes of three_spheres, 100 calls, analysed up to 80 kHz"
PAGE_HELP = "write docs/results.md and the README's table from the finished runs of --output"
FOREIGN_HELP = "closed meshes in metres, in place of the rows of the table"
SET_HELP = "laid over the settings of every run"


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)

    def added(run: Callable[[argparse.Namespace], Any]) -> argparse.ArgumentParser:
        command = commands.add_parser(run.__name__, help=(run.__doc__ or "").split("\n")[0])
        command.set_defaults(run=run)
        return command

    command = added(exact)
    command.add_argument("--bodies", nargs="+", choices=BODIES, default=BODIES, help="all")
    command.add_argument("--engines", nargs="+", default=["hybrid", "rays"])
    command.add_argument("--rays", type=int, default=100_000, help="per pose (100000)")
    command = added(errors)
    command.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="finished runs")
    command.add_argument("--calibrate", action="store_true", help="print exponents and scale")
    command = added(step)
    command.add_argument("--accelerator", choices=("auto", "cpu", "gpu"), default="auto")
    command.add_argument("--compare", type=Path, metavar="OLD.json", help="print ratios")
    command.add_argument("--scene", default="three_spheres")
    names = [case.name for case in CASES]
    command = added(surfaces)
    command.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=ONLY_HELP)
    command.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help=SEEDS_HELP)
    command.add_argument("--exact", type=Path, metavar="STORE", help=EXACT_HELP)
    command.add_argument("--page", action="store_true", help=PAGE_HELP)
    command.add_argument("--foreign", type=Path, metavar="FOLDER", help=FOREIGN_HELP)
    command.add_argument(
        "--calls", type=int, nargs="+", default=[400, 100, 25], help="of --foreign"
    )
    for name in ("step", "surfaces"):
        command = commands.choices[name]
        command.add_argument("--output", type=Path, help="folder of runs and table")
        command.add_argument("--data", type=Path, help="folder of the ensembles; DIR/data")
        command.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help=SET_HELP)
    arguments = parser.parse_args()
    found = arguments.run(arguments)
    print(found if isinstance(found, str) else json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
