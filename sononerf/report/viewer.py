# SPDX-License-Identifier: MIT
"""Viewer of a run or a store in a browser: mesh, volume, poses, echoes, and a head to drag."""

from __future__ import annotations

import base64
import io
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import numpy as np
import torch
import trimesh

from sononerf.echoes.echoes import Echoes
from sononerf.errors import NumericalError, ResourceError
from sononerf.evaluation.prediction import Prediction
from sononerf.field.datamodule import RangeSlices
from sononerf.field.module import EchoModule, decibels
from sononerf.geometry.lattice import Volume, isosurface, level_surface
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import compress
from sononerf.numerics import Floats
from sononerf.report.figure import DEFAULT_VIEW
from sononerf.report.mesh_picture import CLAY, STEEL, SurfaceViews
from sononerf.report.page import STRETCH, echo_wav
from sononerf.report.spectrogram_picture import quick_image, spectrogram_image

HOST = "127.0.0.1"
"""Address of the page: only browsers on this machine reach it."""
SPLITS = {0: (190, 70, 40), 1: (20, 140, 100), 2: (50, 70, 200)}
"""Colours of training, validation and test poses."""
HEAD = 0.06
"""Length of a head that is drawn, as a fraction of the poses' mean distance."""
VOXELS = 40
"""Number of voxels along the region's longest side, for the surface of the free space."""
DEEPEST = 40.0
"""Lowest level of the volume, dB below its maximum."""

LIVE_BINS = 32
"""Largest number of frequencies that are rendered while a head is dragged: 24 of 47 take a third
less time, and look the same in a small picture."""

Predict = Callable[[Poses], Prediction]


class Viewer:
    """A page in the browser, served to this machine alone until it is closed."""

    def __init__(self, title: str, *, port: int = 8080) -> None:
        try:
            import viser
        except ImportError:
            raise ResourceError(
                "the viewer needs viser: python -m pip install 'sononerf[view]'"
            ) from None
        with redirect_stdout(io.StringIO()):  # viser prints a banner
            self.server = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.scene.add_light_ambient("/light", intensity=0.6)
        self.server.gui.configure_theme(show_share_button=False, control_width="large")
        self._lock = threading.RLock()
        # Middle of the body, and mean distance of the poses from it, m; until echoes are shown.
        self._centre, self._span = np.zeros(3), 0.1
        self._echoes: Echoes | None = None
        self._model: EchoModule | None = None
        self._predict: Predict | None = None
        self._shown: dict[str, Any] = {}
        self._boxes: dict[str, Any] = {}
        self._chooser: Any = None
        self._status = self.server.gui.add_markdown(f"**{title}**")
        self._choices = self.server.gui.add_folder("Show")
        self._pose_folder = self.server.gui.add_folder("Pose")
        with self._pose_folder:
            self._pose_text = self.server.gui.add_markdown("Click a head.")
            self._pose_image = self.server.gui.add_image(_blank(), visible=False)
            self._pose_sound = self.server.gui.add_html("", visible=False)
        self.pose: int | None = None
        self.server.on_client_connect(self._look)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    def say(self, text: str) -> None:
        """Show a line above all else."""
        self._status.content = text

    def _look(self, client: Any) -> None:
        view = np.asarray(DEFAULT_VIEW) / np.linalg.norm(DEFAULT_VIEW)
        client.camera.near = 0.01 * self._span
        client.camera.position = self._centre + 2.4 * self._span * view
        client.camera.look_at = self._centre

    def _toggle(self, name: str, handle: Any, *, on: bool = True, hint: str | None = None) -> None:
        """Add a checkbox that shows and hides an object; a name has one checkbox."""
        self._shown[name] = handle
        box = self._boxes.get(name)
        if box is None:
            with self._choices:
                box = self._boxes[name] = self.server.gui.add_checkbox(name, on, hint=hint)

            @box.on_update
            def _(_: Any) -> None:
                self._shown[name].visible = box.value

        handle.visible = box.value

    # Echoes.

    def show_echoes(self, echoes: Echoes) -> None:
        """Show poses as small heads that can be clicked, onsets, and the free space."""
        self._echoes = echoes
        self._centre = np.asarray(echoes.region.box()).mean(axis=0)
        self._span = float(np.linalg.norm(echoes.positions - self._centre, axis=1).mean())
        for client in self.server.get_clients().values():
            self._look(client)
        cone = _head(HEAD * self._span)
        colours = np.array([SPLITS[int(n)] for n in echoes.store.split], dtype=np.uint8)
        handle = self.server.scene.add_batched_meshes_simple(
            "/poses",
            np.asarray(cone.vertices, dtype=np.float32),
            np.asarray(cone.faces, dtype=np.uint32),
            batched_wxyzs=_quaternions(echoes.rotations),
            batched_positions=echoes.positions.astype(np.float32),
            batched_colors=colours,
            lod="off",
            cast_shadow=False,
        )

        @handle.on_click
        def _(event: Any) -> None:
            if event.instance_index is not None:
                self.choose(int(event.instance_index))

        self._toggle("poses", handle, hint="red: training, green: validation, blue: test")
        self._show_onsets(echoes)

    def _show_onsets(self, echoes: Echoes) -> None:
        hull = echoes.hull
        with_onset = np.flatnonzero(np.isfinite(hull.first).any(axis=1))
        if not len(with_onset):
            return
        inlier_onsets = np.asarray(np.isfinite(hull.inlier_onsets[with_onset]).any(axis=1))
        # Drawn straight ahead, because an onset has a range and no direction.
        at = (
            hull.sources[with_onset]
            + hull.axes[with_onset] * hull.first[with_onset].max(axis=1)[:, None]
        )
        colours = np.where(inlier_onsets[:, None], (30, 120, 30), (220, 0, 160)).astype(np.uint8)
        points = self.server.scene.add_point_cloud(
            "/onsets",
            at.astype(np.float32),
            colours,
            point_size=0.008 * self._span,
            precision="float32",
        )
        hint = "first echoes, drawn straight ahead of each pose; pink ones are outliers"
        self._toggle("onsets", points, on=False, hint=hint)
        lower, upper = np.asarray(echoes.region.box())
        spacing = float((upper - lower).max()) / VOXELS
        axes = [np.arange(a, b + spacing, spacing) for a, b in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        left = hull.clearance(grid.reshape(-1, 3))[0].reshape(grid.shape[:3])
        left = np.pad(np.clip(left, -spacing, spacing), 1, constant_values=-spacing)
        if not left.min() < 0 < left.max():
            return
        mesh = level_surface(left + 1e-6 * spacing, 0.0, lower - spacing, spacing)
        handle = self._mesh("/free", mesh, (150, 170, 200), opacity=0.35)
        hint = "the space that no first echo rules out"
        self._toggle("free space's bound", handle, on=False, hint=hint)

    def choose(self, pose: int) -> None:
        """Show the measured and the predicted spectrogram of a pose."""
        echoes = self._echoes
        assert echoes is not None
        with self._lock:
            self.pose = pose
            heard = echoes.spectrogram(pose)
            kind = ("training", "validation", "test")[int(echoes.store.split[pose])]
            level = compress(heard, echoes.reference)
            alone = None
            if self._model is not None:
                one = Poses(echoes.positions[pose : pose + 1], echoes.rotations[pose : pose + 1])
                alone = self._rendered(one, all_ranges=True)[0]
            self._draw_pose(pose, kind, level, alone, "the field alone")
            sound = echo_wav(
                heard, echoes.head.range, echoes.head.frequency, echoes.head.speed_of_sound
            )
            data = base64.b64encode(sound).decode()
            self._pose_sound.content = (
                f"<div style='padding:0.3em 0.7em'>Echo, {STRETCH:g} times longer and lower:"
                f"<audio controls style='width:100%' src='data:audio/wav;base64,{data}'></audio>"
                "</div>"
            )
            self._pose_sound.visible = True
        if self._predict is not None:
            found = compress(self._predict(one).magnitude[0], echoes.reference)
            with self._lock:
                if self.pose == pose:
                    self._draw_pose(pose, kind, level, found, "field and traced echoes")

    def _draw_pose(
        self, pose: int, kind: str, level: Floats, predicted: Floats | None, by: str
    ) -> None:
        echoes = self._echoes
        assert echoes is not None
        axes = echoes.head.range, echoes.head.frequency
        said = f"Pose {pose}, {kind}"
        if predicted is not None:
            said += f"; predicted by {by}: {np.abs(predicted - level).mean():.2f} dB, all cells"
        self._pose_image.image = spectrogram_image(level, predicted, *axes, f"pose {pose}")
        self._pose_image.visible = True
        self._pose_text.content = said + "."

    # Model.

    def show_model(self, model: EchoModule, predict: Predict | None = None) -> None:
        """Show a head that can be dragged, and the spectrogram that it would hear."""
        self._model, self._predict = model, predict
        with self.server.gui.add_folder("Free head"):
            self._live_text = self.server.gui.add_markdown("Drag the head in the scene.")
            self._live_image = self.server.gui.add_image(_blank())
        x, y, z = DEFAULT_VIEW
        away = np.array([x + y, y - x, 2.0 * z])  # to the left of where the camera begins
        away = self._centre + away * self._span / np.linalg.norm(away)
        rotation = Poses.looking_at(away[None], self._centre).rotations
        self.head = self.server.scene.add_transform_controls(
            "/head",
            scale=0.35 * self._span,
            wxyz=_quaternions(rotation)[0],
            position=away,
            depth_test=False,
        )
        cone = _head(1.5 * HEAD * self._span)
        self._mesh("/head/cone", cone, (240, 170, 0))
        self.seconds = 0.0
        newest = [0]

        @self.head.on_update
        def _(_: Any) -> None:
            newest[0] += 1
            number = newest[0]
            with self._lock:
                if number == newest[0]:  # older places are skipped while one is drawn
                    self._follow()

        self._follow()

    def _follow(self) -> None:
        """Predict the spectrogram of the free head, by the field alone."""
        began = time.monotonic()
        place = np.asarray(self.head.position, dtype=np.float64)
        turn = trimesh.transformations.quaternion_matrix(self.head.wxyz)[:3, :3]
        level, ranges, frequencies = self._rendered(Poses(place[None], turn[None]))
        self._live_image.image = quick_image({"predicted": level}, ranges, frequencies)
        self.seconds = time.monotonic() - began
        x, y, z = 1e3 * place
        self._live_text.content = (
            f"Head at ({x:.0f}, {y:.0f}, {z:.0f}) mm; predicted by the field alone."
        )

    def _rendered(self, poses: Poses, *, all_ranges: bool = False) -> tuple[Floats, Floats, Floats]:
        """Return decibels (E, R, F) of one pose, and the rendered ranges and frequencies."""
        model = self._model
        assert model is not None
        renderer = model.renderer
        ranges, frequency = renderer.range.double(), renderer.frequency.double()
        rows, bins = torch.arange(len(ranges)), torch.arange(len(frequency))
        if not all_ranges:  # only where the region can be heard
            lower, upper = model.field.region.double().numpy()
            corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
            far = np.linalg.norm(corners - poses.positions[0], axis=1).max()
            near = np.linalg.norm(poses.positions[0].clip(lower, upper) - poses.positions[0])
            margin = 2.0 * model.field.resolution
            within = (ranges >= near - margin) & (ranges <= far + margin)
            rows = rows[within] if within.any() else rows[:2]
            # Fewer frequencies are enough to look at while a head is dragged.
            bins = bins[:: -(-len(bins) // LIVE_BINS)]
        batch = RangeSlices(
            torch.zeros(1, dtype=torch.int64),
            torch.as_tensor(poses.positions).float(),
            torch.as_tensor(poses.rotations).float(),
            rows[None],
            bins,
            torch.zeros(1, 0, len(rows), len(bins)),
        )
        with torch.inference_mode():
            level = decibels(model(batch), model.reference)[0].double().numpy()
        return level, ranges[rows].numpy(), frequency[bins].numpy()

    # Surfaces.

    def show_surface(self, views: SurfaceViews) -> None:
        """Show a surface, coloured by its distance from the truth or its error, and the truth."""
        parts = views.meshes()
        options = {name: mesh for name, mesh in parts.items() if name != "truth"}
        chooser = self._chooser
        if chooser is None:
            with self._choices:
                chooser = self._chooser = self.server.gui.add_dropdown("colours", list(options))
        else:
            chooser.options = list(options)

        def draw(_: Any = None) -> None:
            handle = self.server.scene.add_mesh_trimesh(
                "/surface", options[chooser.value], cast_shadow=False, receive_shadow=False
            )
            self._toggle("surface", handle)

        chooser.on_update(draw)
        draw()
        if "truth" in parts:
            truth = self._mesh("/truth", parts["truth"], _bytes(STEEL), opacity=0.5)
            self._toggle("truth", truth, on=False)

    def show_preview(self, mesh: trimesh.Trimesh) -> None:
        """Show the mesh of an epoch of a running fit."""
        self._toggle("surface", self._mesh("/surface", mesh, _bytes(CLAY)))

    def show_volume(self, volume: Volume) -> None:
        """Show the reflectivity above a level that a slider moves."""
        with self._choices:
            slider = self.server.gui.add_slider(
                "volume level, dB", -DEEPEST, -1.0, 1.0, -12.0, hint="above the volume's maximum"
            )

        def draw() -> None:
            level = float(volume.values.max()) * 10 ** (slider.value / 10)
            try:
                mesh = isosurface(volume, level)
            except NumericalError:
                return  # nothing lies between this level and the maximum
            handle = self._mesh("/volume", mesh, (110, 60, 140), opacity=0.5)
            self._toggle("volume", handle, on=False)

        @slider.on_update
        def _(_: Any) -> None:
            draw()

        draw()

    def _mesh(
        self, name: str, mesh: trimesh.Trimesh, colour: Any, opacity: float | None = None
    ) -> Any:
        return self.server.scene.add_mesh_simple(
            name,
            np.asarray(mesh.vertices, dtype=np.float32),
            np.asarray(mesh.faces, dtype=np.uint32),
            color=colour,
            opacity=opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )


def _head(length: float) -> trimesh.Trimesh:
    """Return a small head: a cone that points along x, with its tip forward."""
    cone = trimesh.creation.cone(radius=0.35 * length, height=length, sections=12)
    cone.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    return cone


def _quaternions(rotations: Floats) -> Floats:
    """Return quaternions (P, 4), real part first, of rotation matrices (P, 3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotations).as_quat().T
    return np.stack([w, x, y, z], axis=1)


def _bytes(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


def _blank() -> np.ndarray[Any, Any]:
    return np.full((2, 2, 3), 255, np.uint8)
