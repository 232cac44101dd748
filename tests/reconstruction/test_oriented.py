# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import NumericalError, ResourceError
from sononerf.reconstruction import volume as volume_module
from sononerf.reconstruction.oriented import oriented_surface
from sononerf.reconstruction.parts import split_parts
from sononerf.reconstruction.volume import grid_over

RADIUS, LATTICE, SPACING = 0.015, 0.004, 0.0025
L_SHAPE = RADIUS * np.array([[0, 2.49, 2.45], [0, 2.47, -0.83], [0, -1.80, -0.83]])


def blurred_cloud(centres, *, range_db=20.0, noise=0.02, blur=0.002, seed=0):
    """Points of a lattice around spheres, as a fitted field gives them.

    Energies fall off as a Gaussian of the distance from the surface, vary by ``range_db`` from
    place to place and by chance; a share ``noise`` of all points has energy and normal by chance.
    """
    generator = np.random.default_rng(seed)
    lower, upper = centres.min(axis=0) - RADIUS - 0.02, centres.max(axis=0) + RADIUS + 0.02
    axes = [np.arange(a, b, LATTICE) for a, b in zip(lower, upper, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = points[:, None] - centres
    distances = np.linalg.norm(offsets, axis=-1)
    nearest = distances.argmin(axis=1), np.arange(len(points))
    gap = distances[nearest[::-1]]
    normals = offsets[nearest[::-1]] / np.maximum(gap, 1e-9)[:, None]
    gap = gap - RADIUS
    energies = np.where(np.abs(gap) < 3 * blur, np.exp(-0.5 * (gap / blur) ** 2), 0)
    waves = np.sin(points @ generator.normal(size=(3, 6)) * 60 + generator.random(6)).sum(axis=1)
    place = (waves - waves.min()) / np.ptp(waves)
    energies *= 10 ** (range_db / 10 * (place - 1)) * np.exp(generator.normal(size=len(points)) / 2)
    normals += 0.15 * generator.normal(size=normals.shape)
    wrong = generator.random(len(points)) < noise
    energies[wrong] += 10 ** -generator.uniform(0.5, 3, wrong.sum())
    normals[wrong] = generator.normal(size=(wrong.sum(), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, energies, normals, lower, upper


def distance_to_spheres(points, centres):
    return np.linalg.norm(points[:, None] - centres, axis=-1).min(axis=1) - RADIUS


def test_clean_points_on_a_sphere_give_the_sphere():
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh, indicator, level = oriented_surface(
        RADIUS * normals, np.ones(4000), normals, [-0.02] * 3, [0.02] * 3, 0.001
    )
    radii = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(radii, RADIUS, atol=3e-4)
    assert abs(radii.mean() - RADIUS) < 1e-4
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert level == pytest.approx(0.5, abs=0.05)
    middle = indicator.values[tuple(n // 2 for n in indicator.shape)]
    assert middle == pytest.approx(1, abs=0.1)
    assert indicator.values[0, 0, 0] == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_three_blurred_uneven_spheres_are_found_unswollen(noise):
    points, energies, normals, lower, upper = blurred_cloud(L_SHAPE, noise=noise)
    mesh, _, _ = oriented_surface(points, energies, normals, lower, upper, SPACING)
    distance = distance_to_spheres(mesh.triangles_center, L_SHAPE)
    assert len(split_parts(mesh)) == 3
    assert np.average(np.abs(distance), weights=mesh.area_faces) < 0.8e-3
    # A shell of Gaussian blur σ holds more volume outside: its mean lies 2 σ² / r = 0.5 mm out.
    assert np.average(distance, weights=mesh.area_faces) == pytest.approx(0.5e-3, abs=0.3e-3)


@pytest.mark.parametrize(("gap", "parts"), [(0.008, 2), (0.003, None), (0.0, None)])
def test_neighbours_stay_round_and_part_where_the_lattice_allows(gap, parts):
    half = RADIUS + gap / 2
    centres = np.array([[0, -half, 0], [0, half, 0]])
    points, energies, normals, lower, upper = blurred_cloud(centres, noise=0.0)
    mesh, _, _ = oriented_surface(points, energies, normals, lower, upper, SPACING)
    distance = np.abs(distance_to_spheres(mesh.triangles_center, centres))
    assert np.average(distance, weights=mesh.area_faces) < 0.8e-3
    if parts is not None:
        assert len(split_parts(mesh)) == parts
    # Where they merge, the neck is thinner than the spheres.
    neck = mesh.vertices[np.abs(mesh.vertices[:, 1]) < 0.0015]
    assert len(neck) == 0 or np.linalg.norm(neck[:, [0, 2]], axis=1).max() < 0.8 * RADIUS


def test_faint_parts_come_out_as_large_as_loud_ones():
    points, energies, normals, lower, upper = blurred_cloud(L_SHAPE, range_db=0, noise=0)
    faint = np.linalg.norm(points - L_SHAPE[2], axis=1) < 1.5 * RADIUS
    mesh, _, _ = oriented_surface(
        points, np.where(faint, 0.1, 1.0) * energies, normals, lower, upper, SPACING
    )
    volumes = sorted(part.volume for part in split_parts(mesh))
    assert len(volumes) == 3
    assert volumes[0] / volumes[-1] == pytest.approx(1, abs=0.15)


def test_ghosts_are_no_parts():
    points, energies, normals, lower, upper = blurred_cloud(L_SHAPE, range_db=0, noise=0)
    ghost = np.linalg.norm(points - L_SHAPE[2], axis=1) < 1.5 * RADIUS
    mesh, _, _ = oriented_surface(
        points, np.where(ghost, 0.002, 1.0) * energies, normals, lower, upper, SPACING
    )
    assert len(split_parts(mesh)) == 2


def on_a_sphere(count=4000):
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return RADIUS * normals, np.ones(count), normals, np.full(3, -0.02), np.full(3, 0.02), 0.001


def test_the_surface_stays_within_its_bound():
    """A plane cuts the sphere, and what lies behind it is as it was."""
    surface = on_a_sphere()
    plain, _, level = oriented_surface(*surface)
    at = 0.4 * RADIUS
    x = grid_over(*surface[3:]).points()[:, 0]
    bound = (at - x).reshape(grid_over(*surface[3:]).shape)
    mesh, indicator, used = oriented_surface(*surface, bound=bound)
    assert used == level
    assert mesh.is_watertight
    assert (indicator.values[bound < 0] < used).all()
    assert mesh.vertices[:, 0].max() == pytest.approx(at, abs=1e-5)
    # The cut is a disc, but for its rim, which is rounded by a voxel.
    disc = mesh.area_faces[mesh.face_normals[:, 0] > 0.99].sum()
    assert disc == pytest.approx(np.pi * (RADIUS**2 - at**2), rel=0.1)
    behind = mesh.vertices[mesh.vertices[:, 0] < at - 0.004]
    before = plain.vertices[plain.vertices[:, 0] < at - 0.004]
    np.testing.assert_allclose(np.sort(behind, axis=0), np.sort(before, axis=0), atol=1e-6)


@pytest.mark.parametrize("off", [-0.001, 0.0, 0.02])
def test_a_bound_along_the_surface_moves_it_no_farther(off):
    """On either side of both the steeper counts, so they must be equally steep where they meet."""
    surface = on_a_sphere()
    grid = grid_over(*surface[3:])
    depth = RADIUS + off - np.linalg.norm(grid.points(), axis=1)
    mesh, _, _ = oriented_surface(*surface, bound=depth.reshape(grid.shape))
    radii = np.linalg.norm(mesh.vertices, axis=1)
    # Straight lines between voxels of 1 mm on spheres of 15 mm lie 0.5² / 30 mm within at most.
    assert radii.mean() == pytest.approx(RADIUS + min(off, 0.0), abs=1e-5)
    assert radii.max() < RADIUS + max(min(off, 0.0), -0.001) + 3e-4


def test_half_a_sphere_is_closed():
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 0] > 0]
    mesh, _, _ = oriented_surface(
        RADIUS * normals, np.ones(len(normals)), normals, [-0.03] * 3, [0.03] * 3, 0.002
    )
    assert mesh.is_watertight
    assert 0.4 < mesh.volume / (4 / 3 * np.pi * RADIUS**3) < 1


def test_a_greater_level_gives_a_thinner_body_and_energies_only_count_by_ratio():
    points, energies, normals, lower, upper = blurred_cloud(L_SHAPE, noise=0)
    surface = [points, energies, normals, lower, upper, SPACING]
    plain, _, level = oriented_surface(*surface)
    thin, _, used = oriented_surface(*surface, level=0.65)
    assert used == 0.65
    assert thin.volume < plain.volume
    surface[1] = 1e-12 * energies
    scaled, _, scaled_level = oriented_surface(*surface)
    assert scaled_level == pytest.approx(level, rel=1e-4)
    assert scaled.volume == pytest.approx(plain.volume, rel=1e-3)


def test_turning_the_axes_turns_the_surface():
    points, energies, normals, lower, upper = blurred_cloud(L_SHAPE, noise=0)
    mesh, _, _ = oriented_surface(points, energies, normals, lower, upper, SPACING)
    turned, _, _ = oriented_surface(
        points[:, [1, 2, 0]],
        energies,
        normals[:, [1, 2, 0]],
        lower[[1, 2, 0]],
        upper[[1, 2, 0]],
        SPACING,
    )
    np.testing.assert_allclose(turned.centroid, mesh.centroid[[1, 2, 0]], atol=1e-5)
    assert turned.volume == pytest.approx(mesh.volume, rel=1e-3)


def test_what_has_no_surface_is_an_error():
    box = [-0.02] * 3, [0.02] * 3, 0.002
    sphere = np.random.default_rng(0).normal(size=(500, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    with pytest.raises(NumericalError, match="none of 500 points"):
        oriented_surface(RADIUS * sphere, np.zeros(500), sphere, *box)
    with pytest.raises(NumericalError, match="none of 500 points"):
        oriented_surface(RADIUS * sphere + 1, np.ones(500), sphere, *box)
    with pytest.raises(NumericalError, match="point inward"):
        oriented_surface(RADIUS * sphere, np.ones(500), -sphere, *box)
    with pytest.raises(NumericalError, match="no surface at level 9"):
        oriented_surface(RADIUS * sphere, np.ones(500), sphere, *box, level=9.0)
    with pytest.raises(NumericalError, match="normals hold values"):
        oriented_surface(RADIUS * sphere, np.ones(500), np.full((500, 3), np.nan), *box)


def test_wrong_input_is_refused(monkeypatch):
    box = [-0.02] * 3, [0.02] * 3, 0.002
    one = np.array([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"expected \(N, 3\)"):
        oriented_surface(one, np.ones(2), one, *box)
    with pytest.raises(ValueError, match="zero or more"):
        oriented_surface(one, -np.ones(1), one, *box)
    with pytest.raises(ValueError, match="smoothing"):
        oriented_surface(one, np.ones(1), one, *box, smoothing=0)
    monkeypatch.setattr(volume_module, "available_memory", lambda: 100_000)
    with pytest.raises(ResourceError, match="finest spacing"):
        oriented_surface(one, np.ones(1), one, *box)
