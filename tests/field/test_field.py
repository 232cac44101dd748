# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.field.field import Field, sphere_directions

REGION = torch.tensor([[-0.1, -0.05, 0.0], [0.1, 0.05, 0.2]], dtype=torch.float64)
FREQUENCY = torch.tensor([30e3, 50e3, 70e3], dtype=torch.float64)
AXIS = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)


class CosineField(Field):
    """max(0, cos) about one axis, alike everywhere in the region."""

    resolution = 0.05

    def forward(self, positions, directions):
        response = (directions @ AXIS.to(directions)).clamp_min(0)[..., None]
        response = response * self.inside(positions)[..., None]
        return response.expand(*response.shape[:-1], len(self.frequency))


@pytest.fixture
def field(device):
    return CosineField(REGION, FREQUENCY).to(device)


def test_the_lattice_is_even_and_of_unit_vectors():
    lattice = sphere_directions(1000, REGION)
    assert lattice.dtype == torch.float64
    torch.testing.assert_close(lattice.norm(dim=1), torch.ones(1000, dtype=torch.float64))
    assert lattice.mean(0).abs().max() < 1e-3
    second = lattice.T @ lattice / 1000
    torch.testing.assert_close(second, torch.eye(3, dtype=torch.float64) / 3, atol=1e-3, rtol=0)
    # Evenly spread, no two neighbours are nearer than 3.09 / sqrt(n) (Swinbank & Purser 2006).
    gaps = torch.cdist(lattice, lattice).fill_diagonal_(9.0)
    assert float(gaps.min()) == pytest.approx(3.09 / math.sqrt(1000), rel=0.02)


def test_a_cosine_lobe_has_a_sixth_of_the_energy(field, device):
    places = torch.tensor([[0.0, 0.0, 0.1], [0.05, 0.02, 0.15], [0.0, 0.0, 0.3]]).double()
    energy = field.energy(places.to(device), 4000)
    # The mean of cos² over a hemisphere, half of the sphere, is 1/6; three frequencies; the
    # third place lies outside.
    expected = torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)
    torch.testing.assert_close(energy.cpu(), expected, rtol=1e-3, atol=0)
    assert not energy.requires_grad


def test_loudness_is_a_sum_over_directions_and_frequencies(field, device):
    places = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]], dtype=torch.float64, device=device)
    # The mean of max(0, cos) over the sphere is 1/4.
    found = field.loudness(places, 800).cpu()
    expected = torch.tensor([800 * 3 / 4, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


def test_select_is_forward_at_some_frequencies(field, device):
    places = torch.rand(7, 3, dtype=torch.float64, device=device) * 0.1
    directions = sphere_directions(14, places).reshape(2, 7, 3)
    bins = torch.tensor([2, 0], device=device)
    whole = field(places.expand(2, 7, 3), directions)
    assert field.select(places, directions, None).shape == (2, 7, 3)
    torch.testing.assert_close(field.select(places, directions, None), whole)
    torch.testing.assert_close(field.select(places, directions, bins), whole[..., bins])


def test_inside_is_the_region_with_its_faces(field, device):
    places = torch.cat((REGION, REGION.mean(0, keepdim=True), REGION + torch.tensor([0, 0, 1e-9])))
    found = field.inside(places.to(device)).cpu()
    assert found.tolist() == [True, True, True, True, False]
    # A vertex of a lattice may miss the face that it lies on by a rounding.
    corner = torch.nextafter(REGION[1], REGION[1] + 1).to(device)
    assert bool(field.inside(corner))
    single = field.float()
    corner = torch.nextafter(single.region[1], single.region[1] + 1)
    assert bool(single.inside(corner))


def test_what_is_not_kept_is_silent(field, device):
    kept = torch.tensor([[0.05, 0.0, 0.1]], dtype=torch.float64, device=device)
    field.keep(kept, 0.05)
    # The lattice's vertex stands for half a spacing around it.
    shifts = torch.tensor([0.0, 0.024, 0.026], dtype=torch.float64, device=device)
    for axis in range(3):
        for sign in (1, -1):
            probe = kept.expand(3, 3).clone()
            probe[:, axis] += sign * shifts
            assert field.inside(probe).tolist() == [True, True, False]


@pytest.mark.parametrize("times", [2, 4])
def test_a_coarse_lattice_keeps_as_far_as_it_reaches(field, times):
    field.resolution = 0.05 / times
    kept = torch.tensor([[0.05, 0.0, 0.1]], dtype=torch.float64)
    field.keep(kept, 0.05)
    # Half a spacing on each side, rounded up to whole cells of the field.
    probe = kept + torch.tensor([[0.0249, 0, 0], [0, -0.0249, 0], [0, 0, 0.0249]]).double()
    assert field.inside(probe).all()
    # Not further than that and half a cell, on its own faces either way.
    far = 0.025 + 0.5 * field.resolution + 1e-4
    assert not field.inside(kept + far * torch.eye(3, dtype=torch.float64)).any()


def test_keeping_all_of_a_lattice_leaves_no_hole(field):
    steps = [torch.arange(float(a), float(b) + 1e-9, 0.05) for a, b in REGION.T]
    lattice = torch.stack(torch.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3).double()
    field.resolution = 0.0125
    field.keep(lattice, 0.05)
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(2000, 3, generator=generator, dtype=torch.float64)
    assert field.inside(REGION[0] + places * (REGION[1] - REGION[0])).all()


def test_what_is_kept_goes_with_the_weights(field):
    field.keep(torch.tensor([[0.05, 0.0, 0.1]], dtype=torch.float64), 0.05)
    other = CosineField(REGION, FREQUENCY)
    other.load_state_dict(field.state_dict())
    assert torch.equal(other.occupancy, field.occupancy)
    assert int(other.occupancy.sum()) == 1
    torch.testing.assert_close(other.cell, field.cell)
    # A second load, of another size, replaces it again.
    other.load_state_dict(CosineField(REGION, FREQUENCY).state_dict())
    assert other.occupancy.shape == (1, 1, 1)


def test_a_field_that_says_nothing_is_none():
    bare = Field(REGION, FREQUENCY)
    with pytest.raises(NotImplementedError):
        bare(REGION, REGION)
    with pytest.raises(NotImplementedError):
        _ = bare.resolution


def test_unless_a_field_says_so_every_place_answers_from_where_it_lies(field, device):
    places = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3], [0.05, 0.02, 0.15]]).double()
    places, directions = places.to(device), AXIS.to(device).expand(3, 3)
    bins = torch.tensor([2, 0], device=device)
    assert field.audible(places, places[:2] + 0.4).tolist() == [[True] * 3] * 2
    response, lead = field.echo(places, directions, bins)
    assert torch.equal(response, field.select(places, directions, bins))
    assert lead.tolist() == [0.0] * 3
    place = torch.tensor([2, 0, 0], device=device)
    named, lead = field.echo(places, directions, bins, place)
    assert torch.equal(named, field.select(places[place], directions, bins))
    assert lead.shape == (3,)


def test_how_far_the_fit_is_changes_nothing_unless_a_field_says_so(field):
    before = {name: value.clone() for name, value in field.state_dict().items()}
    field.advance(3, 10)
    after = field.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
