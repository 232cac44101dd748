# SPDX-License-Identifier: MIT
"""One page of a run, or of several beside one another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from sononerf import storage
from sononerf.errors import InputError
from sononerf.progress import Progress
from sononerf.report.key_numbers import NONE, run_rows
from sononerf.report.page import Page
from sononerf.report.pictures.curve_picture import curves_picture
from sononerf.report.pictures.mip_picture import mip_pictures
from sononerf.report.pictures.spectrogram_picture import spectrogram_picture
from sononerf.run.build import locked
from sononerf.run.export import read_volume
from sononerf.run.provenance import differing_keys, flat
from sononerf.run.run import Run
from sononerf.run.run_page import curves_of, damage_named, page_of, read_predictions
from sononerf.settings.schema import Settings

PAGE = "report.html"


def report(
    paths: Sequence[Path],
    *,
    paper: bool = False,
    figures: Literal["svg", "pdf"] | None = None,
    output: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one page of HTML with all its pictures inside, of a run or of several.

    An interrupted fit has a page too, with its results so far.

    Args:
        paths: Runs. Of several the page compares numbers, settings and pictures.
        paper: Whether the counterparts of the paper's figures 4 to 8 are drawn too: the scene with
            its poses, an iso-surface of the summed reflectivity, and, where the run was compared
            with others, what was heard in it and not in them.
        figures: Also write curves, projections and spectrograms of one run as files of this kind,
            into the folder ``figures`` beside the page.
        output: File of the page; ``RUN/report.html`` of one run, ``report.html`` of several.
        progress: Display of progress.

    Returns:
        page: The file. What a run has not come to yet is named with the command that makes it.

    Raises:
        InputError: If one is no run, or one of its files is damaged.

    References:
        .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, figures 4 to 8.
    """
    progress = progress or Progress(quiet=True)
    runs = [Run(path) for path in paths]
    settings = [run.open() for run in runs]
    target = output or (paths[0] / PAGE if len(paths) == 1 else Path(PAGE))
    if target.suffix.lower() != ".html":
        raise InputError(f"{target}: expected a file whose name ends in .html")
    with locked(runs, target):
        if len(runs) == 1:
            page = page_of(runs[0], settings[0], paper, progress)
        else:
            page = _comparing(runs, settings)
        drawn = {} if figures is None else _vector_figures(runs[0], figures)
        storage.make_folder(target.parent)
        for name, data in drawn.items():
            storage.commit_bytes(target.parent / "figures" / f"{name}.{figures}", data)
        storage.commit_text(target, page.html())
    return target


def _vector_figures(run: Run, kind: Literal["svg", "pdf"]) -> dict[str, bytes]:
    """Return the figures of a run that are drawn by lines and letters, by name."""
    found = {}
    curves, floors = curves_of(run)
    if curves:
        found["curves"] = curves_picture(curves, floors=floors, kind=kind)
    if (run.reconstruction / "volume.vti").is_file():
        projections = mip_pictures(read_volume(run.path), kind=kind)
        found |= {f"mip_{axis}": data for axis, data in projections.items()}
    predicted = read_predictions(run.path)
    if predicted is not None:
        for _, row in predicted.chosen():
            number = predicted.numbers[row]
            found[f"pose_{number:04d}"] = spectrogram_picture(
                predicted.measured[row],
                predicted.predicted[row],
                predicted.range,
                predicted.frequency,
                f"pose {number}",
                kind=kind,
            )
    return found


def names_of(runs: Sequence[Run]) -> list[str]:
    """Return the names of runs: of their folders, or of the paths where two share one."""
    names = [run.path.resolve().name for run in runs]
    return names if len(set(names)) == len(names) else [str(run.path) for run in runs]


def _comparing(runs: list[Run], settings: list[Settings]) -> Page:
    names = names_of(runs)
    page = Page(" · ".join(names))
    page.say(f"{len(runs)} runs beside one another.")
    page.heading("Numbers")
    found = []
    for run in runs:
        with damage_named(run.metrics_file):
            found.append(run.read_metrics())
            run_rows(found[-1:])
    page.table([("", *names), *run_rows(found)])
    page.heading("Settings that differ")
    keys = sorted({key for other in settings[1:] for key in differing_keys(settings[0], other)})
    values = [flat(one.plain()) for one in settings]
    rows = [(key, *(str(one.get(key, NONE)) for one in values)) for key in keys]
    if rows:
        page.table([("setting", *names), *rows])
    else:
        page.say("None.")
    kinds = {"view": "Surfaces", "mip_x": "Along x", "mip_y": "Along y", "mip_z": "Along z"}
    for file, heading in kinds.items():
        places = {
            name: run.reconstruction / f"{file}.png" for name, run in zip(names, runs, strict=True)
        }
        pictures = {name: place.read_bytes() for name, place in places.items() if place.is_file()}
        if pictures:
            page.heading(heading)
            page.pictures(pictures)
    return page
