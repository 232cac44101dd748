# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.field.renderer import Deposit, Window, _band


def test_gradients_of_the_deposit_where_some_places_lie_outside_the_bins():
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(2, 7, dtype=torch.float64, generator=generator, requires_grad=True)
    at = torch.tensor([-0.7, 0.2, 1.6, 3.9, 4.4, 2.5, 9.0], dtype=torch.float64)
    row = torch.tensor([0, 0, 0, 1, 1, 2, 2])
    expected = torch.zeros(2, 3, 5, dtype=torch.float64)
    for place, (where, line) in enumerate(zip(at.tolist(), row.tolist(), strict=True)):
        left = math.floor(where)
        if 0 <= left < 4:
            expected[:, line, left] += values[:, place].detach() * (left + 1 - where)
            expected[:, line, left + 1] += values[:, place].detach() * (where - left)
    torch.testing.assert_close(Deposit.apply(values, at, row, 3, 5).detach(), expected)
    for places in (at, torch.stack((at, at + 0.05))):
        places.requires_grad_()
        assert torch.autograd.gradcheck(
            lambda v, a: Deposit.apply(v, a, row, 3, 5), (values, places)
        )


@pytest.mark.parametrize("step", [1, 2, 3])
def test_the_windows_gradients_are_those_of_a_plain_convolution(step):
    generator = torch.Generator().manual_seed(0)
    kernel = torch.rand(3, 5, dtype=torch.float64, generator=generator, requires_grad=True)
    seen = torch.rand(
        2, 3, 4, 6 * step + 5, dtype=torch.float64, generator=generator, requires_grad=True
    )
    _band.cache_clear()
    with torch.inference_mode():  # what is kept from a prediction serves a fit too
        Window.apply(seen, kernel, step)
    found = Window.apply(seen, kernel, step)
    one_by_one = seen.movedim(1, 2).flatten(0, 1)
    expected = torch.nn.functional.conv1d(one_by_one, kernel[:, None], stride=step, groups=3)
    expected = expected.unflatten(0, (2, 4)).movedim(2, 1)
    torch.testing.assert_close(found, expected)
    assert found.shape == (2, 3, 4, 7)
    weight = torch.rand(found.shape, dtype=torch.float64, generator=generator)
    for mine, theirs in zip(
        torch.autograd.grad(found, (seen, kernel), weight),
        torch.autograd.grad(expected, (seen, kernel), weight),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs)
