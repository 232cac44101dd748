# SPDX-License-Identifier: MIT
"""Commands around an experiment: scenes, next poses, import, export and self-calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from sononerf.cli.app import Exported, InFrame, Json, Overrides, Run, Within, app, print_json, say
from sononerf.errors import SettingsError


@app.command("next")
def next_(
    run: Run,
    count: Annotated[int, typer.Option(help="Number of poses.", min=1)],
    candidates: Annotated[
        Path | None,
        typer.Option(help="CSV of poses to choose among: x,y,z,yaw,pitch,roll (m, degrees)."),
    ] = None,
    within: Annotated[
        Within | None,
        typer.Option(
            help="Places to choose among, without --candidates. sphere (default): all around, at "
            "the median distance of the poses. cap: no farther from their middle than they are. "
            "volume: between their least and greatest distance."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help="CSV of the poses in the world's frame, the best first; RUN/next.csv by default."
        ),
    ] = None,
) -> None:
    """Propose the poses that would reduce the error of a run's surface most."""
    if within is not None and candidates is not None:
        raise SettingsError("--within and --candidates exclude each other; give one")
    from sononerf.run.predict import propose

    say(f"wrote {propose(run, count, candidates, within or 'sphere', output)}")


@app.command()
def scenes(
    name: Annotated[
        str | None, typer.Argument(help="Name of a scene, to list its options.")
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
            print_json(scene)
            return
        for line in option_table(scene):
            typer.echo(line)
        return
    if preview is not None:
        written, skipped = draw_scenes(preview)
        for path in written:
            say(f"wrote {path}")
        for line in skipped:
            say(f"not drawn: {line}")
    rows = describe_scenes()
    if as_json:
        print_json({"scenes": rows})
        return
    for line in scene_table(rows):
        typer.echo(line)


PluginKind = Literal["scene", "field", "renderer"]
NewFolder = Annotated[
    Path | None, typer.Option(help="A new folder; NAME in the working directory by default.")
]


@app.command()
def new_plugin(
    kind: Annotated[PluginKind, typer.Argument(help="scene, field or renderer.")],
    name: Annotated[str, typer.Argument(help="Of the plugin, such as my_bar.")],
    output: NewFolder = None,
) -> None:
    """Write a scene, field or renderer of one's own to start from: two files, and their test."""
    import shlex

    from sononerf.run.scenes import new_plugin as write

    written = write(kind, name, output)
    for path in written:
        say(f"wrote {path}")
    folder, module = shlex.quote(str(written[0].parent)), written[1].stem
    use = {"scene": f"scene.name={module}", "field": f"three_spheres field.kind={module}"}
    say("next:")
    say(f"  python -m pip install -e {folder if '/' in folder else './' + folder}")
    say(f"  python -m pytest {folder}")
    say(f"  sononerf fit {use.get(kind, f'three_spheres renderer.kind={module}')}")


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
    from sononerf.run.build import results_folder
    from sononerf.run.import_recordings import (
        check_before,
        describe_plan,
        draw_plan,
        plan_import,
        write_import,
    )

    plan = plan_import(
        form, source, output, settings_file=settings, overrides=overrides or (), progress=Progress()
    )
    for line in describe_plan(plan):
        say(line)
    if dry_run and preview is None:
        preview = output.with_name(f"{output.name}-preview")
    if preview is not None:
        with results_folder(preview):
            say(f"wrote {draw_plan(plan, preview)}")
    if dry_run:
        verdict = check_before(plan, progress=Progress())
    else:
        store, verdict = write_import(plan, output, progress=Progress())
        say(f"wrote {store.path} ({len(store)} poses)")
    if verdict.message:
        say(f"warning: {verdict.message}")
    elif dry_run:
        say("check:      no other convention of poses explains the first echoes better")


@app.command()
def export(
    source: Annotated[Path, typer.Argument(help="A store, or the folder of a run.")],
    output: Annotated[Path, typer.Argument(help="File: .mat, .h5, .ply, .stl or .glb.")],
    what: Annotated[
        Exported,
        typer.Option(
            help="auto: echoes of a store; of a run the mesh or the prediction, as FILE says."
        ),
    ] = "auto",
    frame: InFrame = "auto",
) -> None:
    """Write echoes, predictions, volumes or meshes for other programs."""
    from sononerf.run.export import export as export_part

    say(f"wrote {export_part(source, output, what=what, frame=frame)}")


@app.command()
def calibrate(
    source: Annotated[Path, typer.Argument(help="Folder of a run with a surface.")],
    kinds: Annotated[
        list[str],
        typer.Argument(metavar="ERROR...", help="gain, range_offset, speed_of_sound, support."),
    ],
    output: Annotated[Path | None, typer.Option(help="The corrected store.")] = None,
) -> None:
    """Find errors of a recording, and write a corrected store."""
    from sononerf.progress import Progress
    from sononerf.run.calibrate import calibrate as find_errors

    if output is None:
        raise SettingsError("--output is missing; name the store, such as --output data/corrected")
    errors = find_errors(source, output, kinds, progress=Progress())
    for line in errors.lines:
        say(line)
    for line in errors.warnings:
        say(f"warning: {line}")
    say(f"wrote {errors.store.path} ({len(errors.store)} poses)")


@app.command()
def doctor(as_json: Json = False) -> None:
    """Check this machine: versions, memory, GPU, disk; and say how each problem is solved."""
    from sononerf.run.doctor import as_lines, as_plain, examine

    findings = examine()
    if as_json:
        print_json(as_plain(findings))
        return
    for line in as_lines(findings):
        typer.echo(line)


@app.command()
def view(
    source: Annotated[Path, typer.Argument(help="Folder of a run, or a store.")],
    port: Annotated[
        int, typer.Option(min=1, max=65535, help="Where the page is; the next free one if taken.")
    ] = 8080,
) -> None:
    """Show a run or a store in the browser: mesh, volume, poses, echoes, a head to drag."""
    import signal
    from contextlib import closing, suppress

    from sononerf.run.export import View

    shown = View(source, port=port)
    say(f"open {shown.viewer.url}; Ctrl-C ends it")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # here it is no interruption
    with closing(shown.viewer), suppress(KeyboardInterrupt):
        shown.follow()
