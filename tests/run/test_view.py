# SPDX-License-Identifier: MIT
"""A run or a store in the browser."""

from __future__ import annotations

import io
import re
import shutil
import signal
import subprocess
import sys
import time
import wave
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.geometry.lattice import Volume, vti_bytes
from sononerf.report.page import RATE, STRETCH, echo_wav
from sononerf.run.export import View
from sononerf.run.run import Run
from sononerf.start.surface import mesh_bytes
from tests.browser import CHROMIUM, browser


def given_a_surface(run):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.021)
    place = run / "reconstruction"
    place.mkdir(exist_ok=True)
    data = mesh_bytes(mesh, "ply", confidence=np.arange(len(mesh.vertices)))
    (place / "mesh.ply").write_bytes(data)
    (place / "read_out.json").write_text('{"method": "levels", "refined": false}')
    axis = np.linspace(-0.03, 0.03, 21)
    off = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis)), axis=0)
    volume = Volume(np.exp(-0.5 * ((off - 0.02) / 0.004) ** 2), np.full(3, -0.03), 0.003)
    (place / "volume.vti").write_bytes(vti_bytes(volume))


@pytest.fixture
def run(fitted_run, tmp_path):
    return shutil.copytree(fitted_run, tmp_path / "leaf-7")


@pytest.fixture
def shown():
    """Open views that are closed at the end."""
    views = []

    def show(path):
        views.append(View(path, port=8300))
        return views[-1]

    yield show
    for view in views:
        view.viewer.close()


def texts(view):
    return view.viewer._pose_text.content, view.viewer._live_text.content


def test_a_pose_shows_what_it_measured_and_what_is_predicted(run, shown):
    view = shown(run)
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", view.viewer.url)
    blank = view.viewer._pose_image.image.shape
    view.viewer.choose(11)
    pose, live = texts(view)
    assert re.fullmatch(
        r"Pose 11, test; predicted by field and traced echoes: [\d.]+ dB, all cells\.", pose
    )
    assert view.viewer._pose_image.image.shape != blank
    assert "data:audio/wav;base64," in view.viewer._pose_sound.content
    assert re.fullmatch(r"Head at \(-?\d+, -?\d+, -?\d+\) mm; predicted by the field alone\.", live)


def test_a_store_is_shown_without_a_run(run, shown):
    view = shown(Run(run).echoes.store.path)
    view.viewer.choose(0)
    assert view.viewer._pose_text.content == "Pose 0, training."


def test_a_run_that_grows_is_followed(run, shown):
    description = (run / "model.json").rename(run / "later.json")
    shutil.rmtree(run / "epochs", ignore_errors=True)
    view = shown(run)
    assert "surface" not in view.viewer._boxes
    place = run / "epochs" / "0001"
    place.mkdir(parents=True)
    mesh = trimesh.creation.icosphere(radius=0.02)
    (place / "mesh.ply").write_bytes(mesh_bytes(mesh, "ply"))
    view.refresh()
    assert "epoch 1; the fit goes on" in view.viewer._status.content
    assert "surface" in view.viewer._boxes
    shutil.copytree(place, place.with_name("0002"))
    view.refresh()
    assert "epoch 2; the fit goes on" in view.viewer._status.content
    description.rename(run / "model.json")
    given_a_surface(run)
    view.refresh()
    assert "surface found as levels" in view.viewer._status.content
    assert {"surface", "truth", "volume", "poses"} <= view.viewer._boxes.keys()


def test_a_port_in_use_is_left_to_the_other_and_the_url_says_which_is_taken(run, shown):
    one, two = shown(run), shown(run)
    assert one.viewer.url != two.viewer.url
    with urlopen(two.viewer.url) as page:
        assert b"<html" in page.read().lower()


@pytest.mark.slow
def test_ctrl_c_ends_it_without_a_word(run, tmp_path):
    command = [sys.executable, "-m", "sononerf.cli", "view", str(run), "--port", "8400"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    line = process.stderr.readline()
    assert re.fullmatch(r"open http://127\.0\.0\.1:\d+; Ctrl-C ends it\n", line)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20) == ("", "")
    assert process.returncode == 0


def test_what_is_neither_run_nor_store_is_refused(tmp_path):
    with pytest.raises(InputError, match="neither a run nor a store"):
        View(tmp_path)


@pytest.mark.slow
def test_without_the_extra_one_line_says_what_to_install(run, tmp_path):
    (tmp_path / "viser.py").write_text("raise ImportError('not here')")
    command = [sys.executable, "-m", "sononerf.cli", "view", str(run)]
    done = subprocess.run(
        command, env={"PYTHONPATH": f"{tmp_path}:."}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 6
    assert done.stderr == (
        "error: the viewer needs viser: python -m pip install 'sononerf[view]'\n"
    )


def test_an_echo_is_heard_ten_times_longer_and_lower():
    ranges, frequencies = 0.3 + 0.001 * np.arange(200), np.array([30e3, 50e3])
    magnitude = np.zeros((2, 200, 2))
    magnitude[0, 60:140, 1] = 1.0  # the left ear alone, at 50 kHz
    with wave.open(io.BytesIO(echo_wav(magnitude, ranges, frequencies, 343.0))) as file:
        assert (file.getnchannels(), file.getframerate()) == (2, RATE)
        samples = np.frombuffer(file.readframes(file.getnframes()), "<i2").reshape(-1, 2)
    assert not samples[:, 1].any()
    sounds = np.flatnonzero(samples[:, 0])
    seconds = (sounds[-1] - sounds[0]) / RATE
    assert seconds == pytest.approx(STRETCH * 2 * 0.08 / 343.0, rel=0.05)
    spectrum = np.abs(np.fft.rfft(samples[:, 0]))
    loudest = np.fft.rfftfreq(len(samples), 1 / RATE)[spectrum.argmax()]
    assert loudest == pytest.approx(5e3, abs=200)


def place_of(view, point, size):
    """Where a point (3,), m, is in the window of the only browser, pixels."""
    (client,) = view.viewer.server.get_clients().values()
    camera = client.camera
    turn = trimesh.transformations.quaternion_matrix(camera.wxyz)[:3, :3]
    x, y, z = turn.T @ (np.asarray(point) - camera.position)  # right, down, ahead
    scale = size[1] / 2 / np.tan(camera.fov / 2) / z
    return size[0] / 2 + scale * x, size[1] / 2 + scale * y


@pytest.mark.slow  # a browser
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
def test_a_click_shows_a_pose_and_a_drag_moves_the_head(run, shown, tmp_path):
    given_a_surface(run)
    view = shown(run)
    size = (1400, 900)
    with browser(tmp_path) as page:
        page.size(*size)
        page.open(view.viewer.url)
        page.until("document.querySelectorAll('canvas').length > 0")
        page.until("document.body.innerText.includes('Free head')")
        time.sleep(5)
        positions = view.run.echoes.positions
        (client,) = view.viewer.server.get_clients().values()
        order = np.argsort(np.linalg.norm(positions - client.camera.position, axis=1))
        places = {int(n): place_of(view, positions[n], size) for n in order}
        seen = {n: p for n, p in places.items() if 0 < p[0] < 900 and 0 < p[1] < size[1]}
        assert seen
        for place in seen.values():
            page.click(*place)
            time.sleep(0.5)
            if view.viewer.pose is not None:
                break
        assert view.viewer.pose in seen
        page.until(f"document.body.innerText.includes('Pose {view.viewer.pose}, ')")
        before = np.array(view.viewer.head.position)
        turn = trimesh.transformations.quaternion_matrix(view.viewer.head.wxyz)[:3, :3]
        arrow = view.viewer._span * turn[:, 2]  # the one that points up
        page.drag(
            place_of(view, before + 0.3 * arrow, size), place_of(view, before + 0.5 * arrow, size)
        )
        time.sleep(1)
        moved = np.array(view.viewer.head.position) - before
        assert moved @ arrow / np.linalg.norm(arrow) > 0.05 * view.viewer._span
        assert view.viewer.seconds < 0.2
        x, y, z = 1e3 * view.viewer.head.position
        page.until(f"document.body.innerText.includes('({x:.0f}, {y:.0f}, {z:.0f}) mm')")
        picture = page.picture()
        assert picture.startswith(b"\x89PNG")
        assert not page.faults
        assert not page.outside()
