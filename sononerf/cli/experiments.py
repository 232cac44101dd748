# SPDX-License-Identifier: MIT
"""Commands of an experiment: simulate, fit, predict, reconstruct, evaluate, compare, report."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sononerf.cli.app import (
    Config,
    Figures,
    FrameName,
    InFrame,
    Json,
    OnWhat,
    Overrides,
    Registration,
    Run,
    Split,
    SurfaceMethod,
    Unit,
    app,
    optional,
    print_json,
    say,
)
from sononerf.errors import SettingsError

if TYPE_CHECKING:
    from sononerf.settings.schema import Settings


MIN_POSES_FOR_WORKERS = 64
"""Number of poses from which worker processes are started at once. Fewer need none."""


def _begin(settings: Settings, workers: int | None) -> None:
    """In a terminal, say at once which echoes are wanted; let worker processes import meanwhile."""
    if sys.stderr.isatty():  # elsewhere an error message stays the only line
        say(f"echoes of {settings.data.store or (settings.scene and settings.scene.name)}")
    if (
        settings.data.store is None
        and settings.poses.count >= MIN_POSES_FOR_WORKERS
        and workers != 1
    ):
        from sononerf.resources import begin, preload

        preload("sononerf.simulation.ready")
        begin()


def _results(folder: Path) -> AbstractContextManager[None]:
    from sononerf.run.build import results_folder  # which imports torch, as simulating does not

    return results_folder(folder)


@app.command()
def simulate(
    config: Config,
    overrides: Overrides = None,
    output: Annotated[
        Path | None, typer.Option(help="The store; data/<scene>-<hash> by default.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; as many as cores by default.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler to use instead.")
    ] = None,
    preview: Annotated[
        Path | None, typer.Option(help="Draw the scene with its poses into this folder.")
    ] = None,
    waveforms: Annotated[
        Path | None,
        typer.Option(help="Also write what the receivers hear, as WAV files with a table."),
    ] = None,
) -> None:
    """Simulate the echoes of a scene at all poses of an experiment."""
    from sononerf.settings.loading import load_settings

    settings = load_settings(config, overrides or ())
    _begin(settings, workers)
    from sononerf.progress import Progress
    from sononerf.run.simulate import simulate as run

    if workers is not None and scheduler is not None:
        raise SettingsError("--workers and --scheduler exclude each other; give one")
    # A folder that cannot be written is reported before minutes of simulation.
    with _results(preview) if preview is not None else nullcontext():
        store = run(
            settings, output=output, workers=workers, scheduler=scheduler, progress=Progress()
        )
        say(f"wrote {store.path} ({len(store) - len(store.missing())} poses)")
        if preview is not None:
            from sononerf.run.scenes import draw_ensemble

            for path in draw_ensemble(settings, store, preview):
                say(f"wrote {path}")
    if waveforms is not None:
        from sononerf.run.simulate import write_waveforms

        for path in write_waveforms(settings, waveforms, progress=Progress()):
            say(f"wrote {path}")


@app.command()
def fit(
    config: Config,
    overrides: Overrides = None,
    output: Annotated[
        Path | None,
        typer.Option(help="The run's folder; runs/<name of config or scene> by default."),
    ] = None,
    accelerator: OnWhat = "auto",
    devices: Annotated[int | None, typer.Option(min=1, help="Number of devices.")] = None,
    num_nodes: Annotated[int, typer.Option(min=1, help="Number of machines.")] = 1,
    precision: Annotated[
        str, typer.Option(help="Lightning's: 32-true, bf16-mixed, 64-true, ...")
    ] = "32-true",
    strategy: Annotated[str, typer.Option(help="Lightning's: auto, ddp, ddp_spawn, ...")] = "auto",
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the fit (fit.seed).")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes that simulate.")] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Move an existing run aside first.")
    ] = False,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print all settings as YAML, and end.")
    ] = False,
) -> None:
    """Simulate where needed, fit, reconstruct, predict the test poses and evaluate.

    The same command resumes an interrupted one.
    """
    from sononerf.settings.loading import load_settings

    extra = [] if seed is None else [f"fit.seed={seed}"]
    settings = load_settings(config, [*(overrides or ()), *extra])
    if print_config:
        from sononerf.run.build import with_store
        from sononerf.settings.loading import to_yaml

        typer.echo(to_yaml(with_store(settings).plain()).rstrip())
        return
    _begin(settings, workers)
    from sononerf.progress import Progress
    from sononerf.run.fit import follows
    from sononerf.run.run import Run as RunOnDisk

    folder = output or Path("runs") / _name(settings, config)
    done = RunOnDisk(folder).fit(
        settings,
        accelerator=accelerator,
        devices=devices or "auto",
        num_nodes=num_nodes,
        precision=precision,
        strategy=strategy,
        overwrite=overwrite,
        workers=workers,
        finishes=True,
        progress=Progress(),
    )
    if not follows():  # the first process does the rest
        from sononerf.run.report import PAGE
        from sononerf.run.report import report as write

        page, numbers = folder / PAGE, folder / "metrics.json"
        if not page.is_file() or page.stat().st_mtime < numbers.stat().st_mtime:
            write(folder, progress=Progress())
        _summary(folder, done.read_metrics())


def _name(settings: Settings, config: Path) -> str:
    """Return the name of a run: the config's, or the scene's where there is no config."""
    from sononerf.settings.loading import is_assignment

    if not is_assignment(config):
        return config.stem
    return "recorded" if settings.scene is None else settings.scene.name


def _summary(folder: Path, metrics: dict[str, Any]) -> None:
    from sononerf import storage

    prediction = metrics.get("prediction") or {}
    if prediction:
        typer.echo(
            f"prediction of {prediction['poses']} held-out poses: {prediction['mae_db']:.2f} dB "
            f"over all cells (mean spectrogram: {prediction['mean_predictor_mae_db']:.2f} dB)"
            + optional(prediction, "mae_db_active", "; {:.1f} dB over active cells")
        )
    geometry = metrics.get("geometry") or {}
    if geometry:
        scores = geometry["fscore"]
        typer.echo(
            f"geometry: Chamfer {1000 * geometry['chamfer_m']:.2f} mm, F-score "
            f"{scores['0.002']:.2f} at 2 mm and {scores['0.005']:.2f} at 5 mm, "
            f"{geometry['components']} part{'s' * (geometry['components'] != 1)} "
            f"(true: {geometry['components_true']})"
        )
        other = (metrics.get("baseline") or {}).get("backprojection")
        if other:
            typer.echo(
                f"backprojection instead: Chamfer {1000 * other['chamfer_m']:.2f} mm, F-score "
                f"{other['fscore']['0.002']:.2f} at 2 mm and {other['fscore']['0.005']:.2f} at 5 mm"
            )
    known = folder / "reconstruction" / "read_out.json"
    found = storage.read_json(known) if known.is_file() else {}
    if found.get("median_error_m"):
        now, twice = (1e3 * found[f"median_error_{key}m"] for key in ("", "from_twice_"))
        typer.echo(
            f"error of the surface: {now:.2f} mm (90 %, median of the vertices); with twice as "
            f"many poses it would be about {twice:.2f} mm"
        )
    if (folder / "report.html").is_file():
        typer.echo(f"report:      {folder / 'report.html'}")
    for mesh in sorted((folder / "reconstruction").glob("mesh*.ply")):
        typer.echo(f"mesh:        {mesh}")
    typer.echo(f"pictures:    {folder / 'reconstruction' / 'view.png'}, {folder / 'prediction'}")
    typer.echo(f"numbers:     {folder / 'metrics.json'}")
    typer.echo(f"TensorBoard: tensorboard --logdir {folder}")


@app.command()
def predict(
    run: Run,
    split: Annotated[
        Split | None, typer.Option(help="Split of the ensemble; test by default.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="CSV of your own poses: x,y,z,yaw,pitch,roll (m, degrees), or as of the import."
        ),
    ] = None,
    frame: InFrame = "auto",
    output: Annotated[Path | None, typer.Option(help="Folder of the results.")] = None,
    pictures: Annotated[
        str, typer.Option(help="Number of poses that are drawn, from best to worst; or all.")
    ] = "3",
    accelerator: OnWhat = "auto",
) -> None:
    """Predict the spectrograms of poses that were never heard."""
    if split is not None and poses is not None:
        raise SettingsError("--split and --poses exclude each other; give one")
    if pictures != "all" and not pictures.isdecimal():
        raise SettingsError(f"--pictures: found {pictures!r}; give all or a whole number from 0 on")
    from sononerf.progress import Progress
    from sononerf.run.run import Run as RunOnDisk

    folder = RunOnDisk(run).write_prediction(
        split=split or "test",
        poses_csv=poses,
        frame=frame,
        output=output,
        pictures="all" if pictures == "all" else int(pictures),
        accelerator=accelerator,
        progress=Progress(),
    )
    say(f"wrote {folder}")


@app.command()
def reconstruct(
    run: Run,
    spacing: Annotated[float | None, typer.Option(help="Voxel size in metres.")] = None,
    method: Annotated[
        SurfaceMethod | None,
        typer.Option(
            help="levels: by a network from the echoes alone, refined. isosurface: where the field "
            "has one value."
        ),
    ] = None,
    refine: Annotated[bool | None, typer.Option(help="Refine; by default levels alone.")] = None,
    level: Annotated[
        str | None,
        typer.Option(
            help="Level of an iso-surface: auto, or a number, which implies an iso-surface."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Folder of the results.")] = None,
    accelerator: OnWhat = "auto",
) -> None:
    """Make mesh, volume and projections of a run, and refine the mesh."""
    import math
    from typing import Literal

    number: float | Literal["auto"] | None = "auto" if level == "auto" else None
    if level is not None and level != "auto":
        try:
            number = float(level)
        except ValueError:
            raise SettingsError(f"--level: found {level!r}; give auto or a number") from None
        if not (math.isfinite(number) and number >= 0):
            raise SettingsError(f"--level: found {level!r}; give auto or a number from 0 on")
    if spacing is not None and not (math.isfinite(spacing) and spacing > 0):
        raise SettingsError(f"--spacing: found {spacing}; give metres above zero")
    from sononerf.progress import Progress
    from sononerf.run.run import Run as RunOnDisk

    folder = RunOnDisk(run).reconstruct(
        spacing=spacing,
        level=number,
        method=method,
        refine=refine,
        output=output,
        accelerator=accelerator,
        progress=Progress(),
    )
    say(f"wrote {folder}")


@app.command()
def evaluate(
    run: Run,
    truth: Annotated[
        Path | None, typer.Option(help="Mesh of the true surface; the scene's own by default.")
    ] = None,
    registration: Annotated[
        Registration | None,
        typer.Option(
            help="Lays the mesh over the truth: none, rigid, or with one scale (similarity)."
        ),
    ] = None,
    unit: Annotated[
        Unit | None, typer.Option(help="Of the numbers in the truth's file; m by default.")
    ] = None,
    frame: Annotated[
        FrameName | None,
        typer.Option(help="Of the truth's file: auto, world or original; auto by default."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare a run's mesh with the true surface, and show all its numbers."""
    from sononerf.progress import Progress
    from sononerf.run.run import Run as RunOnDisk

    metrics = RunOnDisk(run).evaluate(
        truth=truth,
        registration=registration,
        unit=unit,
        frame=frame,
        progress=Progress(quiet=as_json),
    )
    if as_json:
        print_json(metrics)
    else:
        _summary(run, metrics)


@app.command()
def compare(
    run_a: Annotated[Path, typer.Argument(help="Folder of a run.")],
    run_b: Annotated[Path, typer.Argument(help="Folder of the run without it.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder of the results; RUN_A/compare-B where none.")
    ] = None,
    accelerator: OnWhat = "auto",
) -> None:
    """Show what is heard in RUN_A and not in RUN_B, and where: a prey on a leaf."""
    from sononerf import storage
    from sononerf.progress import Progress
    from sononerf.run.evaluate import compare_runs

    folder = compare_runs(run_a, run_b, output=output, accelerator=accelerator, progress=Progress())
    comparison = storage.read_json(folder / "comparison.json")
    if comparison["strongest_m"] is None:
        say(f"nothing is stronger in {run_a} than in {run_b}")
    else:
        place = ", ".join(f"{1e3 * x:.1f}" for x in comparison["strongest_m"])
        comparison["distance_mm"] = (
            None if comparison["distance_m"] is None else 1e3 * comparison["distance_m"]
        )
        away = optional(comparison, "distance_mm", "; {:.1f} mm from the middle of what was added")
        say(f"strongest difference at ({place}) mm, {comparison['score']:.2f} of the maximum{away}")
    say(f"wrote {folder}")


@app.command()
def report(
    run: Run,
    paper: Annotated[
        bool, typer.Option("--paper", help="Also draw the counterparts of the paper's figures.")
    ] = False,
    figures: Annotated[
        Figures | None,
        typer.Option("--format", help="Also write figures of this kind, for a paper."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="The page; RUN/report.html by default.")
    ] = None,
) -> None:
    """Write one page of a run: numbers, pictures, settings."""
    from sononerf.progress import Progress
    from sononerf.run.report import report as write

    page = write(run, paper=paper, figures=figures, output=output, progress=Progress())
    say(f"wrote {page}")
    if figures is not None:
        say(f"wrote {page.parent / 'figures'}")


@app.command()
def table(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs.")],
    csv: Annotated[
        Path | None, typer.Option(help="Also write all numbers, in SI units, one line per run.")
    ] = None,
) -> None:
    """Print the numbers of runs beside one another."""
    from sononerf.run.evaluate import table as table_of_runs

    for line in table_of_runs(runs, csv=csv):
        typer.echo(line)
    if csv is not None:
        say(f"wrote {csv}")
