# SPDX-License-Identifier: MIT
"""What every test may ask for; nothing here needs a GPU."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

# Other test processes run beside this one; so that commands started by tests take one core too.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch  # it reads the variable

TESTS = Path(__file__).resolve().parent
PLUGIN = TESTS / "plugin"


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="where tensors of the tests live")


def pytest_configure():
    # Bits depend on the number of threads, and other test processes may run beside this one.
    torch.set_num_threads(1)
    # `nohup` and batch systems ignore these, and the program then goes on ignoring them.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session")
def device(request):
    """The device that `--device` names."""
    return torch.device(request.config.getoption("--device"))


@pytest.fixture(scope="session")
def plugin_folder(tmp_path_factory):
    """A folder into which the fixture distribution is installed as anyone would install it."""
    target = tmp_path_factory.mktemp("plugin")
    source = tmp_path_factory.mktemp("source") / "plugin"
    # Building writes beside the sources; the checkout is not for that.
    source.mkdir()
    for file in PLUGIN.iterdir():
        if file.is_file():
            (source / file.name).write_bytes(file.read_bytes())
    flags = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", *flags, "--target", target, source],
        check=True,
        env={**os.environ, "PIP_CONFIG_FILE": os.devnull},
    )
    return target


@pytest.fixture
def plugin(plugin_folder, monkeypatch):
    """The fixture distribution, importable during one test."""
    monkeypatch.syspath_prepend(plugin_folder)
    yield plugin_folder
    sys.modules.pop("fixture_bar", None)
