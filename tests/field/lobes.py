# SPDX-License-Identifier: MIT
"""Small fields of lobes, alike in region and spacing."""

import torch

from sononerf.field.fields import GridField

# 51, 40 and 27 mm: in steps of 10 mm 7 x 5 x 4 vertices, in steps of 20 mm 4 x 3 x 3.
REGION = torch.tensor([[-0.03, 0.01, 0.2], [0.021, 0.05, 0.227]], dtype=torch.float64)
FREQUENCY = torch.tensor([30e3, 50e3, 70e3], dtype=torch.float64)


def grid(region=REGION, frequency=FREQUENCY, *, seed=0, **options):
    torch.manual_seed(seed)
    return GridField(region, frequency, **{"spacing": 0.01, "levels": 2, **options}).double()


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


def say(field, *code):
    """Make a field put out the same code everywhere; numbers that are not given are zero."""
    code = torch.tensor([*code, *[0.0] * (5 + field.rank - len(code))])
    with torch.no_grad():
        for values in field.grids:
            values.zero_()
        field.grids[0][0] = code[:, None, None, None]
    return field
