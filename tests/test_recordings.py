# SPDX-License-Identifier: MIT
"""From recordings of another simulator to a mesh, as a new user types it."""

from __future__ import annotations

import re
from functools import partial

import numpy as np
import pytest
import trimesh

from tests.command import succeed
from tests.recordings.two_spheres import GAP, RADIUS, centres, write_folder


def spheres():
    """Return the true surface in the frame of the recordings, mm."""
    parts = [trimesh.creation.icosphere(4, RADIUS) for _ in range(2)]
    for part, centre in zip(parts, centres(), strict=True):
        part.apply_translation(centre)
    truth = trimesh.util.concatenate(parts)
    truth.apply_scale(1000.0)
    return truth


@pytest.mark.slow
def test_from_wav_and_csv_to_two_spheres(tmp_path):
    write_folder(tmp_path / "recordings")
    spheres().export(tmp_path / "truth.stl")
    (tmp_path / "fit.yaml").write_text(
        "data: {store: store}\nevaluation: {truth: truth.stl, unit: mm}\n"
    )

    run = partial(succeed, tmp_path)
    assert "no other convention" in run(
        "import", "recordings", "recordings", "--output", "store", "--dry-run"
    )
    run("import", "recordings", "recordings", "--output", "store")
    said = run("fit", "fit.yaml", "--output", "run")
    assert "mesh_original.ply" in said
    mesh = trimesh.load(tmp_path / "run/reconstruction/mesh_original.ply")
    parts = mesh.split()
    assert len(parts) == 2
    for centre in 1000.0 * centres():
        off = min(np.linalg.norm(part.bounds.mean(axis=0) - centre) for part in parts)
        assert off < 1.0
    away = np.linalg.norm(mesh.vertices[:, None] - 1000.0 * centres(), axis=2).min(axis=1)
    assert np.abs(away - 1000.0 * RADIUS).max() < 2.0
    fscore = float(re.search(r"F-score ([\d.]+) at 2 mm", said)[1])
    assert fscore >= 0.95
    gap = min(np.linalg.norm(a - b) for a in parts[0].vertices[::7] for b in parts[1].vertices[::7])
    assert gap == pytest.approx(1000.0 * GAP, abs=2.0)
    # The way back: poses as they are in the table of the recordings.
    rows = (tmp_path / "recordings/poses.csv").read_text().splitlines()[:3]
    (tmp_path / "my.csv").write_text("\n".join(row.split(",", 1)[1] for row in rows) + "\n")
    run("predict", "run", "--poses", "my.csv", "--output", "own")
    run("export", "run", "mesh.stl")
    exported = trimesh.load(tmp_path / "mesh.stl")
    np.testing.assert_allclose(exported.bounds, mesh.bounds, rtol=1e-4)
