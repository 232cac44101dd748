# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import torch

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError, SettingsError
from sononerf.field.field import Field, sphere_directions
from sononerf.field.grid import GridField
from sononerf.reconstruction import read_out
from sononerf.reconstruction.glints import Glints
from sononerf.reconstruction.read_out import reconstruct

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


def deaf(sources):
    """Known places of poses that heard no first echo."""
    count = len(sources)
    return EchoHull(sources, sources[:, None], np.full((count, 1), -np.inf), 0 * sources)


@pytest.mark.parametrize("off", [-0.0015, 0.0, 0.0008])
def test_the_surface_runs_where_the_field_sounds_from(off):
    field = sounding(RADIUS + off)
    found = reconstruct(field, hull=hull_of_the_sphere())
    assert found.method == "oriented"
    assert found.mesh.is_watertight
    assert sorted(found.glints.pose) == list(range(300))
    # What is heard lies 0.03 mm out, for the sources are near; drawing it costs a few hundredths.
    assert np.abs(radii(found.mesh) - RADIUS).max() < 0.0001
    without = reconstruct(field)
    assert without.glints is None
    # There the places count: half a millimetre outside of their middle, as they are blurred.
    mean = np.average(radii(without.mesh), weights=without.mesh.area_faces)
    assert mean == pytest.approx(RADIUS + off + 0.0005, abs=0.0001)
    np.testing.assert_array_equal(without.volume.values, found.volume.values)


def test_where_the_field_is_silent_the_surface_runs_along_the_hull():
    """The back of a sphere answers nobody: first echoes close it."""
    field = sounding(RADIUS)
    with torch.no_grad():
        field.grids[0][0, 0, :, :, :13] = -20.0
    hull = hull_of_the_sphere()
    found = reconstruct(field, hull=hull)
    # Lobes end 60 degrees off their axis, which is no more than 60 degrees off the x axis.
    assert found.glints.points[:, 0].min() > float(MIDDLE[0]) - 0.6 * RADIUS
    assert found.mesh.is_watertight
    # Between heads 82 mm apart, 3 mm as seen on the sphere, hull and sphere part by 1.8²/30 mm.
    assert np.abs(radii(found.mesh) - RADIUS).max() < 0.0006
    silent = found.mesh.triangles_center[:, 0] < float(MIDDLE[0]) - 0.004
    assert np.abs(radii(found.mesh) - RADIUS)[silent].mean() < 0.0003
    # Without the hull there is half a body.
    glints = reconstruct(field, hull=deaf(hull.sources))
    assert glints.mesh.volume < 0.8 * found.mesh.volume


def test_the_hull_is_what_first_echoes_leave_whatever_the_field_says():
    field = sounding(RADIUS)
    with torch.no_grad():
        field.grids[0][0, 0, :, :, :13] = -20.0
    hull = hull_of_the_sphere()
    found = reconstruct(field, hull=hull, method="hull")
    assert (found.method, found.level) == ("hull", 0.0)
    assert found.mesh.is_watertight
    # Between 300 heads hull and sphere part by 0.2 mm; straight lines add to it.
    assert np.abs(radii(found.mesh) - RADIUS).max() < 0.0004
    assert len(found.glints.points)  # for the confidence
    assert found.openness.kind == "closed"
    deeper = reconstruct(field, hull=hull, method="hull", level=0.002)
    assert np.abs(radii(deeper.mesh) - RADIUS + 0.002).max() < 0.0004
    with pytest.raises(SettingsError, match="method hull"):
        reconstruct(field, method="hull")


def test_a_surface_never_lies_before_a_first_echo():
    """A field that sounds from 1.5 mm too near: the hull has the last word."""
    field = sounding(RADIUS)
    near = RADIUS - 0.0015
    hull = hull_of_the_sphere(radius=near)
    found = reconstruct(field, hull=hull)
    # Marching cubes draws straight lines between voxels, 1.5 mm apart on a sphere of 13.5 mm:
    # 0.75² / 27 mm on either side.
    assert hull.clearance(found.mesh.vertices)[0].min() > -0.00005
    assert radii(reconstruct(field, hull=deaf(hull.sources)).mesh).mean() > RADIUS - 0.0002


def test_few_poses_leave_a_body_that_holds_the_true_one():
    """Twenty glints make no surface, but what twenty first echoes leave does."""
    hull = hull_of_the_sphere(20)
    found = reconstruct(sounding(RADIUS), hull=hull)
    assert found.mesh.is_watertight
    assert hull.clearance(found.mesh.vertices)[0].min() > -0.0001
    # Between 20 heads, 0.8 rad apart, the hull rises by 0.5² / 2 of the radius.
    assert RADIUS - 0.0005 < radii(found.mesh).min()
    assert radii(found.mesh).max() < 1.2 * RADIUS


def with_ghosts():
    """A sphere heard by 400 poses; 40 of them hear a second bounce 6 mm behind it as well."""
    outward = sphere_directions(400, torch.zeros(1).double()).numpy()
    sources = 0.4 * outward
    front = np.argsort(-outward[:, 0])[:40]
    ghosts = np.concatenate((0 * front[:, None], 1.5 * RADIUS * outward[front, 1:]), axis=1)
    ghosts[:, 0] = -RADIUS - 0.006
    towards = sources[front] - ghosts
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    glints = Glints(
        np.concatenate((RADIUS * outward, ghosts)),
        np.concatenate((outward, towards)),
        np.concatenate((np.ones(400), np.full(40, 3.0))),
        np.concatenate((np.arange(400), front)),
    )
    return glints, sources


@pytest.mark.parametrize("hidden", [None, 1.0])
def test_what_a_pose_cannot_have_seen_grows_no_bump(monkeypatch, hidden):
    if hidden:  # the ghosts are such that they would
        monkeypatch.setattr(read_out, "HIDDEN", hidden)
    corner = np.full(3, 0.0303)
    glints, sources = with_ghosts()
    mesh, _, _ = read_out._glint_surface(glints, deaf(sources), -corner, corner, 0.0015, "auto")
    farthest = np.linalg.norm(mesh.vertices, axis=1).max()
    if hidden:
        assert farthest > RADIUS + 0.006
    else:
        assert farthest < RADIUS + 0.0006


@pytest.mark.parametrize("glints", ["none", "lone"])
def test_without_glints_to_trust_the_surface_runs_along_the_hull(glints):
    """Of a field that is hardly fitted all glints may lie before first echoes, or far apart."""
    hull = hull_of_the_sphere()
    middle = MIDDLE.double().numpy()
    corners = RADIUS / 3**0.5 * np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    points = middle + (3 if glints == "none" else 1) * corners
    given = Glints(points, corners / RADIUS, np.ones(2), np.arange(2))
    mesh, _, _ = read_out._glint_surface(given, hull, *REGION.double().numpy(), 0.0015, "auto")
    assert mesh.is_watertight
    # Hull and sphere part by 0.17 mm between heads; drawing it takes as much again.
    assert np.abs(radii(mesh) - RADIUS).max() < 0.0004


def test_sides_that_cancel_are_drawn_as_a_sheet(monkeypatch):
    """A leaf of 0.4 mm whose sides were heard 1 mm wrong, each beyond the other."""
    monkeypatch.setattr(read_out, "BACKED", 1.0)  # too few points have others behind them
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-0.015, 0.016, 0.0015)] * 2))
    top = np.stack((x, y, np.full(len(x), -0.0008)), axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    sides = np.concatenate((top, -top)), np.concatenate((up, -up))
    glints = Glints(*sides, np.ones(2 * len(x)), np.arange(2 * len(x)))
    sources = sides[0] + 0.4 * sides[1]
    corner = np.full(3, 0.0303)
    given = (glints, deaf(sources), -corner, corner, 0.0015)
    mesh, _, _ = read_out._glint_surface(*given, "auto")
    size = np.ptp(mesh.vertices, axis=0)
    # Its edges are rounded off by three voxels.
    assert (0.03 - 6 * 0.0015 < size[:2]).all()
    assert (size[:2] < 0.03).all()
    assert size[2] < 0.004
    assert mesh.is_watertight


@pytest.mark.parametrize("ahead", [0.004, 1.0])
def test_what_lies_before_a_first_echo_is_no_glint(monkeypatch, ahead):
    """The ghosts lie 6 mm before the first echoes of the poses behind the sphere."""
    monkeypatch.setattr(read_out, "HIDDEN", 1.0)
    monkeypatch.setattr(read_out, "AHEAD", ahead)
    monkeypatch.setattr(read_out, "OUTLINE", 0.0)
    plain = read_out.oriented_surface

    def unbound(*given, bound, **options):
        assert bound.min() < -0.01
        return plain(*given, **options)

    monkeypatch.setattr(read_out, "oriented_surface", unbound)
    glints, sources = with_ghosts()
    first = np.linalg.norm(sources, axis=1, keepdims=True) - RADIUS
    hull = EchoHull(sources, sources[:, None], first, -sources / 0.4)
    corner = np.full(3, 0.0303)
    mesh, _, _ = read_out._glint_surface(glints, hull, -corner, corner, 0.0015, "auto")
    farthest = np.linalg.norm(mesh.vertices, axis=1).max()
    assert (farthest < RADIUS + 0.0006) == (ahead < 0.006)


@pytest.mark.parametrize("spacing", [None, 0.0025])
def test_lobes_on_a_sphere_give_the_sphere(spacing):
    found = reconstruct(lobes_on_a_sphere(), spacing=spacing)
    assert found.method == "oriented"
    assert found.volume.spacing == pytest.approx(spacing or SPACING / 2)
    assert found.mesh.is_watertight
    mean = np.average(radii(found.mesh), weights=found.mesh.area_faces)
    # A shell of Gaussian blur σ = 2 mm holds more volume outside: 2 σ² / r = 0.5 mm.
    assert mean == pytest.approx(RADIUS + 0.0003, abs=0.0006)
    assert radii(found.mesh).std() < 0.0004
    assert found.mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.15)


def test_the_volume_holds_the_energy_where_it_is():
    field = lobes_on_a_sphere()
    volume = reconstruct(field).volume
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


def test_the_surface_moves_with_the_field():
    shift = torch.tensor([0.003, -0.006, 0.009])  # whole steps of the grid
    one = reconstruct(lobes_on_a_sphere()).mesh
    two = reconstruct(lobes_on_a_sphere(region=REGION + shift)).mesh
    # The same sphere in another region.
    assert two.volume == pytest.approx(one.volume, rel=0.01)
    np.testing.assert_allclose(two.centroid, one.centroid, atol=1e-4)
    np.testing.assert_allclose(one.centroid, MIDDLE, atol=2e-4)


def test_a_field_without_lobes_is_read_at_a_level():
    found = reconstruct(Blob(), spacing=0.0025, directions=8)
    assert found.method == "isosurface"
    # Magnitudes of 8 directions and 3 frequencies, summed.
    assert found.volume.values.max() == pytest.approx(24, rel=1e-3)
    # The automatic level lies somewhere on the slope, which is 1 mm wide.
    assert np.average(radii(found.mesh)) == pytest.approx(RADIUS, abs=0.001)
    half = reconstruct(Blob(), spacing=0.0025, directions=8, level=12.0)
    assert half.level == 12.0
    # Linear interpolation between voxels across a steep slope.
    np.testing.assert_allclose(radii(half.mesh), RADIUS, atol=0.0003)
    assert half.mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
    low = reconstruct(Blob(), spacing=0.0025, directions=8, level=1.0)
    assert low.mesh.volume > half.mesh.volume


@pytest.mark.parametrize(
    ("smoothing", "width"),
    [(0.0025, 1), (0.0075, 3), (0.009, 3), (0.0125, 5), (0.045, 19)],  # of voxels of 2.5 mm
)
def test_a_box_may_be_averaged_over_before_the_surface_is_drawn(smoothing, width):
    options = {"spacing": 0.0025, "directions": 2, "method": "isosurface"}
    plain = reconstruct(Blob(), **options).volume.values
    smooth = reconstruct(Blob(), smoothing=smoothing, **options).volume.values
    # Beyond the grid its outermost values go on, as in MATLAB's smooth3.
    half = width // 2
    padded = np.pad(np.asarray(plain, dtype=np.float64), half, mode="edge")
    for i, j, k in ((0, 0, 0), (10, 12, 9), (18, 12, 12)):
        box = padded[i : i + width, j : j + width, k : k + width]
        assert smooth[i, j, k] == pytest.approx(box.mean(), rel=1e-4, abs=1e-6)


def test_finer_voxels_come_nearer():
    errors = []
    for spacing in (0.006, 0.003, 0.0015):
        mesh = reconstruct(Blob(), spacing=spacing, directions=2, level=3.0).mesh
        errors.append(np.abs(radii(mesh) - RADIUS).mean())
    assert errors[0] > errors[1] > errors[2]


def test_the_method_may_be_chosen():
    found = reconstruct(lobes_on_a_sphere(), method="isosurface", directions=30)
    assert found.method == "isosurface"
    # A shell: its outer side lies outside of the sphere, its inner side is a cavity.
    assert radii(found.mesh).min() < RADIUS - 0.0005 < RADIUS + 0.0005 < radii(found.mesh).max()


def test_chunks_have_no_seams(monkeypatch):
    whole = reconstruct(lobes_on_a_sphere())
    done = []
    monkeypatch.setattr(read_out, "CHUNK", 777)
    pieces = reconstruct(lobes_on_a_sphere(), progress=lambda *counts: done.append(counts))
    np.testing.assert_allclose(pieces.volume.values, whole.volume.values, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(pieces.mesh.vertices, whole.mesh.vertices, atol=1e-5)
    total = whole.volume.values.size
    assert done[-1] == (total, total)
    assert len(done) >= total // 777


def test_what_is_not_kept_has_no_surface():
    field = lobes_on_a_sphere()
    vertices = field.region[0] + SPACING * torch.cartesian_prod(*[torch.arange(21)] * 3)
    distance = (vertices - MIDDLE).norm(dim=1)
    field.keep(vertices[(distance - RADIUS).abs() < 0.004], SPACING)
    volume = reconstruct(field).volume
    outside = np.linalg.norm(volume.points() - MIDDLE.numpy(), axis=1) > RADIUS + 0.008
    assert volume.values.ravel()[outside].max() == 0


def test_a_silent_field_is_an_error():
    for field in (Blob(level=0.0), lobes_on_a_sphere()):
        if field.knows_directions:
            field.occupancy.zero_()
        with pytest.raises(NumericalError, match="silent everywhere"):
            reconstruct(field, directions=4)


def test_a_spacing_larger_than_the_region_is_said_to_be_so():
    region = torch.tensor([[-0.02] * 3, [0.02] * 3])
    field = GridField(region, torch.tensor([20e3, 40e3]), spacing=0.01, levels=1)
    with pytest.raises(SettingsError, match="larger than the region"):
        reconstruct(field, spacing=2.0)


@pytest.mark.parametrize("method", ["open", "filled"])
def test_the_surface_of_the_occupancy_is_the_sphere_and_says_who_heard_it(method):
    found = reconstruct(sounding(0.012), hull=hull_of_the_sphere(), method=method, resolution=0.005)
    assert found.method == method
    assert np.abs(radii(found.mesh) - RADIUS).mean() < 0.8e-3
    assert found.mesh.is_watertight
    assert found.support is not None
    assert len(found.support) == len(found.mesh.vertices)
    again = reconstruct(
        sounding(0.012), hull=hull_of_the_sphere(), method=method, gathered=found.gathered
    )
    np.testing.assert_array_equal(again.mesh.vertices, found.mesh.vertices)


@pytest.mark.parametrize("method", ["open", "filled"])
def test_an_occupancy_needs_to_know_where_the_field_was_heard_from(method):
    with pytest.raises(SettingsError, match=f"method {method}: it is not known where"):
        reconstruct(sounding(RADIUS), method=method)
