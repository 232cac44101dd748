# SPDX-License-Identifier: MIT
import math
from functools import partial

import numpy as np
import pytest
import torch

from sononerf.field.field import sphere_directions
from sononerf.field.fields import FourierField, GridField
from sononerf.field.profile import ProfileRenderer
from sononerf.field.renderer import Renderer, ShellRenderer, look_up
from sononerf.geometry.poses import look_at
from sononerf.head.ears import beam_gain, ear_tables
from sononerf.settings.schema import EarSettings

REGION = torch.tensor([[-0.03] * 3, [0.03] * 3], dtype=torch.float64)


def test_gains_between_the_nodes_are_bilinear(head, listener, device):
    directions = sphere_directions(200, REGION)
    found = look_up(listener.row_gains.beam.to(device), directions.reshape(4, 50, 3).to(device))
    assert found.shape == (4, 50, 3)
    expected = np.stack([head.towards(d)[0] for d in directions.numpy()])
    np.testing.assert_allclose(found.cpu().reshape(200, 3), expected, rtol=1e-12)
    left = look_up(listener.row_gains.ears[0], directions)
    expected = np.stack([head.towards(d)[1][0] for d in directions.numpy()])
    np.testing.assert_allclose(left, expected, rtol=1e-12)


def test_several_tables_are_looked_up_each_in_its_own_directions(listener):
    directions = sphere_directions(24, REGION).reshape(2, 3, 4, 3)
    found = look_up(listener.row_gains.ears, directions)
    each = [look_up(*pair) for pair in zip(listener.row_gains.ears, directions, strict=True)]
    assert found.shape == (2, 3, 4, 3)
    assert torch.equal(found, torch.stack(each))


def test_gains_are_those_that_the_simulator_hears_with():
    ears = ear_tables(EarSettings(), [30e3, 60e3])
    directions = sphere_directions(500, REGION)
    found = look_up(torch.from_numpy(ears.beam).double(), directions)
    # The simulator's table is kept in single precision as well.
    np.testing.assert_allclose(found, beam_gain(ears, directions.numpy()), rtol=1e-5, atol=1e-7)


def test_the_poles_and_the_back_are_in_the_table(listener):
    ends = torch.cat((torch.eye(3), 0.0 - torch.eye(3))).double()  # no -0, which turns azimuth
    gains = look_up(listener.row_gains.beam, ends)
    # Straight up the elevation's factor is 0.7, straight down 1.3; backwards 0.6 is left of 1.
    assert gains[2, 0] == pytest.approx(0.7)
    assert gains[5, 0] == pytest.approx(1.3)
    assert gains[3, 0] == pytest.approx(0.6)
    assert gains[0, 0] == pytest.approx(1.0)


def test_calibration_makes_the_energies_equal(listener):
    renderer = Renderer(REGION, listener).double()
    measured = torch.rand(2, 2, 5, 3, dtype=torch.float64)
    renderer.calibrate(measured / 40, measured)
    assert float(renderer.log_gain.detach().exp()) == pytest.approx(40)
    renderer.calibrate(2 * measured, measured)  # on top of what it was
    assert float(renderer.log_gain.detach().exp()) == pytest.approx(20)
    renderer.calibrate(0 * measured, 0 * measured)
    assert bool(renderer.log_gain.isfinite())


def test_only_the_first_step_calibrates_and_rendering_is_each_ones_own(listener):
    renderer = Renderer(REGION, listener)
    assert [renderer.prepare(None, None, step) for step in (0, 1, 100)] == [True, False, False]
    with pytest.raises(NotImplementedError):
        renderer(None, REGION, REGION, REGION)


@pytest.mark.parametrize("kind", [Renderer, ShellRenderer, ProfileRenderer])
def test_how_far_a_fit_has_come_matters_to_no_renderer_unless_it_is_told_to(listener, kind):
    renderer = kind(REGION, listener)
    before = {name: value.clone() for name, value in renderer.state_dict().items()}
    for step in (0, 5, 9):
        assert renderer.advance(step, 10) is None
    after = renderer.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(after[name], before[name]) for name in before)


FIELDS = {
    "grid": lambda region, f: GridField(region, f, spacing=0.02, levels=2),
    "angles": lambda region, f: FourierField(region, f, inputs="angles", octaves=4, width=16),
    "direction": lambda region, f: FourierField(region, f, octaves=4, width=16),
}


@pytest.mark.parametrize("kind", FIELDS)
@pytest.mark.parametrize(
    "heard_by",
    [partial(ShellRenderer, call_spectrum="learned"), ProfileRenderer],
    ids=["shell", "profile"],
)
def test_any_field_works_with_any_renderer(listener, kind, heard_by, device):
    torch.manual_seed(0)
    field = FIELDS[kind](REGION.float(), listener.frequency.float()).to(device)
    renderer = heard_by(REGION, listener).float().to(device)
    position = 0.28 * sphere_directions(3, REGION.float())
    rotation = torch.as_tensor(look_at(position.numpy(), np.zeros(3))).float().to(device)
    assert renderer.prepare(field, None, 0)
    rows = torch.arange(120, device=device).expand(3, -1)
    heard = renderer(field, position.to(device), rotation, rows)
    assert heard.shape == (3, 2, 120, 3)
    assert heard.dtype == torch.float32
    assert heard.device == rotation.device
    assert bool(heard.max() > 50 * heard.min())
    assert bool(heard.min() >= 0)
    heard.log1p().sum().backward()
    for module in (field, renderer):
        for name, parameter in module.named_parameters():
            assert parameter.grad is not None, name
            assert bool(parameter.grad.isfinite().all()), name
            assert parameter.grad.abs().max() > 0 or math.prod(parameter.shape) < 2, name
    assert int(renderer.points_evaluated) > 0


@pytest.mark.parametrize("heard_by", [ShellRenderer, ProfileRenderer])
def test_some_frequencies_are_rendered_as_among_all(listener, heard_by):
    torch.manual_seed(0)
    field = FIELDS["grid"](REGION.double(), listener.frequency).double()
    renderer = heard_by(REGION, listener).double()
    with torch.no_grad():
        renderer.log_spectrum.normal_()
    position = 0.28 * sphere_directions(3, REGION)
    rotation = torch.as_tensor(look_at(position.numpy(), np.zeros(3)))
    renderer.eval()
    renderer.prepare(field, None, 0)
    rows = torch.arange(120).expand(3, -1)
    with torch.no_grad():
        whole = renderer(field, position, rotation, rows)
        some = renderer(field, position, rotation, rows, torch.tensor([2, 0]))
    torch.testing.assert_close(some, whole[..., [2, 0]])
