# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import torch

from sononerf.field.renderer import ShellRenderer
from sononerf.geometry.poses import rotation_from_euler

REGION = torch.tensor([[-0.05, -0.06, -0.04], [0.05, 0.04, 0.06]], dtype=torch.float64)
POSITION = np.array([[0.28, 0.02, 0.01], [0.0, -0.3, 0.05]])
ROTATION = np.stack(
    [rotation_from_euler(np.pi + 0.1, 0.1, 0.05), rotation_from_euler(np.pi / 2, 0.2, -0.1)]
)
ROWS = torch.tensor([[0, 40, 80], [119, 60, 30]])


def complex_reflectivity(places, directions):
    """A smooth complex field that tells places, directions and frequencies apart."""
    phase = places @ places.new_tensor([40.0, -25.0, 60.0])
    tilt = 1 + directions @ directions.new_tensor([0.3, -0.5, 0.2])
    part = torch.arange(1, 4, dtype=places.dtype, device=places.device)
    return torch.polar(tilt[..., None] / part, phase[..., None] * part)


@pytest.fixture
def field(formula, listener):
    return formula(REGION, listener.frequency, complex_reflectivity)


@pytest.fixture
def renderer(listener):
    return ShellRenderer(REGION, listener).double()


def poses():
    return torch.from_numpy(POSITION), torch.from_numpy(ROTATION)


def slow(head, renderer, pose, row, told):
    """Equation 17 in a loop: sum over directions of field times ERTF, magnitude, by number."""
    sums = np.zeros((2, 3), dtype=complex)
    for direction in renderer.directions.numpy():
        world = ROTATION[pose] @ direction
        place = POSITION[pose] + head.range[row] * world
        if not ((place >= REGION[0].numpy()) & (place <= REGION[1].numpy())).all():
            continue
        seen = -world if told == "incidence" else -ROTATION[pose] @ [1.0, 0.0, 0.0]
        value = complex_reflectivity(torch.from_numpy(place), torch.from_numpy(seen)).numpy()
        beam, ears = head.towards(direction)
        sums += value * beam * ears
    return np.abs(sums) / len(renderer.directions)


@pytest.mark.parametrize("told", ["incidence", "sensor"])
def test_equation_17_against_a_slow_loop(head, listener, field, told):
    renderer = ShellRenderer(REGION, listener, direction=told).double()
    with torch.no_grad():
        renderer.log_gain.fill_(0.3)
        renderer.log_spectrum.copy_(torch.tensor([0.1, -0.2, 0.4]))
    found = renderer(field, *poses(), ROWS).detach().numpy()  # (P, E, R, F)
    scale = np.exp(0.3 + np.array([0.1, -0.2, 0.4]))
    expected = np.array(
        [[slow(head, renderer, p, int(r), told) * scale for r in ROWS[p]] for p in (0, 1)]
    ).transpose(0, 2, 1, 3)
    assert (expected.max(axis=(1, 3)) > 1e-3).sum() >= 4  # four of six slices meet the region
    # The table holds the product of beam and ear, which between its nodes is not quite bilinear;
    # the root's gradient at zero costs 1e-10.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=2e-10)


def test_six_hundred_even_directions_over_the_forward_hemisphere(renderer):
    directions = renderer.directions
    assert directions.shape == (600, 3)
    assert float(directions[:, 0].min()) > 0
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(600, dtype=torch.float64))
    # Evenly over a hemisphere the mean of x is 1/2 and that of y and z is 0.
    mean = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(directions.mean(0), mean, rtol=0, atol=2e-3)


def test_the_ears_are_not_apart_and_nothing_spreads(formula, listener):
    """A field that is 1 everywhere: every slice the same, whatever its range."""
    region = torch.tensor([[-2.0] * 3, [2.0] * 3], dtype=torch.float64)
    field = formula(region, listener.frequency, lambda x, u: x.new_ones(*x.shape[:-1], 3))
    renderer = ShellRenderer(region, listener).double()
    found = renderer(field, *poses(), ROWS)
    torch.testing.assert_close(found, renderer.transfer.mean(1)[None, :, None].expand(found.shape))


def test_what_lies_outside_costs_nothing(formula, listener, renderer):
    asked = []

    def ones(places, directions):
        asked.append(places)
        return places.new_ones(*places.shape[:-1], 3)

    renderer(formula(REGION, listener.frequency, ones), *poses(), ROWS)
    places = torch.cat(asked)
    assert ((places >= REGION[0]) & (places <= REGION[1])).all()
    assert 0 < len(places) < 0.2 * ROWS.numel() * 600
    assert int(renderer.points_evaluated) == len(places)


def test_the_mirrored_field_exchanges_the_ears(formula, listener):
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    region = torch.tensor([[-0.2] * 3, [0.2] * 3], dtype=torch.float64)
    # Many directions: the lattice itself is not its own mirror image.
    renderer = ShellRenderer(region, listener, directions=40_000).double()
    rotation = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))[None]
    position = torch.tensor([[0.28, 0.0, 0.0]], dtype=torch.float64)

    def smooth(places, directions):
        return (1 + places @ places.new_tensor([1.0, 4.0, -1.0]))[..., None].expand(
            *places.shape[:-1], 3
        )

    one, two = (
        renderer(formula(region, listener.frequency, function), position, rotation, ROWS[:1])
        for function in (smooth, lambda x, u: smooth(x * mirror, u * mirror))
    )
    torch.testing.assert_close(one, two.flip(1), rtol=0.005, atol=0)
    assert (one - two).abs().max() > 0.05 * one.max()
