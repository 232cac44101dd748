# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.field.field import Field, sphere_directions
from sononerf.field.grid import LOG_STRENGTH_FLOOR, GridField

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
    slopes = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    offsets = torch.randn(2, 4, generator=generator, dtype=torch.float64)
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
    assert tuple(grid(whole, spacing=0.1, levels=1).grids[0].shape) == (1, 4, 4, 4, 4)


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
        field.grids[0][0, 1:] = lobe[:, None, None, None]
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
        field.grids[0][:, 1:] *= 4  # concentrations up to 20
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


def test_weights_and_what_is_kept_are_read_back():
    field = fill(grid())
    field.keep(REGION[:1] + 0.01, field.resolution)
    other = grid()
    other.load_state_dict(field.state_dict())
    places, directions = places_in(200), sphere_directions(200, REGION)
    assert torch.equal(other(places, directions), field(places, directions))
    assert 0 < int((other(places, directions) > 0).any(-1).sum()) < 200
