# SPDX-License-Identifier: MIT
"""Show a run or a store in a browser, and follow a run that grows."""

from __future__ import annotations

import time
from pathlib import Path

import trimesh

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, SonoNerfError
from sononerf.progress import Progress
from sononerf.report.mesh_picture import SurfaceViews
from sononerf.report.viewer import Viewer
from sononerf.run.build import true_mesh
from sononerf.run.export import read_volume
from sononerf.run.run import Run, open_run
from sononerf.run.simulate import store_path
from sononerf.start.surface import confidence_of, error_of

REFRESH_SECONDS = 2.0
"""Interval at which a run's folder is checked for new files, s."""


class View:
    """A viewer of one folder; :meth:`refresh` shows new files."""

    def __init__(self, path: Path, *, port: int = 8080) -> None:
        self.run = Run(path)
        is_run = self.run.config.is_file()
        if not is_run and not (path / "zarr.json").is_file():
            raise InputError(f"{path}: neither a run nor a store; give the folder of one")
        echoes = None if is_run else Echoes.open(path)
        self.viewer = Viewer(path.resolve().name, port=port)
        self._has_echoes = False
        self._seen: dict[str, object] = {}
        try:
            if echoes is not None:
                self._show(echoes)
            else:
                self.refresh()
        except BaseException:
            self.viewer.close()
            raise

    def _show(self, echoes: Echoes) -> None:
        self.viewer.show_echoes(echoes)
        self._has_echoes = True

    def refresh(self) -> None:
        """Show new parts of the run: echoes, the mesh of the last epoch, model, and surface."""
        if not self.run.config.is_file():
            return
        if not self._has_echoes:
            try:
                self._show(self._echoes())
            except SonoNerfError as error:
                self._say(f"no echoes to show: {error}")
        if self._is_new("model", self.run.path / "model.json"):
            opened = open_run(self.run.path)
            quiet = Progress(quiet=True)
            self.viewer.show_model(
                opened.model, lambda poses: opened.predict(poses, progress=quiet)
            )
        if self.run.is_done("surface"):
            if self._is_new("surface", self.run.reconstruction / "read_out.json"):
                self._show_surface()
            return
        previews = sorted(self.run.path.glob("epochs/*/mesh.ply"))
        if previews and self._is_new("preview", previews[-1]):
            self.viewer.show_preview(trimesh.load_mesh(previews[-1], file_type="ply"))
            self._say(f"epoch {int(previews[-1].parent.name)}; the fit goes on")

    def _echoes(self) -> Echoes:
        if self.run.is_done("fit"):
            return self.run.echoes
        return Echoes.open(store_path(self.run.open(), None, None))

    def _show_surface(self) -> None:
        settings, mesh = self.run.open(), self.run.mesh()
        try:
            truth = None
            if settings.evaluation.registration == "none":
                truth = true_mesh(settings, self.run.provenance)
        except InputError as error:
            self._say(str(error))
            truth = None
        limit = self.run.head.resolution / 2
        views = SurfaceViews(mesh, confidence_of(mesh), error_of(mesh), truth, limit)
        self.viewer.show_surface(views)
        if (self.run.reconstruction / "volume.vti").is_file():
            self.viewer.show_volume(read_volume(self.run.path))
        read_out = self.run.read_out
        self._say(f"surface found as {read_out.get('method')}, refined: {read_out.get('refined')}")

    def _say(self, text: str) -> None:
        self.viewer.say(f"**{self.run.path.resolve().name}**: {text}.")

    def _is_new(self, name: str, file: Path) -> bool:
        """Return whether a file has come or changed since the last look."""
        if not file.is_file():
            return False
        state = (str(file), file.stat().st_mtime_ns)
        changed = self._seen.get(name) != state
        self._seen[name] = state
        return changed

    def follow(self) -> None:
        """Refresh again and again, until the process is stopped."""
        while True:
            time.sleep(REFRESH_SECONDS)
            try:
                self.refresh()
            except SonoNerfError as error:
                self._say(str(error))
