# SPDX-License-Identifier: MIT
import math

import pytest
import torch

from sononerf.errors import SettingsError
from sononerf.field.field import sphere_directions
from sononerf.field.fields import FourierField
from sononerf.geometry.poses import rotation_from_euler

REGION = torch.tensor([[-0.1] * 3, [0.1] * 3], dtype=torch.float64)
FREQUENCY = torch.linspace(10e3, 100e3, 47, dtype=torch.float64)


def fourier(inputs="direction", frequencies=3, **options):
    torch.manual_seed(0)
    return FourierField(REGION, FREQUENCY[:frequencies], inputs=inputs, **options).double()


def places_in(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * 0.2 - 0.1


BOTH = pytest.mark.parametrize("inputs", ["direction", "angles"])


def test_the_published_code_has_546324_parameters():
    """544,990 in layers and 1,334 in what batch normalisation amounts to."""
    field = fourier("angles", 47)
    assert sum(p.numel() for p in field.parameters()) == 546_324
    layers = [m for m in field.modules() if isinstance(m, torch.nn.Linear)]
    assert sum(p.numel() for m in layers for p in m.parameters()) == 544_990
    # 155 values in, 411 after the first skip, 356 after the second, 94 out.
    assert [m.in_features for m in layers] == [155, 256, 256, 256, 411, 256, 356, 256, 128]
    assert layers[-1].out_features == 94


def test_the_paper_has_about_half_a_million():
    field = fourier("direction", 47)
    layers = [m for m in field.modules() if isinstance(m, torch.nn.Linear)]
    assert layers[0].in_features == 180  # six inputs, 30 sines each
    assert 480_000 < sum(p.numel() for p in field.parameters()) < 600_000


def assert_sines(found, numbers, base, count):
    """Compare with sin(base^k pi x); the frequencies are kept in single precision."""
    for row, x in zip(found.reshape(len(numbers), count).tolist(), numbers, strict=True):
        for k, value in enumerate(row):
            phase = base**k * math.pi * x
            assert value == pytest.approx(math.sin(phase), abs=(k + 4) * 2**-24 * abs(phase))


@BOTH
def test_the_layers_see_the_stated_sines(inputs):
    field = fourier(inputs, octaves=30, width=8)
    seen = {}
    field.trunk[0].register_forward_pre_hook(lambda _, given: seen.update(first=given[0]))
    field.branch[0].register_forward_pre_hook(lambda _, given: seen.update(skip=given[0]))
    field.head[0].register_forward_pre_hook(lambda _, given: seen.update(last=given[0]))
    # Looking along yaw 40°, pitch 25° (down); the direction to the emitter is the reverse.
    yaw, pitch = math.radians(40), math.radians(25)
    look = torch.as_tensor(rotation_from_euler(yaw, pitch, 0.0)[:, 0])
    place = [0.01, -0.02, 0.03]
    field(torch.tensor([place], dtype=torch.float64), -look[None])
    numbers = place + ([pitch, yaw] if inputs == "angles" else (-look).tolist())
    first = seen["first"][0]
    if inputs == "angles":
        assert first[:5].tolist() == pytest.approx(numbers)
        assert_sines(first[5:], numbers, math.sqrt(2), 30)
        assert_sines(seen["last"][0, 8:], numbers, 2.0, 20)
    else:
        assert_sines(first, numbers, math.sqrt(2), 30)
        assert torch.equal(seen["last"][0, 8:], first)
    assert torch.equal(seen["skip"][0, 8:], first)


def test_the_scale_multiplies_positions_alone():
    field = fourier(octaves=3, width=8, scale=2.0)
    plain = fourier(octaves=3, width=8)
    plain.load_state_dict(field.state_dict())
    places, directions = places_in(5) / 2, sphere_directions(5, REGION)
    torch.testing.assert_close(field(places, directions), plain(2 * places, directions))


def test_the_codes_network_has_no_direction_to_embed():
    with pytest.raises(SettingsError, match=r"direction_octaves is of inputs direction"):
        fourier("angles", direction_octaves=3)


@BOTH
def test_products_in_half_precision_answer_alike_and_learn(inputs):
    exact = fourier(inputs, 5, octaves=6, width=64).float()
    field = fourier(inputs, 5, octaves=6, width=64, precision="bfloat16").float()
    field.load_state_dict(exact.state_dict())
    places, directions = places_in(200).float(), sphere_directions(200, REGION).float()
    true, found = exact(places, directions), field(places, directions)
    assert found.dtype == torch.complex64
    differ = (found - true).detach().abs().max() / true.detach().abs().max()
    # bfloat16 keeps eight bits: each product is good to 0.4 %, and nine layers add them up.
    assert 1e-5 < float(differ) < 0.03
    found.abs().sum().backward()
    true.abs().sum().backward()
    for (name, ours), theirs in zip(field.named_parameters(), exact.parameters(), strict=True):
        assert ours.grad.dtype == torch.float32, name
        assert float((ours.grad - theirs.grad).norm() / theirs.grad.norm()) < 0.1, name
