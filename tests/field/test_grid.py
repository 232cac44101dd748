# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.field.field import Field, sphere_directions
from sononerf.field.grid import LOG_STRENGTH_FLOOR, RADIUS_UNIT, GridField

REGION = torch.tensor([[-0.03, 0.01, 0.2], [0.021, 0.05, 0.227]], dtype=torch.float64)
FREQUENCY = torch.tensor([30e3, 50e3, 70e3], dtype=torch.float64)


def grid(region=REGION, **options):
    return GridField(region, FREQUENCY, **{"spacing": 0.01, "levels": 2, **options}).double()


def places_in(count, region=REGION, seed=0):
    generator = torch.Generator().manual_seed(seed)
    part = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return region[0] + part * (region[1] - region[0])


def fill(field, seed=0, size=1.0):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in field.parameters():
            values = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(size * values)
    return field


def test_shape_keeps_the_batch():
    field = fill(grid())
    places, directions = places_in(6).reshape(2, 3, 3), sphere_directions(6, REGION)
    assert field(places, directions.reshape(2, 3, 3)).shape == (2, 3, 3)
    assert field(places, directions[0]).shape == (2, 3, 3)
    assert field.select(places[0], directions.reshape(2, 3, 3), None).shape == (2, 3, 3)


def test_device_and_type_follow_the_field(device):
    field = grid(REGION.float()).float().to(device)
    places = places_in(5).float().to(device)
    response = field(places, sphere_directions(5, places))
    assert (response.device, response.dtype) == (places.device, torch.float32)
    assert not response.is_complex()
    assert fill(grid())(places_in(5), sphere_directions(5, REGION)).dtype == torch.float64


def test_gradients():
    field = fill(grid(spacing=0.025), size=0.5)
    places, directions = places_in(4), sphere_directions(4, REGION)
    names = [name for name, _ in field.named_parameters()]

    def response(*values):
        state = dict(zip(names, values, strict=True))
        return torch.func.functional_call(field, state, (places, directions))

    assert torch.autograd.gradcheck(response, tuple(field.parameters()))


def test_a_new_field_has_finite_gradients():
    field = grid()
    field(places_in(5), sphere_directions(5, REGION)).sum().backward()
    assert all(p.grad.isfinite().all() for p in field.parameters())


def test_linear_functions_are_read_exactly():
    """Trilinear interpolation, on each level by its own, sides that no level divides."""
    field = grid()
    generator = torch.Generator().manual_seed(1)
    slopes = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    offsets = torch.randn(2, 5, generator=generator, dtype=torch.float64)
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


def test_the_grids_cover_the_region():
    sizes = [tuple(values.shape[4:1:-1]) for values in grid(levels=3).grids]
    # 51, 40 and 27 mm in steps of 10, 20, 40 mm: intervals rounded up, one vertex more.
    assert sizes == [(7, 5, 4), (4, 3, 3), (3, 2, 2)]
    # A side that divides gets no vertex too many from rounding.
    whole = torch.tensor([[-0.1] * 3, [0.2] * 3], dtype=torch.float64)
    assert tuple(grid(whole, spacing=0.1, levels=1).grids[0].shape) == (1, 5, 4, 4, 4)


def test_the_spacing_is_found_from_the_number_of_vertices():
    region = torch.tensor([[0.0] * 3, [0.2, 0.4, 0.8]], dtype=torch.float64)
    options = {"spacing": None, "finest": 0.001, "coarsest": 0.5}
    assert grid(region, vertices=8000, **options).resolution == pytest.approx(0.02)
    assert grid(region, vertices=8000, **options | {"finest": 0.03}).resolution == 0.03
    assert grid(region, vertices=8000, **options | {"coarsest": 0.01}).resolution == 0.01


def test_the_lobe_formula():
    r"""exp(a + e^k (m·u - |m|) + s) from numbers put in by hand."""
    field = grid(levels=1)
    lobe = torch.tensor([1.0, -2.0, 2.0], dtype=torch.float64)
    spectrum = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    sharpness = torch.tensor([0.0, 0.5, -0.5], dtype=torch.float64)
    with torch.no_grad():
        field.grids[0][:, 0] = -1.5
        field.grids[0][0, 1:4] = lobe[:, None, None, None]
        field.spectrum.copy_(spectrum)
        field.sharpness.copy_(sharpness)
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


def test_strength_has_a_floor():
    field = grid(levels=1)
    with torch.no_grad():
        field.grids[0][:, 0] = -1000.0
    found = field(places_in(1), sphere_directions(1, REGION))
    expected = torch.full_like(found, math.exp(LOG_STRENGTH_FLOOR))
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)  # |m| = sqrt(1e-6) there


def test_energy_and_axis_are_those_of_a_dense_sphere():
    field = fill(grid(), seed=3)
    with torch.no_grad():
        field.grids[0][:, 1:4] *= 4  # concentrations up to 20
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
    other, other_axis = Field.oriented(field, places, 4000)
    torch.testing.assert_close(other, energy, rtol=2e-3, atol=0)
    torch.testing.assert_close(other_axis[:-1], axis[:-1], rtol=0, atol=2e-3)


def test_without_a_lobe_the_energy_is_that_of_all_directions():
    energy, axis = grid().oriented(places_in(2), 32)
    torch.testing.assert_close(energy, torch.full_like(energy, 3.0))
    assert axis.abs().max() == 0


def test_zero_outside_the_region_and_where_not_kept():
    field = fill(grid())
    outside = REGION.mean(0) + torch.diag(REGION[1] - REGION[0])
    assert field(outside, sphere_directions(3, REGION)).abs().max() == 0
    vertex = REGION[:1] + 0.01 * torch.tensor([[2, 1, 1]])
    field.keep(vertex, field.resolution)
    probe = torch.cat((vertex + 0.0049, vertex - 0.0049, vertex + 0.0051))
    response = field(probe, sphere_directions(3, REGION)).abs().amax(-1)
    assert (response > 0).tolist() == [True, True, False]
    assert (field.oriented(probe, 8)[0] > 0).tolist() == [True, True, False]


def test_moving_region_and_places_together_changes_nothing():
    shift = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    one, two = fill(grid()), fill(grid(REGION + shift))
    places, directions = places_in(20), sphere_directions(20, REGION)
    torch.testing.assert_close(one(places, directions), two(places + shift, directions))
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    moved = one(places[order], directions[order])
    torch.testing.assert_close(moved, one(places, directions)[order])


def around(axis, angles):
    """Unit vectors at these angles off an axis, (N, 3)."""
    axis = axis / axis.norm()
    aside = torch.linalg.cross(axis, axis.new_tensor([0.3, -0.5, 0.8]))
    aside = aside / aside.norm()
    return angles.cos()[:, None] * axis + angles.sin()[:, None] * aside


def bent(radius):
    """One lobe everywhere, on a surface of this radius of curvature."""
    field = grid(levels=1)
    lobe = torch.tensor([2.0, -4.0, 4.0], dtype=torch.float64)
    with torch.no_grad():
        field.grids[0][0, 1:4] = lobe[:, None, None, None]
        field.grids[0][0, 4] = radius / RADIUS_UNIT
    return field, lobe


@pytest.mark.parametrize("radius", [0.03, -0.01])
def test_off_its_axis_a_curved_place_is_heard_nearer(radius):
    """By R (1 - cos θ), here up to straight behind; of a hollow, R < 0, farther."""
    field, lobe = bent(radius)
    angles = torch.tensor([0.0, 0.1, math.pi / 3, math.pi / 2, math.pi], dtype=torch.float64)
    given = places_in(5), around(lobe, angles), None
    for step, curved in ((0, False), (39, False), (40, True), (100, True), (3, False)):
        field.advance(step, 100)
        lead = field.echo(*given)[1].detach()
        expected = radius * (1 - angles.cos()) * curved
        torch.testing.assert_close(lead, expected, rtol=0, atol=1e-12)
        assert lead[2] == pytest.approx(radius / 2 * curved)
    assert float(grid().curved) == 0  # of a new field


def test_an_echo_is_what_select_answers():
    field = fill(grid())
    places = torch.cat((places_in(20), REGION[1:] + 0.01))
    directions = sphere_directions(21, REGION)
    for bins in (None, torch.tensor([2, 0])):
        response, lead = field.echo(places, directions, bins)
        assert torch.equal(response, field.select(places, directions, bins))
        assert lead.shape == (21,)


def test_places_may_be_named_once_for_many_directions():
    field = fill(grid())
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


def test_the_range_bends_places_and_turns_no_lobe():
    field = fill(grid())
    field.advance(1, 1)
    response, lead = field.echo(places_in(9), sphere_directions(9, REGION), None)
    lead.sum().backward(retain_graph=True)
    for values in field.grids:
        assert values.grad[:, 4].abs().max() > 0
        assert values.grad[:, :4].abs().max() == 0
    field.zero_grad()
    response.sum().backward()
    for values in field.grids:
        assert (values.grad[:, :4].abs().amax(dim=(0, 2, 3, 4)) > 0).all()
        assert values.grad[:, 4].abs().max() == 0


def test_a_place_without_a_lobe_has_finite_gradients_of_its_range():
    field = grid()
    field.advance(1, 1)
    sum(
        part.sum() for part in field.echo(places_in(5), sphere_directions(5, REGION), None)
    ).backward()
    assert all(p.grad.isfinite().all() for p in field.parameters() if p.grad is not None)


def test_what_is_left_out_is_43_db_below_its_own_peak():
    """In every frequency: the widest lobe decides."""
    field, lobe = bent(0.0)
    with torch.no_grad():
        field.sharpness.copy_(torch.tensor([0.4, -0.3, 0.1]))
        field.spectrum.copy_(torch.tensor([3.0, -2.0, 0.0]))
    angles = torch.linspace(0, math.pi, 400, dtype=torch.float64)
    places, directions = places_in(2), around(lobe, angles)[:, None].expand(-1, 2, 3)
    heard = field.audible(places, directions)
    assert (heard.shape, heard.dtype) == ((400, 2), torch.bool)
    response = field.select(places, directions, None)
    below = 20 * (response / response[0]).amax(-1).log10()  # of the frequency that keeps most
    assert below[~heard].max() < -43.0
    assert below[heard].min() > -43.9  # -43.4, less one step of the angle
    assert 100 < int(heard[:, 0].sum()) < 300


def test_weights_and_what_is_kept_are_read_back():
    field = fill(grid())
    field.advance(1, 1)
    field.keep(REGION[:1] + 0.01, field.resolution)
    other = grid()
    other.load_state_dict(field.state_dict())
    places, directions = places_in(200), sphere_directions(200, REGION)
    assert torch.equal(other(places, directions), field(places, directions))
    assert 0 < int((other(places, directions) > 0).any(-1).sum()) < 200
    assert torch.equal(
        other.echo(places, directions, None)[1], field.echo(places, directions, None)[1]
    )
    assert field.echo(places, directions, None)[1].abs().max() > 0
