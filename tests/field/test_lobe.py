# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.field.field import Field, sphere_directions
from sononerf.field.lobe import LOG_STRENGTH_FLOOR, RADIUS_UNIT
from tests.field.lobes import FREQUENCY, REGION, fill, grid, places_in, say

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


def test_shape_keeps_the_batch(make):
    field = fill(make())
    places, directions = places_in(6).reshape(2, 3, 3), sphere_directions(6, REGION)
    assert field(places, directions.reshape(2, 3, 3)).shape == (2, 3, 3)
    assert field(places, directions[0]).shape == (2, 3, 3)
    assert field.select(places[0], directions.reshape(2, 3, 3), None).shape == (2, 3, 3)
    assert field(places[:0], directions[0]).shape == (0, 3, 3)
    assert [part.shape for part in field.oriented(places[0, :0], 8)] == [(0,), (0, 3)]


def test_device_and_type_follow_the_field(make, device):
    field = make(REGION.float()).float().to(device)
    places = places_in(5).float().to(device)
    response = field(places, sphere_directions(5, places))
    assert (response.device, response.dtype) == (places.device, torch.float32)
    assert not response.is_complex()
    energy, axis = field.oriented(places, 8)
    assert (energy.device, axis.dtype) == (places.device, torch.float32)
    assert fill(make())(places_in(5), sphere_directions(5, REGION)).dtype == torch.float64


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


def test_strength_has_a_floor(make):
    found = say(make(), -1000.0)(places_in(1), sphere_directions(1, REGION))
    expected = torch.full_like(found, math.exp(LOG_STRENGTH_FLOOR))
    torch.testing.assert_close(found, expected, rtol=1.1e-3, atol=0)  # |m| = sqrt(1e-6) there


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


def test_energy_and_axis_are_those_of_a_dense_sphere(make):
    field = steep(make())
    places = torch.cat((places_in(8), REGION[1:] + 0.01))
    dense = sphere_directions(20_000, REGION)
    power = field.select(places, dense[:, None].expand(-1, len(places), 3), None).square()
    energy, axis = field.oriented(places, 32)
    # |m| against sqrt(|m|² + 1e-6), and the lattice itself: a part in ten thousand.
    torch.testing.assert_close(energy, power.mean(0).sum(-1), rtol=1e-4, atol=0)
    assert energy[-1] == 0
    moment = torch.einsum("dnf,di->ni", power, dense)
    moment /= moment.norm(dim=1, keepdim=True).clamp_min(1e-30)
    torch.testing.assert_close(axis[:-1], moment[:-1], rtol=0, atol=1e-4)
    other, other_axis = Field.oriented(field, places, 500)
    torch.testing.assert_close(other, energy, rtol=2e-3, atol=0)
    torch.testing.assert_close(other_axis[:-1], axis[:-1], rtol=0, atol=2e-3)


def test_without_a_lobe_the_energy_is_that_of_all_directions(make):
    energy, axis = say(make()).oriented(places_in(2), 32)
    torch.testing.assert_close(energy, torch.full_like(energy, 3.0))
    assert axis.abs().max() == 0


def test_zero_outside_the_region_and_where_not_kept(make):
    field = fill(make())
    outside = REGION.mean(0) + torch.diag(REGION[1] - REGION[0])
    assert field(outside, sphere_directions(3, REGION)).abs().max() == 0
    vertex = REGION[:1] + 0.01 * torch.tensor([[2, 1, 1]])
    field.keep(vertex, field.resolution)
    probe = torch.cat((vertex + 0.0049, vertex - 0.0049, vertex + 0.0051))
    response = field(probe, sphere_directions(3, REGION)).abs().amax(-1)
    assert (response > 0).tolist() == [True, True, False]
    assert (field.oriented(probe, 8)[0] > 0).tolist() == [True, True, False]


def test_moving_region_and_places_together_changes_nothing(make):
    shift = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    one, two = fill(make()), fill(make(REGION + shift))
    places, directions = places_in(20), sphere_directions(20, REGION)
    torch.testing.assert_close(one(places, directions), two(places + shift, directions))
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    moved = one(places[order], directions[order])
    torch.testing.assert_close(moved, one(places, directions)[order])


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


def test_the_lead_fades_with_the_lobe(make):
    """Whose direction is by chance where it has no length: no radius may move such a place."""
    place, behind = places_in(1), -LOBE[None] / 6
    leads = {}
    for length in (0.0, 0.01, 0.1, 1.0, 3.0, 5.0, 50.0):
        field = say(make(), 0.0, *(LOBE * (length / 6)), 1.0)
        field.advance(1, 1)
        leads[length] = field.echo(place, behind, None)[1].item() / (2 * RADIUS_UNIT)
    assert leads[0.0] < 1e-6  # a part of the radius: no lobe is told by a small length
    assert leads[0.01] < 2e-4
    assert leads[0.1] < 0.02
    assert list(leads.values()) == sorted(leads.values())
    assert leads[3.0] == pytest.approx(1.0, rel=2e-4)  # e^-9 is 1.2e-4
    # What a place of an ordinary lobe has learned is heard as it was, to the rounding.
    assert leads[5.0] == pytest.approx(1.0, rel=1e-6)
    assert leads[50.0] == pytest.approx(1.0, rel=1e-6)


def test_an_echo_is_what_select_answers(make):
    field = fill(make())
    places = torch.cat((places_in(20), REGION[1:] + 0.01))
    directions = sphere_directions(21, REGION)
    for bins in (None, torch.tensor([2, 0])):
        response, lead = field.echo(places, directions, bins)
        assert torch.equal(response, field.select(places, directions, bins))
        assert lead.shape == (21,)


def test_places_may_be_named_once_for_many_directions(make):
    field = fill(make())
    field.advance(1, 1)
    places = torch.cat((places_in(5), REGION[1:] + 0.01))
    place, directions = torch.tensor([4, 0, 0, 5, 2, 4]), sphere_directions(6, REGION)
    for bins in (None, torch.tensor([1])):
        for found, expected in zip(
            field.echo(places, directions, bins, place),
            field.echo(places[place], directions, bins),
            strict=True,
        ):
            torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


def test_the_range_bends_places_and_turns_no_lobe(make, monkeypatch):
    field = fill(make())
    field.advance(1, 1)
    given = places_in(9), sphere_directions(9, REGION), None
    read = field.code(given[0]).detach().requires_grad_()
    monkeypatch.setattr(field, "code", lambda positions: read)
    response, lead = field.echo(*given)
    lead.sum().backward(retain_graph=True)
    bent = read.grad.abs().amax(0) > 0
    assert bent.tolist() == [i == 4 for i in range(read.shape[1])]
    read.grad = None
    response.sum().backward()
    heard = read.grad.abs().amax(0) > 0
    assert heard.tolist() == [i != 4 for i in range(read.shape[1])]


def test_a_place_without_a_lobe_has_finite_gradients(make):
    field = say(make())
    field.advance(1, 1)
    sum(
        part.sum() for part in field.echo(places_in(5), sphere_directions(5, REGION), None)
    ).backward()
    assert all(p.grad.isfinite().all() for p in field.parameters() if p.grad is not None)


def test_what_is_left_out_is_43_db_below_its_own_peak(make):
    """In every frequency: the widest lobe decides."""
    field = say(make(), 0.0, *LOBE)
    with torch.no_grad():
        field.sharpness.copy_(torch.tensor([0.4, -0.3, 0.1]))
        field.spectrum.copy_(torch.tensor([3.0, -2.0, 0.0]))
    angles = torch.linspace(0, math.pi, 400, dtype=torch.float64)
    places, directions = places_in(1), around(LOBE, angles)
    heard = field.audible(places, places + 0.4 * directions)
    assert (heard.shape, heard.dtype) == ((400, 1), torch.bool)
    response = field.select(places, directions[:, None], None)
    below = 20 * (response / response[0]).amax(-1).log10()  # of the frequency that keeps most
    assert below[~heard].max() < -43.0
    assert below[heard].min() > -43.9  # -43.4, less one step of the angle
    assert 100 < int(heard[:, 0].sum()) < 300


def test_inaudible_is_what_is_faint_at_every_frequency(make):
    """Of places whose lobes differ, towards emitters near and far."""
    field = steep(make())
    places = places_in(20)
    sources = torch.linspace(0.15, 0.6, 30)[:, None].to(places) * sphere_directions(30, REGION)
    directions = sources[:, None] - places
    directions = directions / directions.norm(dim=-1, keepdim=True)
    lobe = field.code(places)[:, 1:4]
    peak = field.select(places, lobe / lobe.norm(dim=1, keepdim=True), None)
    faint = (field.select(places, directions, None) < math.exp(-5) * peak).all(-1)
    assert torch.equal(field.audible(places, sources), ~faint)
    assert 0.1 < float(faint.double().mean()) < 0.9


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
    for one, two in zip(other.oriented(places, 8), field.oriented(places, 8), strict=True):
        assert torch.equal(one, two)
