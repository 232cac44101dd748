# SPDX-License-Identifier: MIT
"""The options of the profile renderer: sums with phase, and places that hide others."""

import math

import numpy as np
import pytest
import torch

from sononerf.errors import SettingsError
from sononerf.field import profile
from sononerf.field.grid import GridField
from sononerf.field.profile import FREE, ProfileRenderer
from sononerf.geometry.poses import look_at
from sononerf.settings.plugins import check_options
from tests.field.test_profile import (
    LEVEL_BACK,
    POSITION,
    REGION,
    ROTATION,
    bins_of,
    quiet,
    rows,
    smooth,
    tensors,
)

C = 343.0  # speed of sound of the listener, m/s
DISTANCE = 0.29
FINE = 0.004  # divides FREE


def with_phase(renderer):
    """Bring a coherent renderer to the second half of its fit."""
    renderer.advance(1, 2)
    assert bool(renderer.phased) == (renderer.mode == "coherent")
    return renderer


def point_head(renderer):
    """Emitter and ears at one place, no air, no window, all gains 1: only ways are left."""
    for buffer in (renderer.emitter, renderer.ear_positions, renderer.absorption):
        buffer.zero_()
    for buffer in (renderer.ears, renderer.beam):
        buffer.fill_(1.0)
    with torch.no_grad():
        renderer.log_kernel.zero_()
    return renderer


@pytest.fixture
def two_places(listener, formula):
    """Make field and renderer of two places, each of which is heard as 1 in ``POSITION``."""

    def make(apart, axis=0, **options):
        region = torch.zeros(2, 3, dtype=torch.float64)
        region[1] = 1e-4
        region[1, axis] = apart
        field = formula(
            region,
            listener.frequency,
            lambda x, u: (
                (x - x.new_tensor([DISTANCE, 0, 0]))
                .square()
                .sum(-1)[..., None]
                .expand(*u.shape[:-1], 3)
            ),
            spacing=apart,
        )
        renderer = point_head(quiet(ProfileRenderer(region, listener, **options)))
        renderer.prepare(field, None, 0)
        assert len(renderer.lattice) == 2
        return field, renderer

    return make


def heard_in_the_middle(field, renderer):
    """Magnitude where the window holds both places whole, (F,), the same for both ears."""
    heard = renderer(field, *tensors([DISTANCE, 0, 0], LEVEL_BACK), rows()).detach()[0]
    row = int((renderer.range - DISTANCE).abs().argmin())
    torch.testing.assert_close(heard[0], heard[1], rtol=1e-9, atol=1e-9)
    return heard[0, row].numpy()


@pytest.mark.parametrize("notch", [0, 1, 2])
def test_two_places_cancel_where_their_ways_differ_by_half_a_wave(head, two_places, notch):
    """Places d apart in range: |1 + exp(-4 pi i f d / c)|, which is 0 at f = c / 4d."""
    apart = C / (4 * head.frequency[notch])
    field, renderer = two_places(apart, mode="coherent")
    found = heard_in_the_middle(field, with_phase(renderer))
    expected = np.abs(1 + np.exp(-4j * np.pi * head.frequency * apart / C))
    # 4 pi f r / c is some thousand radians, of which double precision keeps 1e-12.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert found[notch] < 1e-9
    assert np.delete(found, notch).min() > 0.5


def test_two_places_side_by_side_add_up(two_places):
    """3 mm aside of the axis the way is 16 µm longer, at 80 kHz 0.05 rad: 2 cos(0.05 / 2)."""
    field, renderer = two_places(0.003, axis=1, mode="coherent")
    np.testing.assert_allclose(
        heard_in_the_middle(field, with_phase(renderer)), 2.0, rtol=0, atol=0.001
    )


@pytest.mark.parametrize("apart", [0.00107, 0.0029])
def test_without_phase_two_places_are_heard_as_their_power(two_places, apart):
    for options in ({}, {"mode": "power"}, {"mode": "coherent"}):  # the latter: not yet with phase
        found = heard_in_the_middle(*two_places(apart, **options))
        np.testing.assert_allclose(found, math.sqrt(2), rtol=1e-9)


def test_a_lead_turns_the_phase_as_well(head, two_places, monkeypatch):
    """What a place answers from nearer comes with the phase of the shorter way."""
    apart, lead = C / (4 * head.frequency[1]), 0.0006
    field, renderer = two_places(apart, mode="coherent")
    plain = field.echo

    def echo(positions, directions, bins, place, code):
        response, leads = plain(positions, directions, bins, place, code)
        return response, leads + lead * (positions[place][:, 0] > apart / 2).double()

    monkeypatch.setattr(field, "echo", echo)
    found = heard_in_the_middle(field, with_phase(renderer))
    expected = np.abs(1 + np.exp(-4j * np.pi * head.frequency * (apart + lead) / C))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_answers_of_complex_fields_turn_the_phase(listener, two_places):
    """A half turn of one of two places makes of a notch a peak."""
    apart = C / (4 * float(listener.frequency[1]))
    field, renderer = two_places(apart, mode="coherent")
    plain = field.function
    field.function = lambda x, u: plain(x, u) * torch.exp(1j * math.pi / apart * x[..., :1])
    found = heard_in_the_middle(field, with_phase(renderer))
    assert found[1] == pytest.approx(2.0, abs=1e-9)


@pytest.fixture
def one_place(listener, formula):
    """Make field and renderer of a single place that answers alike in all directions."""

    def make(place, mode):
        corner = torch.as_tensor(place, dtype=torch.float64)
        region = torch.stack((corner, corner + 0.001))
        field = formula(
            region,
            listener.frequency,
            lambda x, u: torch.full((*u.shape[:-1], 3), 3.0, dtype=u.dtype),
            spacing=0.01,
        )
        renderer = with_phase(quiet(ProfileRenderer(region, listener, mode=mode)))
        renderer.prepare(field, None, 0)
        return field, renderer

    return make


def test_of_a_single_place_phase_is_not_heard(one_place):
    heard = []
    for mode in ("power", "coherent"):
        field, renderer = one_place([0.004, 0.013, -0.006], mode)
        heard.append(renderer(field, *tensors(POSITION, ROTATION), rows(poses=2)).detach())
    # An echo lies between two bins of 2 samples: power p (1 - p) (W - W')^2, W the window's root,
    # is lost, with p (1 - p) at most 1/4 and W - W' at most 2 * 0.46 * 2 pi / 63 or, where the
    # window ends, 0.08: 0.2 % of the peak's power, 4 % of its magnitude where there is hardly any.
    power = heard[0].square()
    peak = power.amax(dim=2, keepdim=True)
    assert ((heard[1].square() - power).abs() <= 0.0022 * peak).all()
    assert peak.min() > 1
    inside = power > 0.3 * peak
    torch.testing.assert_close(heard[1][inside], heard[0][inside], rtol=0.004, atol=0)


def test_of_a_single_place_in_the_middle_of_a_bin_phase_is_not_heard_at_all(one_place):
    heard = []
    for mode in ("power", "coherent"):
        field, renderer = one_place([0.0, 0.0, 0.0], mode)
        renderer.emitter.zero_()
        renderer.ear_positions.zero_()
        renderer.first = DISTANCE - 80 * renderer.bin
        pose = tensors([DISTANCE, 0, 0], LEVEL_BACK)
        heard.append(renderer(field, *pose, rows()).detach())
    torch.testing.assert_close(heard[0], heard[1], rtol=1e-6, atol=1e-6)
    assert heard[0].max() > 1


@pytest.fixture
def cloud(listener, formula):
    """A smooth field on a lattice of 10 mm, 125 places, and its renderer with phase."""
    field = formula(REGION, listener.frequency, smooth, spacing=0.01)
    renderer = with_phase(quiet(ProfileRenderer(REGION, listener, mode="coherent")))
    renderer.prepare(field, None, 0)
    assert len(renderer.lattice) == 125
    return field, renderer


def test_many_places_with_phase_against_a_slow_loop(head, cloud):
    """Every slice is the window's root over all places, one after the other."""
    field, renderer = cloud
    position, rotation = POSITION[0], ROTATION[0]
    root = (renderer.log_kernel.detach() / 2).exp().numpy()
    root = np.concatenate((root[:, ::-1], np.ones((3, 1)), root), axis=1)
    reach = root.shape[1] // 2
    pressure = np.zeros((2, 120, 3), complex)
    for place in renderer.lattice.numpy():
        paths = place - position - (rotation @ np.vstack((head.emitter, head.ears)).T).T
        d = np.linalg.norm(paths, axis=1)
        value = smooth(torch.from_numpy(place), torch.from_numpy(-paths[0] / d[0])).numpy()
        beam, _ = head.towards(rotation.T @ paths[0])
        for ear in (0, 1):
            gain = head.towards(rotation.T @ paths[1 + ear])[1][ear]
            gain = gain * np.exp(-head.alpha * (d[0] + d[1 + ear]))
            middle = (d[0] + d[1 + ear]) / 2
            turned = np.exp(-4j * np.pi * head.frequency * middle / C)
            echo = value * beam * gain * turned / (d[0] * d[1 + ear])
            left, part = divmod((middle - head.range[0]) / (head.step / 2), 1)
            for fine, share in ((int(left), 1 - part), (int(left) + 1, part)):
                for row in range(120):
                    if abs(2 * row - fine) <= reach:
                        pressure[ear, row] += share * root[:, 2 * row - fine + reach] * echo
    found = renderer(field, *tensors(position, rotation), rows()).detach().numpy()[0]
    np.testing.assert_allclose(found, np.abs(pressure), rtol=0, atol=1e-6 * found.max())
    assert found.max() > 10


def test_a_sample_of_the_places_has_the_right_pressure_on_average(cloud):
    """Squared, weights of a sample would be too large; what is summed here is not yet squared."""
    field, renderer = cloud
    generator = torch.Generator().manual_seed(0)
    renderer.energy = 10 ** (4 * torch.rand(125, dtype=torch.float64, generator=generator) - 2)
    renderer.points = 30

    def pressure():
        which, weight = renderer._draw()
        pose = tensors(POSITION[0], ROTATION[0])
        with torch.no_grad():
            held, slices = renderer._profile(field, which, weight, *pose, torch.arange(3))
        first = slices.start * renderer.oversampling
        laid = held.new_zeros(*held.shape[:-1], bins_of(renderer))
        laid[..., first : first + held.shape[-1]] = held
        return laid

    renderer.eval()
    whole = pressure()
    renderer.train()
    torch.manual_seed(0)
    draws = torch.stack([pressure() for _ in range(300)])
    assert whole.shape == draws.shape[1:] == (2, 2, 3, 1, bins_of(renderer))
    error = (draws.mean(0) - whole).abs()
    deviation = draws.std(0) / math.sqrt(len(draws))
    loud = whole.abs() > 0.2 * whole.abs().amax()
    assert int(loud.sum()) > 50
    assert (error <= 5 * deviation)[loud].all()
    assert deviation[loud].div(whole.abs()[loud]).median() < 0.1  # so that the test can tell


def test_phase_comes_in_the_middle_of_the_fit_and_asks_for_the_gain_once(listener, formula):
    field = formula(REGION, listener.frequency, smooth, spacing=0.01)
    renderer = ProfileRenderer(REGION, listener, mode="coherent").double()
    asked, phased = [], []
    for step in range(11):
        renderer.advance(step, 11)
        asked.append(renderer.prepare(field, None, step))
        phased.append(bool(renderer.phased))
    # Half of eleven steps are over before the sixth, whose number is 6.
    assert phased == [False] * 6 + [True] * 5
    assert [step for step, changed in enumerate(asked) if changed] == [0, 6]


@pytest.mark.parametrize("prune_every", [3, 5])
def test_the_turn_is_told_of_in_a_step_that_prunes_as_well(listener, formula, prune_every):
    field = formula(REGION, listener.frequency, smooth, spacing=0.01)
    renderer = ProfileRenderer(REGION, listener, mode="coherent", prune_every=prune_every).double()
    asked = []
    for step in range(12):
        renderer.advance(step, 12)
        asked.append(renderer.prepare(field, None, step))
    assert [step for step, changed in enumerate(asked) if changed] == [0, 6]


def test_power_never_turns(listener, formula):
    field = formula(REGION, listener.frequency, smooth, spacing=0.01)
    renderer = ProfileRenderer(REGION, listener).double()
    assert renderer.mode == "power"
    asked = []
    for step in range(12):
        renderer.advance(step, 12)
        asked.append(renderer.prepare(field, None, step))
    assert asked == [True] + [False] * 11
    assert not renderer.phased


def test_phase_goes_with_the_weights(listener, cloud):
    field, renderer = cloud
    pose = tensors(POSITION[0], ROTATION[0])
    other = quiet(ProfileRenderer(REGION, listener, mode="coherent"))
    before = other.state_dict()
    other.load_state_dict(renderer.state_dict())
    assert before.keys() == renderer.state_dict().keys()
    assert torch.equal(other(field, *pose, rows()), renderer(field, *pose, rows()))
    # A fit that goes on behind the turn does not turn again.
    for step in (7, 8):
        other.advance(step, 10)
        assert not other.prepare(field, None, step)
    # One that goes on before it does.
    early = quiet(ProfileRenderer(REGION, listener, mode="coherent"))
    early.prepare(field, None, 0)
    resumed = quiet(ProfileRenderer(REGION, listener, mode="coherent"))
    resumed.load_state_dict(early.state_dict())
    resumed.advance(5, 10)
    assert resumed.prepare(field, None, 5)
    assert not torch.equal(early(field, *pose, rows()), renderer(field, *pose, rows()))


def test_gradients_of_sums_with_phase(listener, gradients_are_right):
    torch.manual_seed(0)
    field = GridField(REGION, listener.frequency, spacing=0.02, levels=1)
    with torch.no_grad():
        field.grids[0].normal_()
    renderer = with_phase(ProfileRenderer(REGION, listener, start=30, mode="coherent").double())
    renderer.prepare(field.double(), None, 0)
    with torch.no_grad():
        renderer.log_noise.fill_(-3.0)
    wanted = torch.tensor([[30, 45], [20, 60]])
    assert gradients_are_right(
        field, renderer, *tensors(POSITION, ROTATION), wanted, torch.tensor([0, 2])
    )


class Leading(torch.nn.Module):
    """Adds to each place's echo a lead of its own, which is learned."""

    def __init__(self, field, count):
        super().__init__()
        self.field = field
        generator = torch.Generator().manual_seed(0)
        lengths = 0.002 * torch.rand(count, dtype=torch.float64, generator=generator)
        self.lengths = torch.nn.Parameter(lengths)
        self.audible, self.code_of_lattice = field.audible, field.code_of_lattice

    def echo(self, positions, directions, bins, place, code):
        response, _ = self.field.echo(positions, directions, bins, place, code)
        return response, self.lengths[place]


def test_gradients_of_a_lead_go_through_the_phase(cloud, gradients_are_right):
    field, renderer = cloud
    renderer.alive[10:] = False
    field = Leading(field, 10)
    with torch.no_grad():
        renderer.log_noise.fill_(-3.0)
    poses, wanted = tensors(POSITION, ROTATION), torch.arange(60, 90, 3).expand(2, -1)
    assert gradients_are_right(field, renderer, *poses, wanted, torch.tensor([0, 2]))
    heard = renderer(field, *poses, wanted)
    (gradient,) = torch.autograd.grad(heard.sum(), field.lengths)
    assert (gradient.abs() > 1).all()


def test_the_options_are_checked():
    good = {"mode": "coherent", "occlusion": True}
    given = check_options(ProfileRenderer, good, where="renderer.options", given=2)
    assert {name: given[name] for name in good} == good
    plain = check_options(ProfileRenderer, {}, where="renderer.options", given=2)
    assert {name: plain[name] for name in good} == {"mode": "power", "occlusion": False}
    for wrong in ({"mode": "phase"}, {"occlusion": "perhaps"}):
        with pytest.raises(SettingsError, match=rf"renderer\.options\.{next(iter(wrong))}: "):
            check_options(ProfileRenderer, wrong, where="renderer.options", given=2)


def listening(field, monkeypatch):
    """Note which places are asked for their echoes, render after render."""
    heard, plain = [], field.echo

    def echo(positions, directions, bins, place, code):
        heard.append(positions[place])
        return plain(positions, directions, bins, place, code)

    monkeypatch.setattr(field, "echo", echo)
    return heard


@pytest.fixture
def front_and_back(listener, formula):
    """Make field and renderer of two places on the x axis, ``apart`` steps of 4 mm."""

    def make(apart, *, back=0.1, occlusion=True):
        corner = torch.tensor([0.032, 0.008, 0.008], dtype=torch.float64)
        region = torch.stack((-corner, corner))

        def two(places, directions):
            x, aside = places[..., 0], places[..., 1:].norm(dim=-1)
            value = torch.where((x.abs() < 0.001) & (aside < 0.001), 1.0, 1e-6)
            value = torch.where(((x + apart * FINE).abs() < 0.001) & (aside < 0.001), back, value)
            return value[..., None].expand(*directions.shape[:-1], 3)

        field = formula(region, listener.frequency, two, spacing=FINE)
        renderer = quiet(ProfileRenderer(region, listener, occlusion=occlusion, prune_every=1))
        renderer.emitter.zero_()
        renderer.prepare(field, None, 0)
        renderer.prepare(field, None, 1)
        assert int(renderer.alive.sum()) == 2
        return field, renderer

    return make


# From the front, from the back, and from three sides.
FRONT, BACK = [0.28, 0.0, 0.0], [-0.29, 0.0, 0.0]
ASIDE = [[0.0, 0.28, 0.0], [-0.02, 0.0, -0.28], [0.2, 0.2, 0.0]]


def from_there(position):
    return tensors(position, look_at(np.asarray(position), np.zeros(3)))


def test_a_strong_place_hides_what_lies_behind_it_and_only_from_there(front_and_back, monkeypatch):
    field, renderer = front_and_back(5)
    open_field, without = front_and_back(5, occlusion=False)
    heard = listening(field, monkeypatch)
    for position in (FRONT, BACK, *ASIDE):
        found = renderer(field, *from_there(position), rows())
        everything = without(open_field, *from_there(position), rows())
        if position == FRONT:
            np.testing.assert_allclose(heard[-1], [[0.0, 0.0, 0.0]], atol=1e-9)
            assert not torch.equal(found, everything)
            assert (found <= everything + 1e-12).all()
        else:  # the weak place throws no shadow, and beside its line the strong one throws none
            assert len(heard[-1]) == 2
            assert torch.equal(found, everything)


def test_a_place_as_strong_hides_from_the_other_side_as_well(front_and_back, monkeypatch):
    field, renderer = front_and_back(5, back=1.0)
    heard = listening(field, monkeypatch)
    for position, left in ((FRONT, 0.0), (BACK, -5 * FINE)):
        renderer(field, *from_there(position), rows())
        np.testing.assert_allclose(heard[-1], [[left, 0.0, 0.0]], atol=1e-9)


@pytest.mark.parametrize(("part", "hides"), [(1.05, True), (0.95, False)])
def test_what_is_weak_in_its_surroundings_hides_nothing(front_and_back, monkeypatch, part, hides):
    """By energy, which is the square of what a place answers."""
    field, renderer = front_and_back(5, back=math.sqrt(part * profile.OPAQUE))
    heard = listening(field, monkeypatch)
    renderer(field, *from_there(BACK), rows())
    assert len(heard[-1]) == (1 if hides else 2)


@pytest.mark.parametrize(("apart", "hidden"), [(1, False), (2, False), (4, True), (7, True)])
def test_the_places_of_one_surface_do_not_shade_each_other(
    front_and_back, monkeypatch, apart, hidden
):
    """Nothing within FREE, three steps of this lattice, shades a place."""
    assert pytest.approx(3 * FINE) == FREE
    field, renderer = front_and_back(apart)
    heard = listening(field, monkeypatch)
    renderer(field, *from_there(FRONT), rows())
    assert len(heard[-1]) == (1 if hidden else 2)


def test_what_lies_behind_a_pose_hides_nothing_from_it(front_and_back, monkeypatch):
    """A pose between the two, 12 mm from the weak place; the strong one is at its back."""
    field, renderer = front_and_back(5)
    heard = listening(field, monkeypatch)
    renderer(field, *tensors([-2 * FINE, 0.0, 0.0], LEVEL_BACK), rows())
    assert len(heard[-1]) == 2


@pytest.mark.parametrize("spacing", [0.008, 0.016, 0.032])
def test_on_a_coarse_lattice_too_no_place_shades_itself(listener, formula, monkeypatch, spacing):
    region = torch.tensor([[-0.032] * 3, [0.032] * 3], dtype=torch.float64)
    field = formula(region, listener.frequency, smooth, spacing=spacing)
    renderer = quiet(ProfileRenderer(region, listener, occlusion=True, prune_every=0))
    renderer.prepare(field, None, 0)
    heard = listening(field, monkeypatch)
    for direction in ([1.0, 0.0, 0.0], [0.6, 0.64, 0.48], [0.8, -0.6, 0.0]):
        for place in (0, len(renderer.lattice) // 2):
            renderer.opaque = torch.arange(len(renderer.lattice)) == place
            renderer(field, *from_there(0.3 * np.asarray(direction)), rows())
            there = torch.cdist(heard[-1], renderer.lattice[renderer.opaque]) < 1e-6
            assert there.any()


@pytest.mark.parametrize("at", [0.02, 0.028])
def test_a_wall_hides_what_is_behind_it_and_no_more(listener, formula, monkeypatch, at):
    """Lines from places to an oblique pose, cut with a wall of one layer, tell what is hidden.

    One wall lies in a face of the region, where lines end that pass beside it.
    """
    region = torch.tensor([[-0.028] * 3, [0.028] * 3], dtype=torch.float64)
    field = formula(region, listener.frequency, smooth, spacing=FINE)
    renderer = quiet(ProfileRenderer(region, listener, occlusion=True, prune_every=0))
    renderer.emitter.zero_()
    renderer.prepare(field, None, 0)
    x, y, z = renderer.lattice.T
    renderer.opaque = ((x - at).abs() < 1e-6) & (y.abs() < 0.0121) & (z.abs() < 0.0121)
    assert int(renderer.opaque.sum()) == 49
    heard = listening(field, monkeypatch)
    position = torch.tensor([0.25, 0.07, -0.05], dtype=torch.float64)
    renderer(field, *from_there(position.numpy()), rows())
    seen = torch.zeros(len(x), dtype=torch.bool)
    seen[torch.cdist(heard[-1], renderer.lattice).argmin(1)] = True
    behind = x < at - FREE - FINE
    way = (at - x) / (position[0] - x)
    cut = (renderer.lattice[:, 1:] + way[:, None] * (position[1:] - renderer.lattice[:, 1:])).abs()
    # The wall ends half a step beyond its last places; a look sees it within half a step of depth,
    # where the line is by up to 0.3 * 2 mm elsewhere.
    edge, slack = 0.012 + FINE / 2, 0.3 * FINE / 2 + 1e-4
    sure = behind & (cut.amax(1) < edge - slack)
    assert int(sure.sum()) > 300
    assert not seen[sure].any()
    beside = cut.amax(1) > edge + slack
    assert int((behind & beside).sum()) > 300
    assert seen[beside | (x > at)].all()


def test_without_the_option_nothing_is_hidden(listener, front_and_back):
    """To the bit, however opaque the places are."""
    assert not ProfileRenderer(REGION, listener).occlusion
    field, renderer = front_and_back(5, occlusion=False)
    assert renderer.opaque.any()
    pose = from_there(FRONT)
    with_shadows = renderer(field, *pose, rows())
    renderer.opaque = torch.zeros_like(renderer.opaque)
    without = renderer(field, *pose, rows())
    renderer.occlusion = True  # and where nothing is opaque, the option changes nothing
    assert torch.equal(with_shadows, without)
    assert torch.equal(renderer(field, *pose, rows()), without)
    renderer.opaque = renderer.alive.clone()
    assert not torch.equal(renderer(field, *pose, rows()), without)


def test_shadows_go_with_the_weights(listener, front_and_back):
    field, renderer = front_and_back(5)
    other_field, _ = front_and_back(5)
    other = ProfileRenderer(renderer.region, listener, occlusion=True).double()
    pose = from_there(FRONT)
    assert not len(other.opaque)
    other.load_state_dict(renderer.state_dict())
    assert torch.equal(other.opaque, renderer.opaque)
    assert int(other.opaque.sum()) == 1
    assert torch.equal(other(other_field, *pose, rows()), renderer(field, *pose, rows()))


def test_where_all_is_hidden_there_is_noise(front_and_back):
    field, renderer = front_and_back(5)
    with torch.no_grad():
        renderer.log_noise.fill_(-3.0)
    renderer.alive &= renderer.lattice[:, 0] < -0.001  # the strong place shades, and is not heard
    heard = renderer(field, *from_there(FRONT), rows())
    torch.testing.assert_close(heard, torch.full_like(heard, math.exp(-3)))
