# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import torch

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field, sphere_directions
from sononerf.field.fields import GridField
from sononerf.start.read_out import energy_volume, read_field, read_isosurface, start_surfaces
from sononerf.start.surface import Surface, finished_surface

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


class Sounding(GridField):
    """Wherever its places lie, it sounds from the sphere, as what has been fitted does."""

    def echo(self, positions, directions, bins, place=None):
        assert place is None
        towards = ((positions - MIDDLE) * directions).sum(-1)
        return self.select(positions, directions, bins), RADIUS - towards


def sounding(radius):
    field = Sounding(REGION, FREQUENCY, spacing=SPACING, levels=1)
    field.load_state_dict(lobes_on_a_sphere(radius).state_dict())
    return field


def sources_around(count=300, distance=0.4):
    return MIDDLE + distance * sphere_directions(count, MIDDLE)


def hull_of_the_sphere(count=300, radius=RADIUS):
    """What the first echoes of the sphere leave, called and heard from one place each."""
    sources = sources_around(count).double().numpy()
    ways = sources - MIDDLE.double().numpy()
    away = np.linalg.norm(ways, axis=1, keepdims=True)
    return EchoHull(sources, sources[:, None], away - radius, -ways / away)


def read(field, hull=None, method="filled", **options):
    """Read out at once, with the range resolution that fits the blur of the field."""
    hull = hull_of_the_sphere() if hull is None else hull
    reading = read_field(field, hull, **{"resolution": 0.005, **options})
    ((found, mesh),) = start_surfaces(reading, [method])
    return finished_surface(mesh, found, reading)


def cut(field, **options):
    """Return the iso-surface of a field."""
    mesh, volume, level = read_isosurface(field, **options)
    return Surface(mesh, volume, "isosurface", level=level)


@pytest.mark.parametrize("method", ["open", "filled", "hull"])
@pytest.mark.parametrize("spacing", [None, 0.0025])
def test_the_surface_of_the_occupancy_is_the_sphere_and_says_who_heard_it(method, spacing):
    found = read(sounding(0.012), method=method, spacing=spacing)
    assert (found.method, found.level) == (method, None)
    assert found.volume.spacing == pytest.approx(spacing or SPACING / 2)
    assert np.abs(radii(found.mesh) - RADIUS).mean() < 0.8e-3
    assert found.mesh.is_watertight
    assert found.openness.kind == "closed"
    assert found.confidence.shape == (len(found.mesh.vertices),)
    assert found.confidence.max() > 10


def test_where_the_field_is_silent_the_surface_lies_along_the_onsets():
    """No pose hears the back of the sphere from the field; the onsets close it."""
    field = sounding(RADIUS)
    with torch.no_grad():
        field.grids[0][0, 0, :, :, :13] = -20.0
    found = read(field)
    assert found.method == "filled"
    assert found.mesh.is_watertight
    silent = found.mesh.triangles_center[:, 0] < float(MIDDLE[0]) - 0.006
    assert np.abs(radii(found.mesh) - RADIUS)[silent].mean() < SPACING / 4
    back = found.mesh.vertices[:, 0] < float(MIDDLE[0]) - 0.9 * RADIUS
    front = found.mesh.vertices[:, 0] > float(MIDDLE[0]) + 0.9 * RADIUS
    assert found.confidence[back].max() == 0
    assert found.confidence[front].min() > 0


def test_the_hull_is_what_first_echoes_leave_whatever_the_field_says():
    hull = hull_of_the_sphere()
    found = read(sounding(0.012), method="hull")
    # Between 300 heads hull and sphere part by 0.2 mm; straight lines add to it.
    assert np.abs(radii(found.mesh) - RADIUS).max() < 0.0004
    assert np.abs(hull.clearance(found.mesh.vertices)[0]).max() < 0.0001
    mute = sounding(RADIUS)
    mute.occupancy.zero_()
    silent = read(mute, method="hull")
    np.testing.assert_array_equal(silent.mesh.vertices, found.mesh.vertices)
    assert silent.volume.values.max() == 0
    assert not silent.confidence.any()


def test_few_poses_leave_a_body_that_holds_the_true_one():
    found = read(sounding(RADIUS), hull_of_the_sphere(20))
    assert found.mesh.is_watertight
    # Between 20 heads, 0.8 rad apart, the hull rises by 0.5² / 2 of the radius.
    assert RADIUS - 0.001 < radii(found.mesh).min()
    assert radii(found.mesh).max() < 1.2 * RADIUS


def test_the_volume_holds_the_energy_where_it_is():
    field = lobes_on_a_sphere()
    volume = read(field).volume
    for spare in (REGION[0].numpy() - volume.origin, volume.upper - REGION[1].numpy()):
        assert (spare > -1e-6).all()
        assert (spare < SPACING / 2).all()
    points = volume.points()
    loud = points[np.argsort(volume.values.ravel())[-500:]]
    distance = np.linalg.norm(loud - MIDDLE.numpy(), axis=1)
    np.testing.assert_allclose(distance, RADIUS, atol=0.0015)
    places = torch.as_tensor(points[::997], dtype=torch.float32)
    expected = field.oriented(places, 100)[0]
    np.testing.assert_allclose(volume.values.ravel()[::997], expected, rtol=1e-4)
    alone = energy_volume(field, SPACING / 2, 100)
    np.testing.assert_array_equal(alone.values, volume.values)
    np.testing.assert_array_equal(alone.origin, volume.origin)


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
