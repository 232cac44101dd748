# SPDX-License-Identifier: MIT


import numpy as np
import pytest

from sononerf.errors import NumericalError
from sononerf.geometry.lattice import (
    Volume,
    automatic_level,
    grid_over,
    isosurface,
    volume_from_function,
    vti_bytes,
)

LOWER, UPPER = (-0.02, 0.0, 0.01), (0.03, 0.011, 0.02)


def test_grid_covers_the_box_and_is_centred_on_it():
    grid = grid_over(LOWER, UPPER, 0.002)
    assert (grid.origin <= np.asarray(LOWER) + 1e-12).all()
    assert (grid.upper >= np.asarray(UPPER) - 1e-12).all()
    assert (np.asarray(LOWER) - grid.origin < 0.001 + 1e-12).all()
    np.testing.assert_allclose((grid.origin + grid.upper) / 2, np.add(LOWER, UPPER) / 2)
    assert grid.shape == (26, 7, 6)


def test_chunks_leave_no_seam_and_report_progress():
    seen = []

    def wavy(points):
        return np.sin(1e3 * points).sum(axis=1)

    whole = volume_from_function(wavy, LOWER, UPPER, 0.002)
    pieces = volume_from_function(
        wavy, LOWER, UPPER, 0.002, chunk=97, progress=lambda done, total: seen.append((done, total))
    )
    np.testing.assert_array_equal(whole.values, pieces.values)
    assert seen[0] == (97, 26 * 7 * 6)
    assert seen[-1] == (26 * 7 * 6, 26 * 7 * 6)


def test_a_field_that_is_not_finite_is_named_with_its_place():
    def broken(points):
        return np.where(points[:, 0] > 0.028, np.nan, 1.0)

    with pytest.raises(NumericalError, match=r"not finite at \[0\.03"):
        volume_from_function(broken, LOWER, UPPER, 0.002)


def test_vti_opens_in_vtk_with_the_same_values_in_the_same_place(tmp_path):
    import pyvista

    generator = np.random.default_rng(0)
    volume = Volume(generator.random((3, 4, 5)), np.array([0.1, -0.2, 0.3]), 0.004)
    path = tmp_path / "volume.vti"
    path.write_bytes(vti_bytes(volume))
    image = pyvista.read(path)
    np.testing.assert_allclose(image.points[1], [0.104, -0.2, 0.3])
    values = np.asarray(image["reflectivity"])
    np.testing.assert_allclose(values, volume.values.ravel(order="F"), rtol=1e-6)
    assert vti_bytes(volume) == path.read_bytes()


RADIUS = 0.015
CENTRE = np.array([0.1, -0.2, 0.05])


def ball(spacing=0.001, reach=0.02):
    return volume_from_function(
        lambda x: RADIUS - np.linalg.norm(x - CENTRE, axis=1),
        CENTRE - reach,
        CENTRE + reach,
        spacing,
    )


def test_a_ball_has_its_radius_area_volume_and_place():
    mesh = isosurface(ball(), 0.0)
    radii = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    # The error of linear interpolation is spacing² / (8 radius).
    np.testing.assert_allclose(radii, RADIUS, atol=1e-5)
    assert mesh.area == pytest.approx(4 * np.pi * RADIUS**2, rel=5e-3)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=5e-3)
    assert mesh.is_watertight


def test_normals_point_outward():
    mesh = isosurface(ball(), 0.0)
    outward = np.einsum("ti,ti->t", mesh.face_normals, mesh.triangles_center - CENTRE)
    assert (outward > 0).all()


def test_a_body_cut_by_the_border_is_closed_there():
    mesh = isosurface(ball(reach=0.01), 0.0)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert np.ptp(mesh.vertices, axis=0).max() < 0.024


def test_a_level_equal_to_voxels_gives_no_triangle_without_area():
    values = np.zeros((5, 5, 5))
    values[1:4, 1:4, 1:4] = 0.5
    values[2, 2, 2] = 1.0
    mesh = isosurface(Volume(values, np.zeros(3), 1.0), 0.5)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert (mesh.area_faces > 0).all()


@pytest.mark.parametrize("level", [-1.0, 1.0, np.nan])
def test_a_level_outside_the_values_is_named_with_their_range(level):
    with pytest.raises(NumericalError, match=r"level .*values run from -0\.0\d+ to 0\.01\d*"):
        isosurface(ball(0.002), level)


def test_a_constant_volume_has_no_surface_and_no_level():
    volume = grid_over((0, 0, 0), (1, 1, 1), 0.25)
    with pytest.raises(NumericalError, match="no surface at level 0"):
        isosurface(volume, 0.0)
    with pytest.raises(NumericalError, match="no level"):
        automatic_level(volume)


def test_values_that_are_not_finite_are_refused():
    volume = ball(0.002)
    volume.values[0, 0, 0] = np.nan
    with pytest.raises(NumericalError, match="1 of"):
        isosurface(volume, 0.0)
    with pytest.raises(NumericalError, match="1 of"):
        automatic_level(volume)


def test_the_automatic_level_parts_air_from_body_at_any_scale():
    generator = np.random.default_rng(0)
    volume = ball(0.002)
    values = np.where(volume.values > 0, 0.8, 0.1) + 0.05 * generator.random(volume.shape)
    level = automatic_level(volume.with_values(values))
    assert 0.15 < level < 0.8
    assert automatic_level(volume.with_values(1e-9 * values)) == pytest.approx(1e-9 * level)
