# SPDX-License-Identifier: MIT
"""The command line: parse, call one function of the experiment, print what was written.

torch, lightning and pyvista are imported inside the commands, so that ``--help`` is quick.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from sononerf import __version__
from sononerf.errors import SettingsError, SonoNerfError, StoppedError

app = typer.Typer(
    name="sononerf",
    help="Three-dimensional hearing: simulate echoes, fit a reflectivity field, predict, "
    "reconstruct.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


class Accelerator(StrEnum):
    """What to compute on."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"


class SurfaceMethod(StrEnum):
    """How a surface is read out."""

    auto = "auto"
    open = "open"
    filled = "filled"
    hull = "hull"
    sheet = "sheet"
    isosurface = "isosurface"


class Registration(StrEnum):
    """How a mesh is laid over the true surface."""

    none = "none"
    rigid = "rigid"
    similarity = "similarity"


class Exported(StrEnum):
    """Part of a store or a run."""

    auto = "auto"
    echoes = "echoes"
    prediction = "prediction"
    volume = "volume"
    points = "points"


class Split(StrEnum):
    """Poses of an ensemble."""

    test = "test"
    val = "val"
    train = "train"


Config = Annotated[Path, typer.Argument(help="Settings file, such as configs/three_spheres.yaml.")]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="[KEY=VALUE]...", help="Settings by dotted key, such as fit.epochs=5."),
]
Run = Annotated[Path, typer.Argument(help="Folder of a run.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
OnWhat = Annotated[Accelerator, typer.Option(help="What to compute on.")]


def _print(text: str) -> None:
    typer.echo(text, err=True)


def _print_json(data: Any) -> None:
    typer.echo(json.dumps(data, indent=2, allow_nan=False))


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sononerf {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    del version
    if context.invoked_subcommand is None:
        _print(context.get_help())
        raise typer.Exit(SettingsError.exit_code)
    logging.basicConfig(format="warning: %(message)s", level=logging.WARNING)


@app.command()
def scenes(
    name: Annotated[
        str | None, typer.Argument(help="One of them, to be told of its options.")
    ] = None,
    as_json: Json = False,
    preview: Annotated[Path | None, typer.Option(help="Draw every scene into this folder.")] = None,
) -> None:
    """List the scenes that are installed, built-in and everyone's, or the options of one."""
    from sononerf.run.scenes import (
        describe_scene,
        describe_scenes,
        draw_scenes,
        option_table,
        scene_table,
    )

    if name is not None:
        if preview is not None:
            raise SettingsError("--preview draws all scenes; leave NAME out, or simulate --preview")
        scene = describe_scene(name)
        if as_json:
            _print_json(scene)
            return
        for line in option_table(scene):
            typer.echo(line)
        return
    if preview is not None:
        written, skipped = draw_scenes(preview)
        for path in written:
            _print(f"wrote {path}")
        for line in skipped:
            _print(f"not drawn: {line}")
    rows = describe_scenes()
    if as_json:
        _print_json({"scenes": rows})
        return
    for line in scene_table(rows):
        typer.echo(line)


@app.command()
def new_scene(
    name: Annotated[str, typer.Argument(help="Of the scene, such as my_bar.")],
    output: Annotated[
        Path | None, typer.Option(help="A new folder; NAME in the working directory by default.")
    ] = None,
) -> None:
    """Write a scene of one's own to start from: a plugin of two files, and its test."""
    import shlex

    from sononerf.run.new_scene import new_scene as write

    written = write(name, output)
    for path in written:
        _print(f"wrote {path}")
    folder, scene = shlex.quote(str(written[0].parent)), written[1].stem
    _print("next:")
    _print(f"  python -m pip install -e {folder if '/' in folder else './' + folder}")
    _print(f"  python -m pytest {folder}")
    _print("  sononerf scenes")
    _print(f"  echo 'scene: {{name: {scene}}}' > {scene}.yaml")
    _print(f"  sononerf fit {scene}.yaml")


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
    from sononerf.settings.schema import load_settings

    settings = load_settings(config, overrides or ())
    from sononerf.progress import Progress
    from sononerf.run.run_folder import results_folder
    from sononerf.run.scenes import draw_ensemble
    from sononerf.run.simulate import simulate as run

    if workers is not None and scheduler is not None:
        raise SettingsError("--workers and --scheduler exclude each other; give one")
    # A folder that cannot be written is told before minutes of simulation.
    with results_folder(preview) if preview is not None else nullcontext():
        store = run(
            settings, output=output, workers=workers, scheduler=scheduler, progress=Progress()
        )
        _print(f"wrote {store.path} ({len(store)} poses)")
        if preview is not None:
            for path in draw_ensemble(settings, store, preview):
                _print(f"wrote {path}")
    if waveforms is not None:
        from sononerf.run.waveforms import write_waveforms

        for path in write_waveforms(settings, waveforms, progress=Progress()):
            _print(f"wrote {path}")


@app.command(name="import")
def import_(
    form: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT", help="recordings, numpy, sonotracelab, sononerf-matlab or airsas."
        ),
    ],
    source: Annotated[Path, typer.Argument(help="Folder or file of the recordings.")],
    overrides: Overrides = None,
    output: Annotated[Path | None, typer.Option(help="The store.")] = None,
    settings: Annotated[
        Path | None,
        typer.Option(help="Settings of the import; import.yaml beside the recordings by default."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say and draw what was understood.")
    ] = False,
    preview: Annotated[
        Path | None, typer.Option(help="Draw poses and the first pings into this folder.")
    ] = None,
) -> None:
    """Make a store of recordings, for `fit CONFIG data.store=STORE`."""
    if output is None:
        raise SettingsError("--output is missing; name the store, such as --output data/recorded")
    from sononerf.progress import Progress
    from sononerf.recordings.understand import understand
    from sononerf.run.import_recordings import (
        check_before,
        describe,
        draw,
        import_understood,
    )
    from sononerf.run.run_folder import results_folder

    known = understand(form, source, output, settings_file=settings, overrides=overrides or ())
    for line in describe(known):
        _print(line)
    if dry_run and preview is None:
        preview = output.with_name(f"{output.name}-preview")
    if preview is not None:
        with results_folder(preview):
            _print(f"wrote {draw(known, preview)}")
    if dry_run:
        verdict = check_before(known, progress=Progress())
    else:
        store, verdict = import_understood(known, output, progress=Progress())
        _print(f"wrote {store.path} ({len(store)} poses)")
    if verdict.message:
        _print(f"warning: {verdict.message}")
    elif dry_run:
        _print("check:      no other convention of poses explains the first echoes better")


@app.command()
def fit(
    config: Config,
    overrides: Overrides = None,
    output: Annotated[
        Path | None, typer.Option(help="The run's folder; runs/<config's name> by default.")
    ] = None,
    accelerator: OnWhat = Accelerator.auto,
    devices: Annotated[int | None, typer.Option(min=1, help="How many devices.")] = None,
    num_nodes: Annotated[int, typer.Option(min=1, help="How many machines.")] = 1,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the fit (fit.seed).")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes that simulate.")] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Move a run that is there aside.")
    ] = False,
) -> None:
    """Simulate where needed, fit, reconstruct, predict the test poses and evaluate.

    The same command goes on where an interrupted one stopped.
    """
    from sononerf.settings.schema import load_settings

    extra = [] if seed is None else [f"fit.seed={seed}"]
    settings = load_settings(config, [*(overrides or ()), *extra])
    from sononerf.progress import Progress
    from sononerf.run.finish import finish, is_finished
    from sononerf.run.fit import fit as run
    from sononerf.run.fit import follows

    folder = output or Path("runs") / config.stem
    progress = Progress()
    done = run(
        settings,
        folder,
        accelerator=accelerator.value,
        devices=devices or "auto",
        num_nodes=num_nodes,
        overwrite=overwrite,
        workers=workers,
        progress=progress,
    )
    if follows():
        return  # the first process does the rest
    if is_finished(folder):
        _print(f"{folder}: is finished; --overwrite fits it anew")
        metrics = done.read_metrics()
    else:
        metrics = finish(folder, accelerator=accelerator.value, progress=progress)
    _summary(folder, metrics)


def _summary(folder: Path, metrics: dict[str, Any]) -> None:
    prediction = metrics.get("prediction") or {}
    if prediction:
        _print(
            f"prediction of {prediction['poses']} held-out poses: {prediction['mae_db']:.2f} dB "
            f"over all cells (mean spectrogram: {prediction['mean_predictor_mae_db']:.2f} dB)"
            + _optional(prediction, "mae_db_active", "; {:.1f} dB over active cells")
        )
    geometry = metrics.get("geometry") or {}
    if geometry:
        scores = geometry["fscore"]
        _print(
            f"geometry: Chamfer {1000 * geometry['chamfer_m']:.2f} mm, F-score "
            f"{scores['0.002']:.2f} at 2 mm and {scores['0.005']:.2f} at 5 mm, "
            f"{geometry['components']} part{'s' * (geometry['components'] != 1)} "
            f"(true: {geometry['components_true']})"
        )
        target = geometry.get("target")
        if target:
            near = target["fscore"]
            _print(
                f"the target alone: F-score {near['0.002']:.2f} at 2 mm and "
                f"{near['0.005']:.2f} at 5 mm"
            )
        other = (metrics.get("baseline") or {}).get("backprojection")
        if other:
            _print(
                f"backprojection instead: Chamfer {1000 * other['chamfer_m']:.2f} mm, F-score "
                f"{other['fscore']['0.002']:.2f} at 2 mm and {other['fscore']['0.005']:.2f} at 5 mm"
            )
    _print(f"mesh:        {folder / 'reconstruction' / 'mesh.ply'}")
    _print(f"pictures:    {folder / 'reconstruction' / 'view.png'}, {folder / 'prediction'}")
    _print(f"numbers:     {folder / 'metrics.json'}")
    _print(f"TensorBoard: tensorboard --logdir {folder}")


def _optional(values: dict[str, Any], key: str, template: str) -> str:
    value = values.get(key)
    return "" if value is None else template.format(value)


@app.command()
def predict(
    run: Run,
    split: Annotated[
        Split | None, typer.Option(help="Which poses of the ensemble; test by default.")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="CSV of your own poses: x,y,z,yaw,pitch,roll (m, degrees).")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Folder of the results.")] = None,
    accelerator: OnWhat = Accelerator.auto,
) -> None:
    """Predict the spectrograms of poses that were never heard."""
    if split is not None and poses is not None:
        raise SettingsError("--split and --poses exclude each other; give one")
    from sononerf.progress import Progress
    from sononerf.run.predict import predict as predict_run

    folder = predict_run(
        run,
        split="test" if split is None else split.value,
        poses_csv=poses,
        output=output,
        accelerator=accelerator.value,
        progress=Progress(),
    )
    _print(f"wrote {folder}")


@app.command()
def reconstruct(
    run: Run,
    spacing: Annotated[float | None, typer.Option(help="Voxel size in metres.")] = None,
    method: Annotated[
        SurfaceMethod | None,
        typer.Option(
            help="How the surface is read out. open, filled, hull, sheet: from field and first "
            "echoes; open opens hollows and gaps, filled leaves them closed, hull takes the first "
            "echoes alone, sheet is for a thin sheet. isosurface: where the field has one value. "
            "auto: the best of the first four, refined. A method other than auto is not refined."
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option(
            help="Level of an iso-surface: auto, or a number. With a number the surface is an "
            "iso-surface and is not refined."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Folder of the results.")] = None,
    accelerator: OnWhat = Accelerator.auto,
) -> None:
    """Read mesh, volume and projections out of a fitted field, and refine the mesh."""
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
    from sononerf.run.reconstruct import reconstruct as reconstruct_run

    folder = reconstruct_run(
        run,
        spacing=spacing,
        level=number,
        method=None if method is None else method.value,
        output=output,
        accelerator=accelerator.value,
        progress=Progress(),
    )
    _print(f"wrote {folder}")


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
    as_json: Json = False,
) -> None:
    """Compare a run's mesh with the true surface, and show all its numbers."""
    from sononerf.progress import Progress
    from sononerf.run.evaluate import evaluate as evaluate_run

    metrics = evaluate_run(
        run,
        truth=truth,
        registration=None if registration is None else registration.value,
        progress=Progress(quiet=as_json),
    )
    if as_json:
        _print_json(metrics)
    else:
        _summary(run, metrics)


@app.command()
def export(
    source: Annotated[Path, typer.Argument(help="A store, or the folder of a run.")],
    output: Annotated[Path, typer.Argument(help="File to write: .mat, .h5, .nc or .csv.")],
    what: Annotated[
        Exported,
        typer.Option(
            help="auto: echoes of a store; of a run, points for .csv and else the prediction."
        ),
    ] = Exported.auto,
) -> None:
    """Write echoes, predictions, volumes or surface points for other programs."""
    from sononerf.run.export import export as export_part

    _print(f"wrote {export_part(source, output, what=what.value)}")


@app.command()
def calibrate(
    run: Annotated[Path, typer.Argument(help="Folder of a run with a surface.")],
    kinds: Annotated[
        list[str],
        typer.Argument(
            metavar="ERROR...", help="gain, range_offset, speed_of_sound, position, aim."
        ),
    ],
    output: Annotated[Path | None, typer.Option(help="The corrected store.")] = None,
) -> None:
    """Find errors of a recording by a run's surface, and write a corrected store."""
    from sononerf.progress import Progress
    from sononerf.run.calibrate import calibrate as find_errors

    if output is None:
        raise SettingsError("--output is missing; name the store, such as --output data/corrected")
    found = find_errors(run, output, kinds, progress=Progress())
    for line in found.lines:
        _print(line)
    for line in found.warnings:
        _print(f"warning: {line}")
    _print(f"wrote {found.store.path} ({len(found.store)} poses)")


@app.command()
def compare(
    run_a: Annotated[Path, typer.Argument(help="Folder of a run.")],
    run_b: Annotated[Path, typer.Argument(help="Folder of the run without it.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder of the results; RUN_A/compare-B where none.")
    ] = None,
    accelerator: OnWhat = Accelerator.auto,
) -> None:
    """Show what is heard in RUN_A and not in RUN_B, and where: a prey on a leaf."""
    from sononerf import storage
    from sononerf.progress import Progress
    from sononerf.run.compare import compare_runs

    folder = compare_runs(
        run_a, run_b, output=output, accelerator=accelerator.value, progress=Progress()
    )
    found = storage.read_json(folder / "comparison.json")
    if found["strongest_m"] is None:
        _print(f"nothing is stronger in {run_a} than in {run_b}")
    else:
        place = ", ".join(f"{1e3 * x:.1f}" for x in found["strongest_m"])
        found["distance_mm"] = None if found["distance_m"] is None else 1e3 * found["distance_m"]
        away = _optional(found, "distance_mm", "; {:.1f} mm from the middle of what was added")
        _print(f"strongest difference at ({place}) mm, {found['score']:.2f} of the maximum{away}")
    _print(f"wrote {folder}")


@app.command()
def report(
    run: Run,
    paper: Annotated[
        bool, typer.Option("--paper", help="Also draw the counterparts of the paper's figures.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option(help="Folder of the page; RUN/report where none.")
    ] = None,
) -> None:
    """Write one page of a run: numbers beside the baselines', pictures, settings."""
    from sononerf.progress import Progress
    from sononerf.run.report_run import report as report_run

    _print(f"wrote {report_run(run, paper=paper, output=output, progress=Progress())}")


class _SignalledError(BaseException):
    """A signal came; nothing on the way may take it for a fault and go on."""

    def __init__(self, number: int) -> None:
        self.number = number


@contextmanager
def _signals_unwind() -> Iterator[None]:
    """Let signals close files and end child processes on the way out."""

    def unwind(number: int, frame: FrameType | None) -> None:
        del frame
        raise _SignalledError(number)

    before = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # What was ignored when we were started (nohup, a shell's &) stays ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, unwind)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run() -> int:
    try:
        with _signals_unwind():
            return app(prog_name="sononerf", standalone_mode=False) or 0
    except SonoNerfError as error:
        fault = error
    except typer.TyperException as error:
        where = getattr(getattr(error, "ctx", None), "command_path", "sononerf")
        text = error.format_message().rstrip(".")
        fault = SettingsError(f"{text[:1].lower()}{text[1:]}; see `{where} --help`")
    except _SignalledError as error:
        fault = StoppedError(error.number)
    if isinstance(fault, StoppedError):
        _print(str(fault))  # the user's wish, not a fault
        return fault.exit_code
    for line in str(fault).splitlines():
        typer.echo(f"error: {line}", err=True)
    return fault.exit_code


def main() -> None:
    """Run the command line and end with the exit code of what went wrong."""
    try:
        sys.exit(_run())
    except BrokenPipeError:
        # The reader of our output went away, as `head` does.
        sys.stderr.close()
        sys.exit(141)


if __name__ == "__main__":
    main()
