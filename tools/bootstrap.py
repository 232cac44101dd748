#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Make a virtual environment in `.venv` once; run the demo, tests, checks, or build the manual.

    python3 tools/bootstrap.py {demo|test|test-all|check|docs} [ARGUMENT]...

Standard library only. Nothing is written outside this checkout. Further arguments go to the
command: KEY=VALUE and options for the demo, pytest's for tests and checks, Sphinx's for the
manual. `TORCH_INDEX=URL` names the package index that torch, and torch alone, is taken from.
"""

from __future__ import annotations  # so that an older Python gets as far as being told

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OLDEST_PYTHON = (3, 11)
TORCH = "torch==2.13.0"
COMMANDS = ("demo", "test", "test-all", "check", "docs")
PYTEST = ("-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "loadfile")
"""The tests run one file per process, on at most four cores: each process takes 0.7 GiB."""
DEMO_CONFIG = "configs/three_spheres.yaml"
TESTS = ".[test]"
"""Requirement of the tests; the demo needs less."""
UNFINISHED = "unfinished"


def say(text: str) -> None:
    """Tell the user what is going on, apart from what the command itself prints."""
    print(f"sononerf: {text}", file=sys.stderr, flush=True)


def fail(text: str) -> SystemExit:
    """Return the end of the script with one line and the exit code for wrong usage."""
    say(text)
    return SystemExit(2)


def _hash(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def fingerprint(root: Path) -> str:
    """Return two hashes: of what makes an environment another one, and of what goes into it."""
    # An editable install and its scripts point into their checkout.
    identity = _hash(sys.version.encode(), str(root).encode())
    content = _hash((root / "pyproject.toml").read_bytes(), TORCH.encode())
    return f"{identity}\n{content}\n"


def interpreter(environment: Path) -> Path:
    """Return the Python inside a virtual environment."""
    if os.name == "nt":
        return environment / "Scripts" / "python.exe"
    return environment / "bin" / "python"


def create(environment: Path) -> None:
    """Make an empty virtual environment with pip, in place of whatever is there."""
    say(f"creating {environment.name}")
    try:
        venv.EnvBuilder(with_pip=True, clear=True, symlinks=os.name != "nt").create(environment)
    except (subprocess.CalledProcessError, ImportError):
        shutil.rmtree(environment, ignore_errors=True)
        raise fail(
            "this Python cannot make virtual environments; on Debian and Ubuntu: "
            "apt install python3-venv"
        ) from None
    except OSError as error:
        raise fail(f"cannot create {environment}: {error.strerror}") from None


def install(root: Path, environment: Path, what: str) -> None:
    """Install torch, then this checkout, alone or with what its tests need."""
    say("installing (about a minute the first time)")
    index = os.environ.get("TORCH_INDEX")
    pip = [str(interpreter(environment)), "-m", "pip", "install", "--disable-pip-version-check"]
    # Python compiles what it imports at the first import, a tenth of what is installed.
    pip.append("--no-compile")
    for arguments in ([*(["--index-url", index] if index else []), TORCH], ["--editable", what]):
        code = subprocess.call([*pip, "--quiet", *arguments], cwd=root)
        if code:
            say("installing failed; give the same command again to go on")
            raise SystemExit(code)


def has_pip(python: Path) -> bool:
    """Tell whether an environment's Python runs and has pip."""
    try:
        command = [str(python), "-m", "pip", "--version"]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def prepare(root: Path, what: str = TESTS) -> Path:
    """Bring the environment up to date where it is not, and return its Python."""
    environment = root / ".venv"
    stamp = environment / ".sononerf-stamp"
    wanted = f"{fingerprint(root)}{what}\n"
    python = interpreter(environment)
    found = stamp.read_text(encoding="utf-8") if stamp.is_file() else ""
    if found in (wanted, f"{fingerprint(root)}{TESTS}\n") and python.exists():
        return python
    # An interrupted install may have left half a package, which pip would take for a whole one.
    is_other = bool(found) and found.partition("\n")[0] != wanted.partition("\n")[0]
    if is_other or not has_pip(python):
        create(environment)
    stamp.write_text(UNFINISHED, encoding="utf-8")
    install(root, environment, what)
    stamp.write_text(wanted, encoding="utf-8")
    say("ready")
    return python


def next_run(root: Path) -> Path:
    """Return the demo's next free run folder."""
    number = 1
    while (root / "runs" / f"demo-{number}").exists():
        number += 1
    return Path("runs") / f"demo-{number}"


def command_line(command: str, python: Path, root: Path, arguments: list[str]) -> list[str]:
    """Return what a command runs inside the environment."""
    if command == "demo":
        output = ["--output", str(next_run(root))]
        return [str(python), "-m", "sononerf.cli", "fit", DEMO_CONFIG, *output, *arguments]
    if command == "test":
        return [str(python), *PYTEST, *arguments]
    if command == "test-all":
        return [str(python), *PYTEST, "-m", "not slow", *arguments]
    if command == "docs":
        pages = [str(root / "docs"), str(root / "docs" / "_build")]
        return [str(python), "-m", "sphinx", "-W", "--keep-going", "-q", *pages, *arguments]
    return ["bash", str(root / "tools" / "check"), *arguments]


def main(arguments: list[str], root: Path = ROOT) -> int:
    """Run one command and return its exit code."""
    if sys.version_info < OLDEST_PYTHON:
        found = ".".join(map(str, sys.version_info[:3]))
        raise fail(
            f"Python {found} at {sys.executable} is too old; 3.11 or newer is needed: "
            "make PY=python3.11 ..."
        )
    if not arguments or arguments[0] not in COMMANDS:
        raise fail(f"usage: bootstrap.py {{{'|'.join(COMMANDS)}}} [ARGUMENT]...")
    python = prepare(root, "." if arguments[0] == "demo" else TESTS)
    os.environ["PY"] = str(python)
    command = command_line(arguments[0], python, root, arguments[1:])
    if os.name == "nt":
        return subprocess.call(command, cwd=root)
    # The command takes this process's place, so exit codes and signals are its own.
    os.chdir(root)
    os.execvp(command[0], command)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
