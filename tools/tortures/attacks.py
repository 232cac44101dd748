# SPDX-License-Identifier: MIT
"""Files and folders of strangers: none runs code, connects, or writes outside its folder.

Packages that add scenes, fields and renderers may run code: whoever installs one trusts it. Data
may not, whoever made them.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import shutil
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import trimesh

from tools.tortures.harness import FIT, SIMULATE, Report, contents, give, prepared

CANARY = "canary"
SHELL = f"touch {CANARY}"
TAGS = (
    f"!!python/object/apply:os.system ['{SHELL}']",
    f"!!python/object/new:os.system ['{SHELL}']",
    f"!!python/object/apply:subprocess.check_output [['touch', '{CANARY}']]",
    f"!!python/object/apply:builtins.eval [\"open('{CANARY}', 'w')\"]",
    "!!python/name:os.system",
    "!!python/module:os",
    "!!python/object:os.stat_result {}",
    "!!python/tuple [1, 2]",
    "!include ../secret",
    "!!binary |\n  R0lGODlhDAAMAIQAAP",
)
URLS = (
    *("http://127.0.0.1:9/x.ply", "https://example.org/x.ply", "ftp://127.0.0.1/x.ply"),
    *("s3://bucket/x.ply", "file:///etc/passwd", "gs://bucket/x.ply", "zip://x.zip::x.ply"),
    *("//example.org/x.ply", "github://a:b@/x.ply", "memory://x.ply"),
)
NAMES = ("os:system", "../x", "os.system", "sononerf.cli", "a b", "$(touch canary)", "__import__")
LINKS = (
    *(".lock", "metrics.json", "model.json", "model.safetensors", "provenance.json", "config.yaml"),
    *("report.html", "traced.safetensors", "checkpoints", "tensorboard"),
    *("epochs", "reconstruction", "prediction", "reconstruction/mesh.ply"),
    *("prediction/spectrograms.npz", "checkpoints/last.ckpt", "epochs/0001"),
)
SCRIPTS = (
    "<script>open()</script>",
    '"><img src=x onerror=alert(1)>',
    "</style><script>x</script>",
)
SEEN = (
    *("subprocess.Popen", "socket.connect", "socket.getaddrinfo", "socket.bind", "os.system"),
    *("os.exec", "os.fork", "os.posix_spawn", "pty.spawn", "webbrowser.open"),
)
UNIX = 1
"""Family of sockets that do not leave the machine."""
Attack = tuple[str, Callable[[Path], tuple[Any, ...]]]


class _Bomb:
    """Pickled, it makes whoever unpickles it call something."""

    def __init__(self, call: Callable[..., Any], given: tuple[Any, ...]) -> None:
        self.call, self.given = call, given

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call, self.given


BOMBS = {
    "os.system": _Bomb(os.system, (SHELL,)),
    "eval": _Bomb(eval, (f"open({CANARY!r}, 'w')",)),
    "exec": _Bomb(exec, (f"open({CANARY!r}, 'w')",)),
    "open": _Bomb(open, (CANARY, "w")),
    "mkdir": _Bomb(os.mkdir, (CANARY,)),
    "import": _Bomb(__import__, ("antigravity",)),
}


def _watched(folder: Path) -> Callable[[], None]:
    """Return what makes a process note what only an attack does."""
    inside = (str(folder.resolve()), "/dev/", "/proc/")

    def install() -> None:
        def hook(event: str, given: tuple[Any, ...]) -> None:
            bad = event in SEEN
            if event.startswith("socket.") and given and getattr(given[0], "family", 0) == UNIX:
                bad = False  # of this process and its own workers
            if event == "open" and isinstance(given[0], (str, bytes)):
                mode, flags = given[1], given[2] or 0
                writes = set(mode or "") & set("wax+") or flags & (os.O_WRONLY | os.O_RDWR)
                path = str(Path(os.fsdecode(given[0])).absolute())
                bad = bool(writes) and not path.startswith(inside) and "sononerf-" not in path
            if bad:
                descriptor = os.dup(2)
                os.write(descriptor, f"\nATTACK {event} {str(given)[:200]}\n".encode())
                os.close(descriptor)

        os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"  # nothing heeds it
        sys.addaudithook(hook)

    return install


def _checkpoints() -> Iterator[Attack]:
    for name, bomb in BOMBS.items():
        for zipped in (True, False):

            def build(folder: Path, bomb: Any = bomb, new: bool = zipped) -> Any:
                shutil.copytree(folder / "run", folder / "victim")
                (folder / "victim" / "model.json").unlink()
                file = folder / "victim" / "checkpoints" / "last.ckpt"
                content = {"state_dict": {}, "global_step": 1, "hyper_parameters": bomb}
                torch.save(content, file, _use_new_zipfile_serialization=new)
                return (*FIT[:-4], "--output", "victim", "--accelerator", "cpu")

            yield f"checkpoint, {name}, {'zip' if zipped else 'old form'}", build


def _pickles() -> Iterator[Attack]:
    for name, bomb in BOMBS.items():

        def archive(folder: Path, bomb: Any = bomb) -> Any:
            array = np.array([bomb], dtype=object)
            np.savez(folder / "x.npz", waveform=array, position_m=array)
            return "import", "numpy", "x.npz", "--output", "imported"

        def safetensors(folder: Path, bomb: Any = bomb) -> Any:
            (folder / "run" / "model.safetensors").write_bytes(pickle.dumps(bomb))
            return "predict", "run", "--accelerator", "cpu"

        def prediction(folder: Path, bomb: Any = bomb) -> Any:
            array = np.array([bomb], dtype=object)
            np.savez(folder / "run" / "prediction" / "spectrograms.npz", predicted=array)
            return "export", "run", "x.mat", "--what", "prediction"

        yield f"array of objects, {name}", archive
        yield f"pickled weights, {name}", safetensors
        yield f"prediction of objects, {name}", prediction


def _tags() -> Iterator[Attack]:
    for tag in TAGS:

        def settings(folder: Path, tag: str = tag) -> Any:
            (folder / "x.yaml").write_text(f"scene: {{name: sphere}}\nfit: {tag}\n")
            return "simulate", "x.yaml", "--output", "x"

        def run(folder: Path, tag: str = tag) -> Any:
            (folder / "run" / "config.yaml").write_text(f"scene: {{name: sphere}}\nair: {tag}\n")
            return (*FIT[:-4], "--output", "run", "--accelerator", "cpu")

        yield f"settings with {tag.partition(' ')[0]}", settings
        yield f"run with {tag.partition(' ')[0]}", run


def _urls() -> Iterator[Attack]:
    for url in URLS:
        yield (
            f"scene at {url}",
            lambda _, url=url: (
                *("simulate", "scene.name=mesh", f"scene.options.path={url}"),
                *("scene.options.unit=m", "--output", "x"),
            ),
        )
        yield f"truth at {url}", lambda _, url=url: ("evaluate", "run", "--truth", url)
        yield (f"store at {url}", lambda _, url=url: ("fit", f"data.store={url}", "--output", "x"))


def _names() -> Iterator[Attack]:
    for name in NAMES:
        yield (
            f"scene called {name}",
            lambda _, name=name: ("simulate", f"scene.name={name}", "--output", "x"),
        )
        yield (
            f"field called {name}",
            lambda _, name=name: (*FIT[:-4], f"field.kind={name}", "--output", "x"),
        )


def _links() -> Iterator[Attack]:
    for name in LINKS:

        def build(folder: Path, name: str = name) -> Any:
            path, outside = folder / "run" / name, folder.parent / "outside" / "precious"
            if path.is_dir():
                shutil.rmtree(path)
                outside = outside.parent
            path.unlink(missing_ok=True)
            path.symlink_to(outside)
            return "reconstruct", "run", "--accelerator", "cpu"

        yield f"link for {name}", build


def _scripts() -> Iterator[Attack]:
    for text in SCRIPTS:

        def build(folder: Path, text: str = text) -> Any:
            run = folder / "run"
            facts = json.loads((run / "provenance.json").read_text())
            (run / "provenance.json").write_text(json.dumps({**facts, "licence": text, text: text}))
            metrics = json.loads((run / "metrics.json").read_text())
            metrics["cost"][text] = text
            (run / "metrics.json").write_text(json.dumps(metrics))
            return "report", "run"

        yield f"page with {text}", build


def _hdf5() -> Iterator[Attack]:
    def external(folder: Path) -> Any:
        with h5py.File(folder / "x.h5", "w") as file:
            file["ch1"] = h5py.ExternalLink(str(folder.parent / "outside" / "secret.h5"), "/")
        return "import", "airsas", "x.h5", "import.sampling_rate=1e5", "--output", "x"

    def raw(folder: Path) -> Any:
        secret = str(folder.parent / "outside" / "precious")
        with h5py.File(folder / "x.h5", "w") as file:
            given: Any = [(secret, 0, 8 * 80)]
            file.create_dataset("ch1/ts", (1, 80), "f8", external=given)
            file["na/position"] = np.zeros(1)
        return "import", "airsas", "x.h5", "import.sampling_rate=1e5", "--output", "x"

    def virtual(folder: Path) -> Any:
        layout = h5py.VirtualLayout((5, 80), "f8")
        layout[:] = h5py.VirtualSource(str(folder.parent / "outside/secret.h5"), "x", (5, 80))
        with h5py.File(folder / "x.h5", "w") as file:
            file.create_virtual_dataset("ch1/ts", layout)
            file["na/position"] = np.zeros(5)
        return "import", "airsas", "x.h5", "import.sampling_rate=1e5", "--output", "x"

    def loop(folder: Path) -> Any:
        with h5py.File(folder / "x.h5", "w") as file:
            file["ch1"] = h5py.SoftLink("/na")
            file["na"] = h5py.SoftLink("/ch1")
        return "import", "airsas", "x.h5", "import.sampling_rate=1e5", "--output", "x"

    def huge(folder: Path) -> Any:
        with h5py.File(folder / "x.h5", "w") as file:
            file.create_dataset("ch1/ts", (10**6, 10**6), "f8", chunks=(1, 1000))
            file["na/position"] = np.zeros(10)
        return "import", "airsas", "x.h5", "import.sampling_rate=1e5", "--output", "x"

    for name, build in vars_of(external, raw, virtual, loop, huge):
        yield f"HDF5, {name}", build


def vars_of(*builders: Callable[..., Any]) -> list[tuple[str, Callable[..., Any]]]:
    """Return functions by their names."""
    return [(builder.__name__.replace("_", " "), builder) for builder in builders]


def _stores() -> Iterator[Attack]:
    def changed(folder: Path, change: Callable[[dict[str, Any]], None]) -> Any:
        file = folder / "store" / "spectrogram" / "zarr.json"
        described = json.loads(file.read_text())
        change(described)
        file.write_text(json.dumps(described))
        return (*FIT[:-4], "--output", "x", "--accelerator", "cpu")

    def codec(name: str) -> Callable[[dict[str, Any]], None]:
        return lambda described: described.update(
            codecs=[{"name": name, "configuration": {"protocol": 4}}]
        )

    for name in ("numcodecs.pickle", "numcodecs.msgpack2", "pickle", "os.system", "../x"):
        yield f"store with codec {name}", lambda f, n=name: changed(f, codec(n))
    yield (
        "store of 10^15 cells",
        lambda f: changed(f, lambda d: d.update(shape=[10**5, 2, 10**5, 10**5])),
    )
    yield (
        "store with a transformer",
        lambda f: changed(f, lambda d: d.update(storage_transformers=[{"name": "os.system"}])),
    )


def _bombs() -> Iterator[Attack]:
    def archive(folder: Path) -> Any:
        with zipfile.ZipFile(folder / "x.npz", "w", zipfile.ZIP_DEFLATED) as file:
            head = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                head, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 1, 60)}
            )
            with file.open("waveform.npy", "w", force_zip64=True) as member:
                member.write(head.getvalue())
                for _ in range(40):
                    member.write(bytes(10**7))
        return "import", "numpy", "x.npz", "--output", "x"

    def matlab(folder: Path) -> Any:
        head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
        body = struct.pack("<II", 14, 2**31 - 1) + bytes(10**8)
        packed = zlib.compress(body, 9)
        data = head + struct.pack("<II", 15, len(packed)) + packed
        (folder / "x.mat").write_bytes(data)
        return "import", "sonotracelab", "x.mat", "--output", "x"

    def nested(folder: Path) -> Any:
        (folder / "run" / "metrics.json").write_text("[" * 10**6)
        return "table", "run"

    def aliases(folder: Path) -> Any:
        lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
        lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
        (folder / "x.yaml").write_text("\n".join(lines))
        return "simulate", "x.yaml", "--output", "x"

    def integer(folder: Path) -> Any:
        (folder / "run" / "model.json").write_text('{"schema_version": ' + "9" * 10**5 + "}")
        return "predict", "run", "--accelerator", "cpu"

    for name, build in vars_of(archive, matlab, nested, aliases, integer):
        yield f"bomb, {name}", build


def _meshes() -> Iterator[Attack]:
    outside = "../outside/precious"
    for uri in (outside, "/etc/passwd", *URLS[:5]):

        def gltf(folder: Path, uri: str = uri) -> Any:
            described = {
                "asset": {"version": "2.0"},
                "buffers": [{"uri": uri, "byteLength": 36}],
                "bufferViews": [{"buffer": 0, "byteLength": 36}],
                "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "nodes": [{"mesh": 0}],
                "scenes": [{"nodes": [0]}],
                "scene": 0,
            }
            (folder / "x.gltf").write_text(json.dumps(described))
            return (
                *("simulate", "scene.name=mesh", "scene.options.path=x.gltf"),
                *("scene.options.unit=m", "--output", "x"),
            )

        yield f"glTF with a buffer at {uri}", gltf

    def material(folder: Path) -> Any:
        sphere = (
            trimesh.creation.icosphere(subdivisions=1, radius=0.03).export(file_type="obj").encode()
        )
        (folder / "x.obj").write_bytes(f"mtllib {outside}\nusemtl x\n".encode() + sphere)
        return (
            *("simulate", *SIMULATE[3:-4], "scene.name=mesh", "scene.options.path=x.obj"),
            *("scene.options.unit=m", "--output", "x"),
        )

    yield "OBJ with a library outside", material


def every() -> list[Attack]:
    """Return all attacks: what each is called, and what lays it into a folder and how it is met."""
    parts = (
        *(_checkpoints(), _pickles(), _tags(), _urls(), _names(), _links(), _scripts()),
        *(_hdf5(), _stores(), _bombs(), _meshes()),
    )
    return [attack for part in parts for attack in part]


def attacks(count: int, seed: int, keep: Path) -> Report:
    """Let commands meet what strangers may send.

    Args:
        count: Number of attacks; all where 0.
        seed: Seed of the choice.
        keep: Not used.
    """
    del keep
    report = Report("attacks", seed)
    chosen = every()
    if count:
        chosen = random.Random(seed).sample(chosen, min(count, len(chosen)))
    with prepared(SIMULATE, FIT) as folder:
        whole, outside = folder / "whole", folder / "outside"
        whole.mkdir()
        outside.mkdir()
        for words in (SIMULATE, FIT):
            outcome = give(words, whole)
            assert outcome.code == 0, outcome.said
        (outside / "precious").write_text("precious\n" * 200)
        with h5py.File(outside / "secret.h5", "w") as file:
            file["ts"] = file["x"] = np.full((5, 80), 0.5)
        before = contents(outside, leaving=())
        for name, build in chosen:
            place = folder / "place"
            shutil.copytree(whole, place)
            words = build(place)
            outcome = give(words, place, before=_watched(place))
            found = list(outcome.faults)
            found += [line for line in outcome.said.splitlines() if line.startswith("ATTACK")]
            if list(place.rglob(CANARY)) or Path(CANARY).exists():
                found.append("code ran")
            if contents(outside, leaving=()) != before:
                found.append("a file outside was changed")
            page = place / "run" / "report.html"
            if name.startswith("page") and name[10:] in page.read_text():
                found.append("the page holds the script")
            if outcome.peak > 3_000_000_000:
                found.append(f"{outcome.peak / 1e9:.1f} GB")
            for line in found:
                report.fault(f"{name}: {line}; {outcome.said[-200:]!r}")
            report.count("refused" if outcome.code else "without effect")
            shutil.rmtree(place)
    return report
