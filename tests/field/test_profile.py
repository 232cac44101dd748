# SPDX-License-Identifier: MIT
import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh

from sononerf.field.fields import FourierField, GridField
from sononerf.field.profile import ProfileRenderer
from sononerf.geometry.meshes import Plane
from sononerf.geometry.poses import look_at, rotation_from_euler
from sononerf.run.simulate import head_of, simulator_of
from sononerf.scene.scene import Scene
from sononerf.settings.loading import validate_settings
from tests.field.lobes import fill, grid

REGION = torch.tensor([[-0.02, -0.03, -0.01], [0.02, 0.01, 0.03]], dtype=torch.float64)
POSITION = np.array([[0.29, 0.02, 0.01], [0.0, -0.28, 0.05]])
ROTATION = np.stack(
    [rotation_from_euler(np.pi + 0.1, 0.1, 0.05), rotation_from_euler(np.pi / 2, 0.2, -0.1)]
)
LEVEL_BACK = np.diag([-1.0, -1.0, 1.0])  # looks along -x, upright


def rows(count=120, poses=1):
    return torch.arange(count).expand(poses, -1)


def tensors(position, rotation):
    return torch.as_tensor(np.atleast_2d(position)), torch.as_tensor(np.atleast_3d(rotation)).view(
        -1, 3, 3
    )


def quiet(renderer):
    with torch.no_grad():
        renderer.log_noise.fill_(-25.0)
    return renderer.double()


@pytest.fixture
def one_place(listener, formula):
    """Make field and renderer of a single place that answers alike in all directions."""

    def make(place, strength=1.0, **options):
        corner = torch.as_tensor(place, dtype=torch.float64)
        region = torch.stack((corner, corner + 0.001))
        field = formula(
            region,
            listener.frequency,
            lambda x, u: torch.full((*u.shape[:-1], 3), strength, dtype=u.dtype),
            spacing=0.01,
        )
        renderer = quiet(ProfileRenderer(region, listener, **options))
        assert renderer.prepare(field, None, 0)
        assert len(renderer.lattice) == 1
        return field, renderer

    return make


def smooth(places, directions):
    """Real reflectivity that tells places, directions and frequencies apart."""
    tilt = 1 + directions @ directions.new_tensor([0.2, 0.6, 0.1])
    shape = 1 + places @ places.new_tensor([9.0, -25.0, 5.0])
    return (tilt * shape)[..., None] * places.new_tensor([1.0, 0.7, 0.4])


def test_on_a_support_a_place_is_heard_by_way_of_the_images_too(head, listener, formula):
    """Once directly, once by both ways that meet the support once, and once by both images."""
    plane = Plane.through(np.array([0.0, 0.0, -0.06]), np.array([0.1, 0.0, 1.0]))
    place = np.array([0.004, 0.013, -0.006])
    region = torch.as_tensor(np.stack((place, place + 0.001)))
    told = []

    def field_of(places, directions):
        told.append(directions.reshape(-1, 3).numpy())
        return torch.ones(*directions.shape[:-1], 3, dtype=directions.dtype)

    field = formula(region, listener.frequency, field_of, spacing=0.01)
    renderer = quiet(ProfileRenderer(region, dataclasses.replace(listener, plane=plane)))
    renderer.prepare(field, None, 0)
    told.clear()
    position, rotation = POSITION[0], ROTATION[0]
    heard = renderer(field, *tensors(position, rotation), rows()).detach().numpy()[0]
    emitter, image = position + rotation @ head.emitter, plane.mirrored(place)
    # The emitter, the middle between it and its image, and the image.
    foot = emitter - plane.height(emitter) * np.asarray(plane.normal)
    for directions, seen in zip(told, (emitter, foot, plane.mirrored(emitter)), strict=True):
        way = (seen - place) / np.linalg.norm(seen - place)
        np.testing.assert_allclose(directions, way[None], atol=1e-6)

    def level(sent, received, ear):
        """Level and range of sound that goes out to one place and comes back from another."""
        out = sent - emitter
        back = received - position - rotation @ head.ears[ear]
        d1, d2 = np.linalg.norm(out), np.linalg.norm(back)
        gain = head.towards(rotation.T @ out)[0] * head.towards(rotation.T @ back)[1][ear]
        return np.exp(-head.alpha * (d1 + d2)) * gain / (d1 * d2), (d1 + d2) / 2

    for ear in (0, 1):
        ways = {a + b: level(*pair, ear) for a, b, pair in (
            ("place", "place", (place, place)), ("image", "image", (image, image)),
        )}  # fmt: skip
        once = [level(place, image, ear), level(image, place, ear)]
        ways["once"] = sum(each[0] for each in once), np.mean([each[1] for each in once])
        for expected, at in ways.values():
            near = np.abs(head.range - at) < head.step
            np.testing.assert_allclose(heard[ear][near].max(axis=0), expected, rtol=0.02)
        assert ways["placeplace"][1] + 0.01 < ways["once"][1] < ways["imageimage"][1] - 0.01


@pytest.fixture
def cloud(listener, formula):
    """A smooth field on a lattice of 10 mm, 125 places, and its renderer."""
    field = formula(REGION, listener.frequency, smooth, spacing=0.01)
    renderer = quiet(ProfileRenderer(REGION, listener))
    renderer.prepare(field, None, 0)
    assert len(renderer.lattice) == 125
    return field, renderer


@pytest.mark.parametrize("oversampling", [1, 2, 4])
def test_one_place_sounds_as_the_window(head, one_place, oversampling):
    """At (d + d') / 2, spread by 1 / (d d'), damped by the air, times the gains of its paths."""
    place = np.array([0.004, 0.013, -0.006])
    field, renderer = one_place(place, strength=3.0, oversampling=oversampling)
    with torch.no_grad():
        renderer.log_gain.fill_(math.log(2.0))
        renderer.log_spectrum.copy_(torch.tensor([0.0, 0.1, -0.3]))
    position, rotation = POSITION[0], ROTATION[0]
    heard = renderer(field, *tensors(position, rotation), rows()).detach().numpy()[0]
    out = place - position - rotation @ head.emitter
    beam, _ = head.towards(rotation.T @ out)
    peaks = []
    for ear in (0, 1):
        back = place - position - rotation @ head.ears[ear]
        d1, d2 = np.linalg.norm(out), np.linalg.norm(back)
        gain = beam * head.towards(rotation.T @ back)[1][ear]
        level = 3.0 * 2.0 * np.exp([0.0, 0.1, -0.3] - head.alpha * (d1 + d2)) * gain / (d1 * d2)
        offset = (head.range - (d1 + d2) / 2) / head.per_sample
        window = np.interp(offset + 31.5, np.arange(64), head.window, left=0, right=0)
        expected = window[:, None] * level
        # The window ends with a step, which is smeared over a bin.
        sure = np.abs(np.abs(offset) - 31.5) > 4 / oversampling
        # Laying an echo between two bins of 2 or 1 samples costs h² / 8 of the curvature, at the
        # peak 0.92 (2 π / 63)² of power; for 4 samples that is 2 % of power.
        tolerance = {1: 0.011, 2: 0.003, 4: 0.0015}[oversampling] * expected.max()
        inside = sure & (np.abs(offset) < 31.5)
        np.testing.assert_allclose(heard[ear][inside], expected[inside], rtol=0, atol=tolerance)
        # Beyond the window a skirt 39 dB down may be learned on.
        beyond = heard[ear][sure & ~inside]
        assert (beyond < 0.012 * expected.max(axis=0)).all()
        assert (heard[ear][np.abs(offset) > 70] < 1e-9).all()
        assert expected.max() > 5 * tolerance
        peaks.append((d1 + d2) / 2)
    # 10 mm off the axis, the ears hear it 0.9 mm of range apart, more than a slice.
    assert abs(peaks[0] - peaks[1]) > head.step
    found = [(head.range[:, None] * e**2).sum(0) / (e**2).sum(0) for e in heard]
    np.testing.assert_allclose(found, np.array(peaks)[:, None].repeat(3, 1), atol=2e-5)


def test_each_frequency_has_a_window_of_its_own(listener, one_place):
    """A sweep's echo is longer where it sweeps slowly; beyond its end a skirt may be learned."""
    offset = torch.arange(-100, 101, dtype=torch.float64)
    width = torch.tensor([15.0, 30.0, 45.0], dtype=torch.float64)
    window = (-0.5 * (offset / width[:, None]) ** 2).exp()
    known = dataclasses.replace(listener, window=window)
    _, renderer = one_place(np.zeros(3))
    made = quiet(ProfileRenderer(renderer.region, known))
    assert made.log_kernel.shape == (3, 66)  # 100 samples and 31 µs more, in bins of 2 samples
    bins = torch.arange(1, 51)
    expected = -((2 * bins / width[:, None]) ** 2)  # of power, in nepers
    found = made.log_kernel[:, :50].detach()
    torch.testing.assert_close(found, expected.clamp_min(-9.0), rtol=1e-5, atol=1e-5)
    assert (made.log_kernel[:, 50:] == -9.0).all()


def test_a_sweeps_rows_hear_a_place_by_their_lag_farther_off(head, listener, one_place):
    def lag(azimuth, elevation):
        return np.array([-0.002, 0.0, 0.005]) * (1 + azimuth) * (1 - elevation)

    place = np.array([0.004, 0.013, -0.006])
    table = [[lag(a, e) for a in np.linspace(-1, 1, 181)] for e in np.linspace(-1, 1, 91)]
    one = torch.from_numpy(np.array(table)).permute(2, 0, 1)
    field, renderer = one_place(place)
    known = dataclasses.replace(listener, lag=torch.stack((one, -one)))
    lagging = quiet(ProfileRenderer(renderer.region, known))
    lagging.prepare(field, None, 0)
    middles = []
    for heard_by in (renderer, lagging):
        power = heard_by(field, *tensors(POSITION[0], ROTATION[0]), rows())[0].detach() ** 2
        middles.append(np.einsum("r,erf->ef", head.range, power) / power.sum(1).numpy())
    for ear, sign in ((0, 1), (1, -1)):
        x, y, z = ROTATION[0].T @ (place - POSITION[0]) - head.ears[ear]
        azimuth = math.atan2(y, x) / math.pi
        elevation = math.asin(z / math.hypot(x, y, z)) / (math.pi / 2)
        found = middles[1][ear] - middles[0][ear]
        np.testing.assert_allclose(found, sign * lag(azimuth, elevation), atol=3e-5)


LOBES = pytest.mark.parametrize("make", [grid])


def heard_by_lobes(make, listener, **options):
    """A field with a code for each place, and its renderer, with what it makes of two poses."""
    field = fill(make(REGION, listener.frequency), size=0.3)
    renderer = quiet(ProfileRenderer(REGION, listener, **options))
    renderer.prepare(field, None, 0)
    return field, renderer, lambda: renderer(field, *tensors(POSITION, ROTATION), rows(poses=2))


# Ranges run from 0.25 to 0.33 m: in their midst, across either end, and beyond them.
@LOBES
def test_what_is_heard_follows_the_places_that_are_alive(make, listener):
    _, renderer, hear = heard_by_lobes(make, listener)
    silent = torch.zeros_like(renderer.kept)
    few = silent.clone()
    few[:3] = True
    heard = [hear()]
    renderer.kept[3:] = False  # in place
    heard.append(hear())
    renderer.kept = ~few  # another tensor, as often changed as the first when it was new
    heard.append(hear())
    torch.testing.assert_close(heard[1] ** 2 + heard[2] ** 2, heard[0] ** 2)
    assert not torch.equal(heard[1], heard[2])
    renderer.kept = silent
    assert hear().max() < 1e-10


@LOBES
def test_a_sample_has_the_right_power_on_average(make, listener):
    """Some of the places that are loudest in the books being dead."""
    _, renderer, hear = heard_by_lobes(make, listener, points=25)
    renderer.energy = torch.linspace(1, 2, 125, dtype=torch.float64) ** 4
    renderer.kept[60:80] = renderer.kept[120:] = False
    renderer.eval()
    whole = hear().detach() ** 2
    renderer.train()
    torch.manual_seed(0)
    draws = torch.stack([hear().detach() ** 2 for _ in range(200)])
    loud = whole > 0.2 * whole.amax()
    deviation = draws.std(0) / math.sqrt(len(draws))
    assert ((draws.mean(0) - whole).abs() <= 5 * deviation)[loud].all()
    assert (deviation / whole)[loud].median() < 0.05  # so that the test can tell


def test_doubling_the_range_divides_by_four(listener, one_place):
    """Pressure falls with the product of both ways, here d²; the air's part is taken out."""
    levels = []
    for distance in (0.145, 0.29):
        field, renderer = one_place(np.zeros(3))
        renderer.first -= 0.25 - 0.13  # ranges from 0.13 m
        renderer.emitter.zero_()
        renderer.ear_positions.zero_()
        renderer.absorption.zero_()
        renderer.first += distance - 0.145  # both echoes at one place of the axis
        heard = renderer(field, *tensors([distance, 0, 0], LEVEL_BACK), rows())
        levels.append(heard.amax(dim=2))
    torch.testing.assert_close(levels[0], 4 * levels[1], rtol=1e-6, atol=0)


def test_emitter_and_ear_may_be_exchanged(one_place):
    """Reciprocity: with gains that are alike, the way there is the way back."""
    field, renderer = one_place([0.0, 0.015, 0.01])
    ones = torch.ones_like(renderer.ears)
    renderer.ears, renderer.beam = ones, ones[0]
    there = renderer(field, *tensors(POSITION[0], ROTATION[0]), rows())[:, 0]
    emitter = renderer.emitter.clone()
    renderer.emitter = renderer.ear_positions[0].clone()
    renderer.ear_positions[0] = emitter
    back = renderer(field, *tensors(POSITION[0], ROTATION[0]), rows())[:, 0]
    torch.testing.assert_close(there, back, rtol=1e-9, atol=1e-9)


def test_the_mirrored_scene_exchanges_the_ears(listener, formula):
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    region = torch.tensor([[-0.02] * 3, [0.02] * 3], dtype=torch.float64)
    heard = []
    for function in (smooth, lambda x, u: smooth(x * mirror, u * mirror)):
        field = formula(region, listener.frequency, function, spacing=0.01)
        renderer = quiet(ProfileRenderer(region, listener))
        renderer.prepare(field, None, 0)
        heard.append(renderer(field, *tensors([0.28, 0, 0.01], LEVEL_BACK), rows()))
    torch.testing.assert_close(heard[0], heard[1].flip(1), rtol=1e-9, atol=1e-9)
    assert (heard[0] - heard[1]).abs().max() > 0.05 * heard[0].max()


def test_turning_scene_and_head_together_changes_nothing(listener, formula):
    turn, shift = rotation_from_euler(np.pi / 2, 0.0, 0.0), np.array([1.0, -2.0, 0.5])
    turned = torch.from_numpy(turn)
    region = torch.tensor([[-0.02] * 3, [0.02] * 3], dtype=torch.float64)
    moved = region + torch.from_numpy(shift)

    def elsewhere(places, directions):
        return smooth((places - torch.from_numpy(shift)) @ turned, directions @ turned)

    heard = []
    for box, function, where, rotation in (
        (region, smooth, POSITION[0], ROTATION[0]),
        (moved, elsewhere, turn @ POSITION[0] + shift, turn @ ROTATION[0]),
    ):
        field = formula(box, listener.frequency, function, spacing=0.01)
        renderer = quiet(ProfileRenderer(box, listener))
        renderer.prepare(field, None, 0)
        heard.append(renderer(field, *tensors(where, rotation), rows()))
    torch.testing.assert_close(*heard, rtol=1e-9, atol=1e-9)


def test_silence_in_only_noise_out(listener, formula):
    field = formula(REGION, listener.frequency, lambda x, u: 0 * smooth(x, u), spacing=0.01)
    renderer = ProfileRenderer(REGION, listener).double()
    renderer.prepare(field, None, 0)
    heard = renderer(field, *tensors(POSITION, ROTATION), rows(poses=2))
    # The noise starts at exp(-16), and the power's floor of 1e-24 lies below it.
    torch.testing.assert_close(heard, torch.full_like(heard, math.exp(-16)), rtol=1e-6, atol=0)


def test_what_is_out_of_range_is_not_heard(one_place):
    field, renderer = one_place(np.zeros(3))
    for far in (0.1, 0.22, 0.36, 2.0):
        heard = renderer(field, *tensors([far, 0, 0], LEVEL_BACK), rows())
        assert heard.max() < 1e-8


def test_slices_and_frequencies_are_those_asked_for(cloud):
    field, renderer = cloud
    poses = tensors(POSITION, ROTATION)
    whole = renderer(field, *poses, rows(poses=2))
    wanted, bins = torch.tensor([[0, 40, 80], [119, 60, 30]]), torch.tensor([2, 0])
    some = renderer(field, *poses, wanted, bins)
    assert some.shape == (2, 2, 3, 2)
    for pose in (0, 1):
        torch.testing.assert_close(some[pose], whole[pose][:, wanted[pose]][..., bins])
    # All of them in another order, too.
    backwards = renderer(field, *poses, rows(poses=2).flip(1))
    torch.testing.assert_close(backwards, whole.flip(2))


def test_a_sample_of_the_places_is_right_on_average(cloud):
    field, renderer = cloud
    # What was loud once weighs more, whether or not it still is.
    generator = torch.Generator().manual_seed(0)
    renderer.energy = 10 ** (4 * torch.rand(125, dtype=torch.float64, generator=generator) - 2)
    poses = tensors(POSITION[0], ROTATION[0])
    renderer.points = 30
    whole = renderer.eval()(field, *poses, rows()).square()
    renderer.train()
    torch.manual_seed(0)
    with torch.no_grad():
        draws = torch.stack([renderer(field, *poses, rows()).square() for _ in range(600)])
    error = (draws.mean(0) - whole).abs()
    deviation = draws.std(0) / math.sqrt(len(draws))
    loud = whole > 0.05 * whole.max()
    assert (error <= 5 * deviation)[loud].all()
    assert deviation[loud].div(whole[loud]).median() < 0.05  # so that the test can tell
    assert not torch.equal(draws[0], draws[1])
    assert int(renderer.points_evaluated) == 600 * 30  # in training alone


def test_only_possible_places_are_laid(listener, formula):
    field = formula(REGION, listener.frequency, smooth, spacing=0.01)
    asked = []

    def right(places, tolerance):
        asked.append(tolerance)
        return places[:, 1] > -0.011

    renderer = ProfileRenderer(REGION, listener).double()
    renderer.prepare(field, right, 0)
    assert len(renderer.lattice) == 75
    assert asked == [pytest.approx(0.01 * math.sqrt(3) / 2)]  # half of a cell's diagonal
    assert not field.inside(torch.tensor([[0.0, -0.02, 0.0]], dtype=torch.float64)).any()


def ball(places, directions):
    """Loud within 6.2 mm of the origin, hardly anything elsewhere."""
    inside = places.norm(dim=-1) < 0.0062
    return torch.where(inside, 1.0, 1e-6)[..., None].expand(*directions.shape[:-1], 3)


@pytest.mark.parametrize(("loud", "other"), [(0, 5), (-1, 40), (100, 99)])
def test_a_place_60_db_below_its_surroundings_is_dropped(listener, formula, loud, other):
    """And one 50 dB below them is not, nor one far away: cubes of five resolutions count."""
    region = torch.tensor([[0.03, -0.02, 0.01], [0.11, 0.03, 0.14]], dtype=torch.float64)
    known = torch.full((2, 3), 9.0, dtype=torch.float64)

    def heard(places, directions):
        near = torch.cdist(places.reshape(-1, 3), known) < 1e-6
        level = torch.where(near[:, 0], 0.0, torch.where(near[:, 1], -50.0, -65.0)) / 20
        value = (10**level).reshape(places.shape[:-1]).double()
        return value[..., None].expand(*directions.shape[:-1], 3)

    renderer = ProfileRenderer(region, listener, prune_every=1).double()
    field = formula(region, listener.frequency, heard, spacing=0.01)
    renderer.prepare(field, None, 0)
    known[:] = renderer.lattice[[loud, other]]
    renderer.prepare(field, None, 1)
    cube = ((renderer.lattice - region[0]) / (5 * listener.resolution)).floor()
    dropped = ((cube - cube[loud]).abs() <= 1).all(-1)
    dropped[[loud, other]] = False
    assert 20 < dropped.sum() < len(dropped) - 20
    assert torch.equal(renderer.kept, ~dropped)


def test_the_lattice_goes_with_the_weights(listener, formula, cloud):
    field, renderer = cloud
    renderer.kept[5:50] = False
    other = ProfileRenderer(REGION, listener).double()
    other.load_state_dict(renderer.state_dict())
    assert not other.prepare(field, None, 7)
    poses = tensors(POSITION[0], ROTATION[0])
    assert torch.equal(other(field, *poses, rows()), renderer(field, *poses, rows()))
    assert int(other.points_evaluated) == 80


@pytest.mark.parametrize("kind", ["grid", "fourier"])
def test_gradients(listener, gradients_are_right, kind):
    torch.manual_seed(0)
    if kind == "grid":
        field = GridField(REGION, listener.frequency, spacing=0.02, levels=1)
        with torch.no_grad():
            field.grids[0].normal_()
    else:
        field = FourierField(REGION, listener.frequency, octaves=2, width=8)
    renderer = ProfileRenderer(REGION, listener, start=30).double()
    renderer.prepare(field.double(), None, 0)
    with torch.no_grad():
        renderer.log_noise.fill_(-3.0)
    poses = tensors(POSITION, ROTATION)
    wanted = torch.tensor([[30, 45], [20, 60]])
    assert gradients_are_right(field, renderer, *poses, wanted, torch.tensor([0, 2]))


def test_gradients_of_a_lead(listener, formula, gradients_are_right):
    class Leading(formula):
        """Places that sound from nearer, each by a length of its own."""

        def __init__(self):
            super().__init__(REGION, listener.frequency, smooth, spacing=0.02)
            generator = torch.Generator().manual_seed(0)
            lengths = 0.004 * torch.rand(27, dtype=torch.float64, generator=generator)
            self.lengths = torch.nn.Parameter(lengths)

        def echo(self, positions, directions, bins, place, code):
            there = positions[place]
            index = ((there - REGION[0]) / 0.02).round().long() @ torch.tensor([9, 3, 1])
            return self.select(there, directions, bins), self.lengths[index]

    field = Leading()
    renderer = ProfileRenderer(REGION, listener).double()
    renderer.prepare(field, None, 0)
    assert len(renderer.lattice) == 27
    with torch.no_grad():
        renderer.log_noise.fill_(-3.0)
    poses, wanted = tensors(POSITION, ROTATION), torch.arange(25, 90).expand(2, -1)
    assert gradients_are_right(field, renderer, *poses, wanted, torch.tensor([0, 2]))
    heard = renderer(field, *poses, wanted)
    (gradient,) = torch.autograd.grad(heard.square().sum(dim=(0, 1, 3))[10], field.lengths)
    assert gradient.abs().max() > 1


@pytest.mark.parametrize(
    ("kind", "front"),
    [
        ("impulse", "stft"),
        ("linear", "stft"),
        ("hyperbolic", "stft"),
        ("harmonics", "stft"),
        ("impulse", "gammatone"),
        ("linear", "gammatone"),
    ],
)
def test_a_tiny_sphere_sounds_where_and_as_long_as_the_simulator_hears_it(kind, front):
    spectrogram = {} if kind == "impulse" else {"window": 160, "frequency_min": 45e3}
    call = {"kind": kind, "duration": 1e-3, "frequency_end": 30e3}
    if kind == "harmonics":  # the second is heard 57 mm farther off at 50 kHz, 114 mm at 100 kHz
        call = {"kind": "linear", "duration": 1e-3, "frequency_start": 100e3}
        call |= {"frequency_end": 25e3, "harmonics": [1.0, 0.5]}
    settings = validate_settings(
        {
            "scene": {"name": "test"},
            "simulation": {"engine": "rays", "rays": 20_000},  # nothing creeps around
            "call": call,
            "spectrogram": {"kind": front, **spectrogram},
        },
        "test",
    )
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.003)
    simulator = simulator_of(Scene(ball), settings)
    known = head_of(settings)
    position = np.array([0.4, 0.0, 0.0])
    measured = simulator.spectrogram(position, look_at(position, np.zeros(3)), seed=0)
    region = torch.tensor([[0.0029, -1e-4, -1e-4], [0.003, 0.0, 0.0]])  # the sphere's front
    field = GridField(region, torch.tensor(known.frequency).float(), spacing=0.001, levels=1)
    renderer = ProfileRenderer(region, known)
    renderer.prepare(field, None, 0)
    poses = tensors(position, look_at(position, np.zeros(3)))
    predicted = renderer(
        field, poses[0].float(), poses[1].float(), torch.arange(len(known.range))[None]
    )
    axis = known.range
    for ear in (0, 1):
        one, two = measured[ear] ** 2, predicted[0, ear].detach().numpy() ** 2
        even = kind != "harmonics"
        if not even:
            ghost = axis > 0.44
            parts = [power[ghost].sum() / power.sum() for power in (one, two)]
            assert parts[0] == pytest.approx(parts[1], rel=0.15)
            one, two = one[~ghost], two[~ghost]
        # Rows that swell unequally are compared with the same weights.
        loud = one.sum(axis=0) / one.sum()
        power = np.stack((one, two)) / np.stack((one, two)).sum(axis=1, keepdims=True)
        late = np.einsum("r,prf->pf", axis[: len(one)], power)
        # A hop, in range. Without the lag, sweeps are 0.9 and 1.5 mm off.
        assert late[0] @ loud == pytest.approx(late[1] @ loud, abs=0.0007 if even else 0.001)
        # And for as long, row by row; the sphere's own spectrum shifts its rows a little, too, and
        # wide rows of gammatones more.
        away = axis[: len(one), None] - late[:, None]
        long = np.sqrt(np.einsum("prf,prf->pf", away**2, power))
        least, most = (0.95, 1.4) if front == "stft" else (0.75, 1.6)
        if even:
            assert np.abs(late[0] - late[1]).mean() < 0.0006
        assert least < (long[0] / long[1]).min() < (long[0] / long[1]).max() < most
