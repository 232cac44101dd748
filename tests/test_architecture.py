# SPDX-License-Identifier: MIT
"""The house's rules: who may import whom, who may write, draw, move to a device, or load code."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "sononerf"

FLOORS = (
    ("errors", "numerics", "progress", "resources"),
    ("storage", "matlab_files", "wav_files", "display", "settings", "geometry"),
    ("scene", "head"),
    ("echoes",),
    ("simulation", "recordings"),
    ("field",),
    ("start",),
    ("refinement",),
    ("evaluation",),
    ("report",),
    ("callbacks",),
    ("run", "testing"),
    ("cli",),
)
"""From the ground up. A room may import rooms of lower floors and those before it on its own."""
LONGEST = 560
"""Lines of a source file, its blank lines and docstrings included."""
ROOMS = [room for floor in FLOORS for room in floor]
# Below `run`, which turns settings into objects, nobody chooses a device.
DEVICELESS = ROOMS[: ROOMS.index("run")]
# Pure functions of tensors: torch, the standard library, each other, and pydantic, which bounds
# the options of a factory in its annotations.
PURE = {f"sononerf.field.{name}" for name in ("field fields lobe profile renderer").split()}


def sources(folder=PACKAGE):
    """Return the sources below a folder, but for the packages that `new-plugin` copies."""
    return sorted(path for path in folder.rglob("*.py") if "templates" not in path.parts)


def name_of(path):
    return str(path.relative_to(ROOT))


def room_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def parse(path):
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imports(tree):
    """Yield each imported module's dotted name, lazy ones too, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            if node.module == "sononerf":
                for alias in node.names:
                    yield f"sononerf.{alias.name}", node.lineno
            else:
                yield node.module, node.lineno


def dotted(node):
    """Return `a.b.c` of an attribute chain, or '' where it starts from something else."""
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def calls(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            method = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            yield node, dotted(node.func), method


# Each rule returns the line numbers at which a source breaks it. They are functions of the tree
# alone, so that the last test can show each of them a source that breaks it.


def arrows_up(tree, room):
    own = ROOMS.index(room)
    for module, line in imports(tree):
        first, _, rest = module.partition(".")
        target = rest.partition(".")[0]
        if first == "sononerf_scenes":
            yield line
        elif first == "sononerf" and target not in ("", "__version__"):
            if target not in ROOMS or ROOMS.index(target) > own:
                yield line


def strings_up(tree, room):
    """Find names of modules of higher floors in strings, which are imports in disguise."""
    own = ROOMS.index(room)
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Constant) and isinstance(node.value, str)):
            continue
        found = re.fullmatch(r"sononerf\.(\w+)(\.\w+)+", node.value)
        if found and found[1] in ROOMS and ROOMS.index(found[1]) > own:
            yield node.lineno


def impure_imports(tree, module):
    if module not in PURE:
        return
    for found, line in imports(tree):
        first = found.partition(".")[0]
        if first == "sononerf":
            if found not in {*PURE, "sononerf.errors", "sononerf.head.head"}:
                yield line
        elif first not in ("torch", "pydantic") and first not in sys.stdlib_module_names:
            yield line


def device_choices(tree, room):
    if room not in DEVICELESS:
        return
    for node, name, method in calls(tree):
        given = [k.value for k in node.keywords if k.arg == "device"]
        if method == "to":
            given += node.args
        chosen = [
            value
            for value in given
            if (isinstance(value, ast.Constant) and isinstance(value.value, str))
            or (isinstance(value, ast.Name) and re.search("device|cuda|gpu", value.id))
        ]
        if chosen or method == "cuda" or name == "torch.device":
            yield node.lineno


SINKS = {
    "export",
    "save",
    "savez",
    "savez_compressed",
    "savetxt",
    "savefig",
    "tofile",
    "screenshot",
}


def writing(tree, file):
    """Find files written past `storage`; a writer that `commit` calls names its file `file`."""
    if file == "storage.py":
        return
    for node, name, method in calls(tree):
        modes = [*node.args[:2], *(k.value for k in node.keywords if k.arg == "mode")]
        modes = [m.value for m in modes if isinstance(m, ast.Constant) and isinstance(m.value, str)]
        opens = name == "open" or method == "open" or name == "os.fdopen"
        if opens and any(re.fullmatch(r"[rwaxbt+]*[wax+][rwaxbt+]*", mode) for mode in modes):
            # zarr's r+ opens a group whose store commits each of its keys.
            if name not in ("zarr.open_group", "cls.open", "EnsembleStore.open"):
                yield node.lineno
        if method in ("write_text", "write_bytes") or name in ("os.open", "os.replace"):
            yield node.lineno
        if method in SINKS:
            targets = [a.id for a in node.args if isinstance(a, ast.Name)]
            only_bytes = method == "export" and not node.args
            in_memory = name == "safetensors.torch.save"
            if not (only_bytes or in_memory or {"file", "buffer"} & set(targets)):
                yield node.lineno


EMPTY = {"found", "known", "wanted", "told", "met", "asked"}


def empty_names(tree):
    """Find names that do not say what they hold: arguments, attributes, and what outlives lines."""
    for node in ast.walk(tree):
        if getattr(node, "arg", None) in EMPTY or getattr(node, "attr", None) in EMPTY:
            yield node.lineno
        elif isinstance(node, ast.ClassDef):
            fields = [part.target for part in node.body if isinstance(part, ast.AnnAssign)]
            yield from (field.lineno for field in fields if field.id in EMPTY)
        elif isinstance(node, ast.FunctionDef):
            lines = {}
            for part in ast.walk(node):
                if isinstance(part, ast.Name) and part.id in EMPTY:
                    lines.setdefault(part.id, []).append(part.lineno)
            yield from (min(at) for at in lines.values() if max(at) - min(at) > 3)


def faults(path):
    """Return every broken rule of one source file as `file:line: rule`."""
    tree = parse(path)
    room, file = room_of(path), path.name
    if room == "__init__":
        return []
    assert room in ROOMS, f"{name_of(path)}: {room} has no place in FLOORS"
    module = name_of(path).removesuffix(".py").replace("/", ".")
    found = {
        "an arrow that points up": arrows_up(tree, room),
        "an arrow up by a string": strings_up(tree, room),
        "not pure": impure_imports(tree, module),
        "chooses a device": device_choices(tree, room),
        "writes past storage": writing(tree, file),
        "a name without content": empty_names(tree),
    }
    return [f"{name_of(path)}:{line}: {rule}" for rule, lines in found.items() for line in lines]


def test_every_source_keeps_the_rules():
    assert "\n".join(fault for path in sources() for fault in faults(path)) == ""


@pytest.mark.parametrize(
    ("rule", "arguments", "bad", "good"),
    [
        (arrows_up, ("storage",), "import sononerf.echoes.store", "import sononerf.errors"),
        (strings_up, ("scene",), 'm = "sononerf.report.page"', 'm = "sononerf.errors.x"'),
        (arrows_up, ("geometry",), "from sononerf import scene", "from sononerf import storage"),
        (arrows_up, ("scene",), "import sononerf_scenes.sphere", "import trimesh"),
        (arrows_up, ("scene",), "import sononerf.head.ears", "import sononerf.settings.loading"),
        (arrows_up, ("echoes",), "def f():\n import sononerf.run.fit", "import sononerf.echoes.x"),
        (impure_imports, ("sononerf.field.fields",), "import numpy", "import math, torch.nn"),
        (
            impure_imports,
            ("sononerf.field.fields",),
            "import sononerf.field.module",
            "import sononerf.field.lobe",
        ),
        (device_choices, ("field",), "x.to('cuda')", "x.to(y.dtype)"),
        (device_choices, ("field",), "x.to(device)", "x.to(y.device)"),
        (device_choices, ("echoes",), "torch.ones(1, device='cpu')", "f(device=x.device)"),
        (device_choices, ("field",), "x.cuda()", "x.cpu()"),
        (device_choices, ("field",), "torch.device(0)", "x.device"),
        (empty_names, (), "def f(found):\n return 1", "def f(x):\n found = x\n return found"),
        (empty_names, (), "def f():\n met = 1\n\n\n\n return met", "class A:\n rows: int"),
        (empty_names, (), "class A:\n known: int", "a.rows = 1"),
        (writing, ("a.py",), "open(p, 'w')", "open(p)"),
        (writing, ("a.py",), "p.open('wb')", "p.open('rb')"),
        (writing, ("a.py",), "open(p, mode='a')", "open('w.txt')"),
        (writing, ("a.py",), "p.write_text('x')", "p.read_text()"),
        (writing, ("a.py",), "mesh.export(p)", "mesh.export(file_type='ply')"),
        (writing, ("a.py",), "np.save('a.npy', x)", "np.save(file, x)"),
        (writing, ("a.py",), "image.save(path)", "image.save(buffer, format='PNG')"),
    ],
)
def test_each_rule_sees_a_source_that_breaks_it(rule, arguments, bad, good):
    assert len(list(rule(ast.parse(bad), *arguments))) == 1
    assert list(rule(ast.parse(good), *arguments)) == []


def test_scenes_use_the_public_door():
    allowed = {"scene", "geometry", "errors"}
    for path in sources(ROOT / "scenes"):
        for module, line in imports(parse(path)):
            first, _, rest = module.partition(".")
            if first == "sononerf":
                assert rest.partition(".")[0] in allowed, f"{name_of(path)}:{line}: {module}"


def test_no_server_listens_on_every_address():
    for path in [*sources(), *sources(ROOT / "scenes"), *sources(ROOT / "tools")]:
        assert "0.0" + ".0.0" not in path.read_text(encoding="utf-8"), name_of(path)


def test_no_file_is_a_drawer_for_everything():
    for folder in (PACKAGE, ROOT / "scenes", ROOT / "tests", ROOT / "tools"):
        for path in sources(folder):
            assert not re.search("util|misc|common|helper", path.stem), name_of(path)


def test_no_file_name_occurs_twice():
    names = [path.name for path in sources() if path.name != "__init__.py"]
    assert sorted(name for name in set(names) if names.count(name) > 1) == []


def test_no_file_is_too_long_to_know():
    lengths = {name_of(p): len(p.read_text(encoding="utf-8").splitlines()) for p in sources()}
    assert {name: count for name, count in lengths.items() if count > LONGEST} == {}


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("sononerf.cli.__main__", ["typer", "rich", "pydantic", "numpy"]),
        ("sononerf.cli.app", ["torch", "lightning", "pyvista", "vtkmodules", "zarr", "matplotlib"]),
        ("sononerf.storage", ["torch", "numpy", "zarr"]),
        ("sononerf.settings.loading", ["torch", "numpy", "trimesh"]),
    ],
)
def test_importing_stays_light(module, heavy):
    script = f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_folder_is_packaged(project):
    folders = {path.parent for path in sources()}
    names = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert {*names, "sononerf_scenes", "sononerf_configs"} == set(
        project["tool"]["setuptools"]["packages"]
    )


def test_the_settings_of_an_experiment_stay_with_those_who_turn_them_into_objects():
    allowed = {"settings", "run", "cli"}
    found = [
        f"{name_of(path)}:{node.lineno}"
        for path in sources()
        if room_of(path) not in allowed
        for node in ast.walk(parse(path))
        if (isinstance(node, ast.Name) and node.id == "Settings")
        or (isinstance(node, ast.alias) and node.name == "Settings")
    ]
    assert found == []
