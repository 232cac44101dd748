# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import torch

from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field
from sononerf.field.fields import GridField
from sononerf.field.read_out import energy_volume, read_isosurface
from sononerf.start.surface import Surface

FREQUENCY = torch.tensor([30e3, 50e3, 70e3])
RADIUS, SPACING = 0.015, 0.003
MIDDLE = torch.tensor([0.1, -0.05, 0.02])
REGION = torch.stack((MIDDLE - 0.0303, MIDDLE + 0.0303))


def lobes_on_a_sphere(radius=RADIUS, region=REGION):
    """A grid whose lobes stand on a sphere, blurred by 2 mm as a fit blurs them."""
    field = GridField(region, FREQUENCY, spacing=SPACING, levels=1)
    values = field.grids[0]
    axes = [region[0, a] + SPACING * torch.arange(values.shape[4 - a]) for a in range(3)]
    offset = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1) - MIDDLE
    distance = offset.norm(dim=-1)
    with torch.no_grad():
        # Half of the logarithm of the energy: values are log pressure.
        values[0, 0] = (-0.25 * ((distance - radius) / 0.002) ** 2).permute(2, 1, 0)
        values[0, 1:4] = (10 * offset / distance.clamp_min(1e-9)[..., None]).permute(3, 2, 1, 0)
    return field


class Blob(Field):
    """No lobes: 1 / (1 + exp((d - radius) / width)) around a place, alike in all directions."""

    def __init__(self, region=REGION, level=1.0):
        super().__init__(region, FREQUENCY)
        self.level = level

    @property
    def resolution(self):
        return 0.004

    def forward(self, positions, directions):
        distance = (positions - MIDDLE).norm(dim=-1)
        value = self.level * torch.sigmoid((RADIUS - distance) / 0.001) * self.inside(positions)
        return value[..., None].expand(*positions.shape[:-1], 3)


def radii(mesh):
    return np.linalg.norm(mesh.triangles_center - MIDDLE.numpy(), axis=1)


def cut(field, **options):
    """Return the iso-surface of a field."""
    mesh, volume, level = read_isosurface(field, **options)
    return Surface(mesh, volume, "isosurface", level=level)


def test_the_volume_holds_the_energy_where_it_is():
    field = lobes_on_a_sphere()
    volume = energy_volume(field, None, 100)
    for spare in (REGION[0].numpy() - volume.origin, volume.upper - REGION[1].numpy()):
        assert (spare > -1e-6).all()
        assert (spare < SPACING / 2).all()
    points = volume.points()
    loud = points[np.argsort(volume.values.ravel())[-500:]]
    distance = np.linalg.norm(loud - MIDDLE.numpy(), axis=1)
    np.testing.assert_allclose(distance, RADIUS, atol=0.0015)
    places = torch.as_tensor(points[::997], dtype=torch.float32)
    expected = field.energy(places, 100)
    np.testing.assert_allclose(volume.values.ravel()[::997], expected, rtol=1e-4)
    assert volume.spacing == pytest.approx(SPACING / 2)


def test_a_field_without_lobes_is_read_at_a_level():
    found = cut(Blob(), spacing=0.0025, directions=8)
    # Magnitudes of 8 directions and 3 frequencies, summed.
    assert found.volume.values.max() == pytest.approx(24, rel=1e-3)
    # The automatic level lies somewhere on the slope, which is 1 mm wide.
    assert np.average(radii(found.mesh)) == pytest.approx(RADIUS, abs=0.001)
    half = cut(Blob(), spacing=0.0025, directions=8, level=12.0)
    assert half.level == 12.0
    # Linear interpolation between voxels across a steep slope.
    np.testing.assert_allclose(radii(half.mesh), RADIUS, atol=0.0003)
    assert half.mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
    low = cut(Blob(), spacing=0.0025, directions=8, level=1.0)
    assert low.mesh.volume > half.mesh.volume


@pytest.mark.parametrize(
    ("smoothing", "width"),
    [(0.0025, 1), (0.0075, 3), (0.009, 3), (0.0125, 5), (0.045, 19)],  # of voxels of 2.5 mm
)
def test_a_box_may_be_averaged_over_before_the_surface_is_drawn(smoothing, width):
    options = {"spacing": 0.0025, "directions": 2}
    plain = cut(Blob(), **options).volume.values
    smooth = cut(Blob(), smoothing=smoothing, **options).volume.values
    # Beyond the grid its outermost values go on, as in MATLAB's smooth3.
    half = width // 2
    padded = np.pad(np.asarray(plain, dtype=np.float64), half, mode="edge")
    for i, j, k in ((0, 0, 0), (10, 12, 9), (18, 12, 12)):
        box = padded[i : i + width, j : j + width, k : k + width]
        assert smooth[i, j, k] == pytest.approx(box.mean(), rel=1e-4, abs=1e-6)


def test_finer_voxels_come_nearer():
    errors = []
    for spacing in (0.006, 0.003, 0.0015):
        mesh = cut(Blob(), spacing=spacing, directions=2, level=3.0).mesh
        errors.append(np.abs(radii(mesh) - RADIUS).mean())
    assert errors[0] > errors[1] > errors[2]


def test_an_isosurface_of_lobes_is_a_shell():
    found = cut(lobes_on_a_sphere(), directions=30)
    # A shell: its outer side lies outside of the sphere, its inner side is a cavity.
    assert radii(found.mesh).min() < RADIUS - 0.0005 < RADIUS + 0.0005 < radii(found.mesh).max()


def test_what_is_not_kept_has_no_surface():
    field = lobes_on_a_sphere()
    vertices = field.region[0] + SPACING * torch.cartesian_prod(*[torch.arange(21)] * 3)
    distance = (vertices - MIDDLE).norm(dim=1)
    field.keep(vertices[(distance - RADIUS).abs() < 0.004], SPACING)
    volume = energy_volume(field, SPACING / 2, 100)
    outside = np.linalg.norm(volume.points() - MIDDLE.numpy(), axis=1) > RADIUS + 0.008
    assert volume.values.ravel()[outside].max() == 0


def test_a_silent_field_is_an_error():
    for field in (Blob(level=0.0), lobes_on_a_sphere()):
        if isinstance(field, GridField):
            field.occupancy.zero_()
        with pytest.raises(NumericalError, match="silent everywhere"):
            cut(field, directions=4)


def test_a_spacing_larger_than_the_region_is_said_to_be_so():
    region = torch.tensor([[-0.02] * 3, [0.02] * 3])
    field = GridField(region, torch.tensor([20e3, 40e3]), spacing=0.01, levels=1)
    with pytest.raises(SettingsError, match="larger than the region"):
        cut(field, spacing=2.0)
