# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.field.field import sphere_directions
from sononerf.field.lobe import LobeField
from sononerf.field.lobe_correction import LARGEST, Correction, harmonics
from tests.field.lobes import REGION, fill, places_in

BINS = torch.tensor([2, 0])


def correction(region=REGION, spacing=0.005, width=8):
    torch.manual_seed(0)
    return Correction(region, spacing, width, 3).double()


def test_harmonics_are_orthonormal_over_the_sphere():
    values = harmonics(sphere_directions(20_000, REGION))
    expected = torch.eye(16, dtype=torch.float64)
    torch.testing.assert_close(values.T @ values / 20_000, expected, rtol=0, atol=1e-3)


def test_harmonics_of_a_degree_add_up_to_legendre_polynomials():
    """The addition theorem: over a degree, the sum of products is (2 l + 1) P_l(cos)."""
    one, two = sphere_directions(40, REGION), sphere_directions(40, REGION).roll(7, 0).flip(1)
    c = (one * two).sum(-1)
    legendre = (torch.ones_like(c), c, (3 * c**2 - 1) / 2, (5 * c**3 - 3 * c) / 2)
    parts = (harmonics(one) * harmonics(two)).split([1, 3, 5, 7], dim=-1)
    for degree, (part, expected) in enumerate(zip(parts, legendre, strict=True)):
        torch.testing.assert_close(part.sum(-1), (2 * degree + 1) * expected)


# Sides of 51, 40 and 27 mm, so that the longest wave is 102 mm; by halves to no less than:
@pytest.mark.parametrize(
    ("spacing", "waves"),
    [
        (0.005, [0.102, 0.051, 0.0255]),  # 20 mm
        (0.051 / 8, [0.102, 0.051, 0.0255]),  # 25.5 mm, reached
        (0.0064, [0.102, 0.051]),  # 25.6 mm
        (0.03, [0.12]),  # 120 mm
    ],
)
def test_waves_are_no_shorter_than_four_spacings(spacing, waves):
    made = correction(spacing=spacing)
    torch.testing.assert_close(2 * math.pi / made.waves, torch.tensor(waves).double())
    assert made.hidden[0].in_features == 6 * len(waves) + 16


def test_nothing_is_corrected_at_first():
    made = correction()
    found = made(places_in(5), sphere_directions(5, REGION), None)
    assert torch.equal(found, torch.zeros(5, 3).double())
    found.sum().backward()
    assert made.out.weight.grad.abs().min() > 0


def test_it_is_of_place_direction_and_frequency_and_bounded():
    made = fill(correction(), size=3.0)
    place, direction = places_in(1).expand(40, 3), sphere_directions(1, REGION).expand(40, 3)
    assert made(places_in(40), direction, None).std(0).min() > 0.05
    found = made(place, sphere_directions(40, REGION), None)
    assert found.std(0).min() > 0.05
    assert found.std(1).min() > 0.05
    with torch.no_grad():
        made.out.bias.copy_(torch.tensor([1e4, -1e4, 3.0]))
    found = made(place, direction, None)
    torch.testing.assert_close(found[:, 0], torch.full((40,), LARGEST).double())
    torch.testing.assert_close(found[:, 1], torch.full((40,), -LARGEST).double())


def test_some_frequencies_are_those_of_all():
    made = fill(correction())
    several = sphere_directions(15, REGION).reshape(3, 5, 3)
    found = made(places_in(5), several, BINS)
    assert found.shape == (3, 5, 2)
    torch.testing.assert_close(found, made(places_in(5), several, None)[..., BINS])
    torch.testing.assert_close(found[1], made(places_in(5), several[1], BINS))


def test_device_and_type_follow_the_network(device):
    made = correction(REGION.float()).float().to(device)
    places = places_in(5).float().to(device)
    found = made(places, sphere_directions(5, places), BINS.to(device))
    assert (found.device, found.dtype) == (places.device, torch.float32)


def test_gradients():
    made = fill(correction(width=4))
    given = places_in(4), sphere_directions(4, REGION), BINS
    names = [name for name, _ in made.named_parameters()]

    def response(*values):
        return torch.func.functional_call(made, dict(zip(names, values, strict=True)), given)

    assert torch.autograd.gradcheck(response, tuple(made.parameters()))


def test_moving_region_and_places_together_changes_nothing():
    shift = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    one, two = fill(correction()), fill(correction(REGION + shift))
    places, directions = places_in(20), sphere_directions(20, REGION)
    found = two(places + shift, directions, None)
    torch.testing.assert_close(found, one(places, directions, None), rtol=0, atol=1e-6)


def test_it_learns_at_the_rate_of_the_vertices():
    """A second lobe that comes and goes along x: all but a seventh of it in a hundred steps."""
    made = correction(width=16)
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(made.parameters(), lr=LobeField.learning_rate)
    for _ in range(100):
        places = REGION[0] + torch.rand(500, 3, generator=generator) * (REGION[1] - REGION[0])
        directions = torch.randn(500, 3, generator=generator, dtype=torch.float64)
        directions /= directions.norm(dim=1, keepdim=True)
        away = (2 * math.pi * places[:, :1] / 0.06).sin() * directions[:, 2:].clamp_min(0)
        wanted = away * torch.tensor([1.0, 2.0, -1.0])
        missed = (made(places, directions, None) - wanted).square().mean()
        optimizer.zero_grad()
        missed.backward()
        optimizer.step()
    assert missed < wanted.square().mean() / 7**2
