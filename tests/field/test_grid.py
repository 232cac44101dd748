# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.errors import SettingsError
from sononerf.field.field import Field, lattice_over, sphere_directions
from sononerf.field.lobe import RADIUS_UNIT
from tests.field.lobes import FREQUENCY, REGION, fill, grid, places_in, say


def test_there_are_lobes_and_one_spectrum_unless_more_is_asked_for():
    """And no random number is drawn, so that what a fit draws is the same."""
    torch.manual_seed(0)
    drawn = torch.rand(3)
    field = grid(seed=0)
    assert torch.equal(torch.rand(3), drawn)
    found = {name: len(p) for name, p in field.named_parameters()}
    assert found == {"spectrum": 3, "sharpness": 3, "grids.0": 1, "grids.1": 1}
    kept = {"region", "frequency", "occupancy", "cell", "origin", "curved"}
    assert set(field.state_dict()) == kept | set(found)
    assert [values.shape[1] for values in grid(rank=2).grids] == [7, 7]
    assert [values.shape[1] for values in grid(rank=9).grids] == [7, 7]  # of three frequencies


@pytest.mark.parametrize("rank", [0, 2])
def test_linear_functions_are_read_exactly(rank):
    """Trilinear interpolation, on each level by its own, sides that no level divides."""
    field = grid(rank=rank)
    generator = torch.Generator().manual_seed(1)
    slopes = torch.randn(2, 5 + rank, 3, generator=generator, dtype=torch.float64)
    offsets = torch.randn(2, 5 + rank, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        for level, values in enumerate(field.grids):
            step = 0.01 * 2**level
            axes = [
                REGION[0, a] + step * torch.arange(values.shape[4 - a]).double() for a in range(3)
            ]
            vertices = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)  # (X, Y, Z, 3)
            linear = vertices @ slopes[level].T + offsets[level]
            values.copy_(linear.permute(3, 2, 1, 0)[None])
    # On the vertices' own sites too, and at the corners of the region.
    places = torch.cat((places_in(50), REGION, REGION[:1] + 0.01))
    expected = places @ slopes.sum(0).T + offsets.sum(0)
    torch.testing.assert_close(field.code(places), expected, rtol=0, atol=1e-12)


def lattice_in(field):
    """Vertices of the lattice that fits are made of, every other one; and some beyond."""
    places = lattice_over(REGION, field.resolution)[::2]
    return torch.cat((places, REGION + torch.tensor([[-0.004], [0.004]])))


@pytest.mark.parametrize("which", [None, torch.tensor([2, 0, 2])])
@pytest.mark.parametrize("options", [{"rank": 2}, {"spacing": 0.2}])  # 0.2: one interval a side
def test_a_lattice_is_read_as_any_places_are(options, which):
    field = fill(grid(levels=3, **options))
    # Vertices of less weight than 1e-5 are left out: up to a few of them, of numbers about one.
    # Vertices of the finest grid to a rounding, midpoints and quarters of others, and any place.
    for places in (lattice_in(field), lattice_in(field) + 1e-10, places_in(30)):
        found = field.code_of_lattice(places, which)
        wanted = field.code(places if which is None else places[which])
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
        weight = torch.randn(found.shape, dtype=found.dtype)
        for one, two in zip(
            torch.autograd.grad((found * weight).sum(), list(field.grids)),
            torch.autograd.grad((wanted * weight).sum(), list(field.grids)),
            strict=True,
        ):
            torch.testing.assert_close(one, two, rtol=0, atol=1e-4)


def test_the_spacing_is_found_from_the_number_of_vertices():
    region = torch.tensor([[0.0] * 3, [0.2, 0.4, 0.8]], dtype=torch.float64)
    options = {"spacing": None, "finest": 0.001, "coarsest": 0.5}
    assert grid(region, vertices=8000, **options).resolution == pytest.approx(0.02)
    assert grid(region, vertices=8000, **options | {"finest": 0.03}).resolution == 0.03
    assert grid(region, vertices=8000, **options | {"coarsest": 0.01}).resolution == 0.01
    assert grid(region, **options | {"finest": 0.03, "coarsest": 0.03}).resolution == 0.03
    crossed = {"finest": 0.03, "coarsest": 0.02}
    with pytest.raises(SettingsError, match="coarsest"):
        grid(region, **options | crossed)
    assert grid(region, **crossed | {"spacing": 0.1}).resolution == 0.1  # which needs no bounds


LOBE = torch.tensor([2.0, -4.0, 4.0], dtype=torch.float64)  # of length 6


@pytest.fixture(params=["grid", "ranked"])
def make(request):
    """What makes a field of each kind; all that is said here holds of all of them."""
    kinds = {
        "grid": grid,
        "ranked": lambda *region, **options: grid(*region, **{"rank": 2, **options}),
    }
    return kinds[request.param]


def steep(field):
    """Lobes that differ from place to place, with concentrations of about ten."""
    fill(field, seed=3, size=0.5)
    with torch.no_grad():
        field.grids[0][:, 1:4] *= 16
    return field


def around(axis, angles):
    """Unit vectors at these angles off an axis, (N, 3)."""
    axis = axis / axis.norm()
    aside = torch.linalg.cross(axis, axis.new_tensor([0.3, -0.5, 0.8]))
    aside = aside / aside.norm()
    return angles.cos()[:, None] * axis + angles.sin()[:, None] * aside


@pytest.mark.parametrize("rank", [0, 2])
def test_the_lobe_formula(make, rank):
    r"""exp(a + e^k (m·u - |m|) + s + c·b) from numbers put in by hand."""
    field = make(rank=rank)
    lobe = torch.tensor([1.0, -2.0, 2.0], dtype=torch.float64)
    spectrum = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    sharpness = torch.tensor([0.0, 0.5, -0.5], dtype=torch.float64)
    basis = torch.tensor([[1.0, 2.0, 3.0], [-1.0, 0.0, 4.0]], dtype=torch.float64)
    say(field, -1.5, *lobe, 7.0, *[0.2, -0.1][:rank])  # the radius is not heard here
    with torch.no_grad():
        field.spectrum.copy_(spectrum)
        field.sharpness.copy_(sharpness)
        if rank:
            field.basis.copy_(basis)
            spectrum = spectrum + 0.2 * basis[0] - 0.1 * basis[1]
    directions = torch.cat((lobe[None] / 3, sphere_directions(8, REGION)))
    place = places_in(1).expand(9, 3)
    expected = [
        [
            math.exp(-1.5 + math.exp(k) * (float(u @ lobe) - 3.0) + s)
            for k, s in zip(sharpness.tolist(), spectrum.tolist(), strict=True)
        ]
        for u in directions
    ]
    # A small number under the root keeps its gradient finite: 1e-6 / (2 |m|) in the exponent.
    expected = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(field(place, directions), expected, rtol=1e-6, atol=0)
    bins = torch.tensor([2, 1])
    some = field.select(place, directions, bins)
    torch.testing.assert_close(some, expected[:, bins], rtol=1e-6, atol=0)


def test_the_spectra_begin_as_slow_cosines_that_leave_the_mean_alone(make):
    frequency = torch.linspace(10e3, 100e3, 47, dtype=torch.float64)
    basis = make(REGION, frequency, rank=6).basis.detach()
    assert basis.shape == (6, 47)
    # Orthogonal to each other and to a constant; one of them has 47 / 2 for a square.
    assert basis.sum(1).abs().max() < 1e-4
    expected = 23.5 * torch.eye(6, dtype=torch.float64)
    torch.testing.assert_close(basis @ basis.T, expected, rtol=0, atol=1e-4)
    turns = (basis[:, 1:] * basis[:, :-1] < 0).sum(1)
    assert turns.tolist() == [1, 2, 3, 4, 5, 6]
    # No more than a spectrum has shapes.
    assert make(rank=6).basis.shape == (2, 3)
    single = make(REGION, FREQUENCY[:1], rank=6)
    assert "basis" not in single.state_dict()
    assert single(places_in(2), sphere_directions(2, REGION)).shape == (2, 1)


def test_the_energy_is_that_of_a_dense_sphere(make):
    field = steep(make())
    places = torch.cat((places_in(8), REGION[1:] + 0.01))
    dense = sphere_directions(20_000, REGION)
    power = field.select(places, dense[:, None].expand(-1, len(places), 3), None).square()
    energy = field.energy(places, 32)
    # |m| against sqrt(|m|² + 1e-6), and the lattice itself: a part in ten thousand.
    torch.testing.assert_close(energy, power.mean(0).sum(-1), rtol=1e-4, atol=0)
    assert energy[-1] == 0
    torch.testing.assert_close(Field.energy(field, places, 500), energy, rtol=2e-3, atol=0)


def test_without_a_lobe_the_energy_is_that_of_all_directions(make):
    energy = say(make()).energy(places_in(2), 32)
    torch.testing.assert_close(energy, torch.full_like(energy, 3.0))


@pytest.mark.parametrize("radius", [0.03, -0.01])
def test_off_its_axis_a_curved_place_is_heard_nearer(make, radius):
    """By R (1 - cos θ), here up to straight behind; of a hollow, R < 0, farther."""
    field = say(make(), 0.0, *LOBE, radius / RADIUS_UNIT)
    angles = torch.tensor([0.0, 0.1, math.pi / 3, math.pi / 2, math.pi], dtype=torch.float64)
    given = places_in(5), around(LOBE, angles), None
    for step, curved in ((0, False), (39, False), (40, True), (100, True), (3, False)):
        field.advance(step, 100)
        lead = field.echo(*given)[1].detach()
        expected = radius * (1 - angles.cos()) * curved
        # A radius that is read out in single precision, of 30 mm.
        torch.testing.assert_close(lead, expected, rtol=0, atol=5e-9)
        assert lead[2] == pytest.approx(radius / 2 * curved, rel=1e-6)
    assert float(make().curved) == 0  # of a new field


def test_an_echo_is_what_select_answers(make):
    field = fill(make())
    places = torch.cat((places_in(20), REGION[1:] + 0.01))
    directions = sphere_directions(21, REGION)
    for bins in (None, torch.tensor([2, 0])):
        response, lead = field.echo(places, directions, bins)
        assert torch.equal(response, field.select(places, directions, bins))
        assert lead.shape == (21,)


def test_a_place_without_a_lobe_has_finite_gradients(make):
    field = say(make())
    field.advance(1, 1)
    sum(
        part.sum() for part in field.echo(places_in(5), sphere_directions(5, REGION), None)
    ).backward()
    assert all(p.grad.isfinite().all() for p in field.parameters() if p.grad is not None)


def test_weights_what_is_curved_and_what_is_kept_are_read_back(make):
    field = fill(make())
    field.advance(1, 1)
    field.keep(REGION[:1] + 0.01, field.resolution)
    other = make(seed=5)
    other.load_state_dict(field.state_dict())
    places, directions = places_in(200), sphere_directions(200, REGION)
    assert torch.equal(other(places, directions), field(places, directions))
    assert 0 < int((other(places, directions) > 0).any(-1).sum()) < 200
    lead = field.echo(places, directions, None)[1]
    assert torch.equal(other.echo(places, directions, None)[1], lead)
    assert lead.abs().max() > 0
    assert torch.equal(other.energy(places, 8), field.energy(places, 8))
