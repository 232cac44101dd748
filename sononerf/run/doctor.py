# SPDX-License-Identifier: MIT
"""Check of the machine: versions, memory, GPU, disk; with advice for each problem."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sononerf import __version__, storage
from sononerf.errors import SonoNerfError
from sononerf.resources import available_cores, available_memory

PACKAGES = (
    "lightning",
    "torchmetrics",
    "numpy",
    "scipy",
    "trimesh",
    "manifold3d",
    "embreex",
    "scikit-image",
    "tensorboard",
    "pyvista",
    "vtk",
    "typer",
    "zarr",
)
ENOUGH_MEMORY, ENOUGH_DISK = 2e9, 2e9
"""Bytes that a run of the defaults needs: 1.3 GB of memory were measured, and stores of 400 poses
with their runs take less than 1 GB."""


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    name: str  # Its name
    value: str  # The finding
    good: bool = True  # True if there is no problem
    remedy: str = ""  # Advice on how to get a missing item; empty if nothing is missing


def examine(folder: Path | None = None) -> list[Finding]:
    """Run all checks."""
    looks: tuple[Callable[[], Finding], ...] = (
        _python,
        _cpu,
        _memory,
        _torch,
        _gpu,
        _embree,
        lambda: _disk(folder or Path()),
        _viewer,
    )
    return [*(look() for look in looks), *map(_package, PACKAGES)]


def as_plain(findings: list[Finding]) -> dict[str, Any]:
    """Return findings as plain data."""
    good = all(finding.good for finding in findings)
    return {"sononerf": __version__, "good": good, "findings": [asdict(one) for one in findings]}


def as_lines(findings: list[Finding]) -> list[str]:
    """Return findings as lines of text; each problem has a line with advice."""
    width = max(len(finding.name) for finding in findings)
    lines = [f"     {'sononerf':<{width}}  {__version__}"]
    for finding in findings:
        mark = "ok  " if finding.good else "lack"
        lines.append(f"{mark} {finding.name:<{width}}  {finding.value}")
        if finding.remedy:
            lines.append(f"     {'':<{width}}  -> {finding.remedy}")
    return lines


def _python() -> Finding:
    return Finding("python", f"{platform.python_version()} on {platform.system()}")


def _cpu() -> Finding:
    cores = f"{available_cores()} of {os.cpu_count()} cores usable"
    return Finding("cpu", f"{platform.machine()}, {cores}")


def _memory() -> Finding:
    free = available_memory()
    if free is None:
        return Finding("memory", "not known")
    good = free >= ENOUGH_MEMORY
    remedy = "" if good else f"close other programs; a usual run needs {ENOUGH_MEMORY / 1e9:.0f} GB"
    return Finding("memory", f"{free / 1e9:.1f} GB available", good, remedy)


def _torch() -> Finding:
    import torch

    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU build"
    return Finding("torch", f"{torch.__version__}, {build}, {torch.get_num_threads()} threads")


DRIVER = Path("/proc/driver/nvidia/version")


def _gpu() -> Finding:
    import torch

    if torch.cuda.is_available():
        value = torch.cuda.get_device_properties(0)
        count = torch.cuda.device_count()
        text = f"{count} x {value.name}, {value.total_memory / 1e9:.0f} GB"
        return Finding("gpu", text)
    if torch.backends.mps.is_available():
        return Finding("gpu", "Apple's has no double precision; everything runs on the CPU")
    if not DRIVER.is_file():
        return Finding("gpu", "none; everything runs on the CPU")
    driver = DRIVER.read_text(encoding="utf-8", errors="replace").splitlines()[0]
    remedy = (
        "update the driver, or install a torch that was built for it"
        if torch.version.cuda
        else "install a torch that was built with CUDA"
    )
    return Finding("gpu", f"not usable by this torch; driver: {driver}", False, remedy)


def _embree() -> Finding:
    try:
        import embreex.rtcore_scene  # noqa: F401
    except ImportError as error:
        return Finding(
            "ray casting", f"by VTK, slower ({error})", False, "python -m pip install embreex"
        )
    return Finding("ray casting", "by Embree")


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free
    text = f"{free / 1e9:.0f} GB free in {folder.resolve()}"
    if free < ENOUGH_DISK:
        return Finding("disk", text, False, "make room, or give another --output")
    try:
        with tempfile.TemporaryDirectory(dir=folder) as place, storage.lock(Path(place)):
            storage.commit_text(Path(place) / "probe", "probe")
    except (OSError, SonoNerfError) as error:
        return Finding(
            "disk", f"not writable: {error}", False, "give an --output that can be written"
        )
    return Finding("disk", f"{text}, writes and locks work")


def _viewer() -> Finding:
    if importlib.util.find_spec("viser") is None:
        remedy = "python -m pip install 'sononerf[view]'"
        return Finding("viewer", "viser is not installed; `view` needs it", remedy=remedy)
    return Finding("viewer", f"viser {importlib.metadata.version('viser')}")


def _package(name: str) -> Finding:
    try:
        return Finding(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, "missing", False, f"python -m pip install {name}")
