# SPDX-License-Identifier: MIT
import pytest
import torch

from sononerf.errors import SettingsError
from sononerf.field.field import lattice_over
from tests.field.lobes import REGION, fill, grid, places_in


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
