# SPDX-License-Identifier: MIT
"""Set-up: installs once, repairs what was interrupted, and then gets out of the way."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bootstrap():
    spec = importlib.util.spec_from_file_location("bootstrap", ROOT / "tools" / "bootstrap.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def checkout(tmp_path):
    """A checkout of nothing but what set-up reads."""
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    return tmp_path


@pytest.fixture
def installs(bootstrap, monkeypatch):
    """Set-up with its two slow steps replaced by notes of them."""
    done = []

    def create(environment):
        done.append("create")
        shutil.rmtree(environment, ignore_errors=True)
        python = bootstrap.interpreter(environment)
        python.parent.mkdir(parents=True)
        python.symlink_to(sys.executable)

    monkeypatch.setattr(bootstrap, "create", create)
    monkeypatch.setattr(bootstrap, "install", lambda *_: done.append("install"))
    monkeypatch.setattr(bootstrap, "has_pip", lambda python: python.exists())
    return done


def test_the_second_call_does_nothing(bootstrap, checkout, installs):
    python = bootstrap.prepare(checkout)
    assert installs == ["create", "install"]
    started = time.perf_counter()
    assert bootstrap.prepare(checkout) == python
    assert time.perf_counter() - started < 0.5
    assert installs == ["create", "install"]


def test_other_dependencies_install_again(bootstrap, checkout, installs, monkeypatch):
    bootstrap.prepare(checkout)
    (checkout / "pyproject.toml").write_text("[project]\nname = 'x'\n")
    bootstrap.prepare(checkout)
    assert installs == ["create", "install", "install"]
    monkeypatch.setattr(bootstrap, "TORCH", "torch==0")
    bootstrap.prepare(checkout)
    assert installs == ["create", "install", "install", "install"]


def test_the_demo_leaves_out_what_only_the_tests_need(bootstrap, checkout, installs):
    bootstrap.prepare(checkout, ".")
    bootstrap.prepare(checkout)
    assert installs == ["create", "install", "install"]
    bootstrap.prepare(checkout, ".")
    assert installs == ["create", "install", "install"]


def test_the_usual_tests_leave_out_the_thorough_ones(bootstrap):
    usual, whole = (
        bootstrap.command_line(name, Path("python"), ROOT, ["-x"]) for name in ("test", "test-all")
    )
    assert "not slow" not in usual
    assert whole[-3:] == ["-m", "not slow", "-x"]


def test_another_python_or_place_starts_afresh(bootstrap, checkout, installs, monkeypatch):
    bootstrap.prepare(checkout)
    monkeypatch.setattr(sys, "version", "3.99")
    bootstrap.prepare(checkout)
    assert installs == ["create", "install"] * 2


@pytest.mark.parametrize("fault", [KeyboardInterrupt, SystemExit])
def test_an_interrupted_install_is_repaired(bootstrap, checkout, installs, monkeypatch, fault):
    def stopped(*_):
        raise fault

    with monkeypatch.context() as patch:
        patch.setattr(bootstrap, "install", stopped)
        with pytest.raises(fault):
            bootstrap.prepare(checkout)
    bootstrap.prepare(checkout)
    assert installs == ["create", "create", "install"]


def test_an_environment_of_the_users_own_is_kept(bootstrap, checkout, installs):
    bootstrap.create(checkout / ".venv")
    (checkout / ".venv" / "mine").write_text("")
    bootstrap.prepare(checkout)
    assert installs == ["create", "install"]
    assert (checkout / ".venv" / "mine").exists()


def test_torch_alone_comes_from_the_named_index(bootstrap, checkout, monkeypatch):
    commands = []
    monkeypatch.setattr(subprocess, "call", lambda command, **_: commands.append(command) or 0)
    monkeypatch.delenv("TORCH_INDEX", raising=False)
    bootstrap.install(checkout, checkout / ".venv", ".[test]")
    assert not any("--index-url" in command for command in commands)
    commands.clear()
    monkeypatch.setenv("TORCH_INDEX", "https://host/cpu")
    bootstrap.install(checkout, checkout / ".venv", ".[test]")
    first, second = commands
    assert first[-3:] == ["--index-url", "https://host/cpu", bootstrap.TORCH]
    assert second[-2:] == ["--editable", ".[test]"]
    assert "--index-url" not in second


def test_a_failed_install_keeps_its_exit_code(bootstrap, checkout, monkeypatch, capsys):
    monkeypatch.setattr(subprocess, "call", lambda *_, **__: 7)
    with pytest.raises(SystemExit, match="7"):
        bootstrap.install(checkout, checkout / ".venv", ".[test]")
    assert "give the same command again" in capsys.readouterr().err


def test_a_python_without_ensurepip_is_told_the_way_out(bootstrap, checkout, monkeypatch, capsys):
    def create(*_):
        raise subprocess.CalledProcessError(1, "ensurepip")

    monkeypatch.setattr(bootstrap.venv.EnvBuilder, "create", create)
    with pytest.raises(SystemExit, match="2"):
        bootstrap.create(checkout / ".venv")
    assert "apt install python3-venv" in capsys.readouterr().err
    assert not (checkout / ".venv").exists()


def test_an_old_python_is_told_in_one_line(bootstrap, monkeypatch, capsys):
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    with pytest.raises(SystemExit, match="2"):
        bootstrap.main(["test"])
    message = capsys.readouterr().err
    assert "Python 3.9.2" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("arguments", [[], ["tset"], ["--help"]])
def test_wrong_usage(bootstrap, arguments, capsys):
    with pytest.raises(SystemExit, match="2"):
        bootstrap.main(arguments)
    assert "usage: bootstrap.py {demo|test|test-all|check|docs}" in capsys.readouterr().err


def test_each_demo_gets_a_folder_of_its_own(bootstrap, checkout):
    python = Path("python")
    first = bootstrap.command_line("demo", python, checkout, ["fit.epochs=1"])
    assert first[1:] == [
        *("-m", "sononerf.cli", "fit", "configs/three_spheres.yaml"),
        *("--output", str(Path("runs") / "demo-1"), "fit.epochs=1"),
    ]
    (checkout / "runs" / "demo-1").mkdir(parents=True)
    assert str(Path("runs") / "demo-2") in bootstrap.command_line("demo", python, checkout, [])


@pytest.mark.parametrize("code", [0, 3, 130])
def test_exit_codes_and_arguments_pass_through(bootstrap, checkout, code):
    """With the real script, an environment that counts as ready, and a stand-in for pytest."""
    (checkout / "tools").mkdir()
    script = checkout / "tools" / "bootstrap.py"
    shutil.copy(ROOT / "tools" / "bootstrap.py", script)
    python = bootstrap.interpreter(checkout / ".venv")
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    stamp = checkout / ".venv" / ".sononerf-stamp"
    stamp.write_text(f"{bootstrap.fingerprint(checkout)}.[test]\n")
    (checkout / "pytest.py").write_text(
        "import sys\nprint(sys.argv[-2:])\nsys.exit(int(sys.argv[-2]))"
    )
    done = subprocess.run(
        [sys.executable, script, "test", str(code), "-k"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONSAFEPATH": ""},
    )
    assert (done.returncode, done.stdout.strip()) == (code, str([str(code), "-k"]))


def test_the_makefile_has_no_logic():
    lines = (ROOT / "Makefile").read_text().splitlines()
    assert [line for line in lines if line.startswith("\t")] == ["\t$(PY) tools/bootstrap.py $@"]


def test_the_pinned_torch_is_one_that_the_project_takes(bootstrap):
    text = (ROOT / "pyproject.toml").read_text()
    assert bootstrap.TORCH.startswith("torch==2.")
    assert int(bootstrap.TORCH.split(".")[1]) >= 10
    assert '"torch>=2.10"' in text


@pytest.mark.parametrize("name", ["tools/check", ".ci/run"])
def test_scripts_are_executable_and_stop_at_the_first_fault(name):
    path = ROOT / name
    assert os.access(path, os.X_OK)
    assert "set -euo pipefail" in path.read_text()
