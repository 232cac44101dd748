# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.acoustics.ears import synthetic_ears
from sononerf.acoustics.reception import effective_window
from sononerf.acoustics.spectrogram import frequency_axis
from sononerf.config import CallSettings, EarSettings, SpectrogramSettings
from sononerf.data.region import SILENT_SHARES, EchoEvidence, echo_power, echo_reach
from sononerf.data.store import EnsembleStore
from sononerf.errors import NumericalError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.hull import EchoHull
from sononerf.geometry.poses import look_at

STEP = 0.001
RANGE = 0.15 + STEP * np.arange(601)
FREQUENCY = np.array([40e3, 70e3])
EARS = synthetic_ears(EarSettings(), FREQUENCY)
HALF_WINDOW = 0.0054


def echoes(position, rotation, places, half=HALF_WINDOW):
    """Each place heard by each ear at half of its path, as long as the analysis window."""
    emitter = position + rotation @ EARS.emitter
    heard = np.zeros((2, len(RANGE), 2))
    for ear, offset in enumerate(EARS.positions):
        for place in places:
            there = np.linalg.norm(place - emitter)
            back = np.linalg.norm(place - position - rotation @ offset)
            middle = (there + back) / 2
            inside = np.abs(RANGE - middle) < half
            window = 0.54 + 0.46 * np.cos(np.pi * (RANGE - middle) / half)
            heard[ear, inside] += window[inside, None] / (there * back)
    return heard


def evidence(path, positions, rotations, places, **options):
    """Simulate the echoes of places that reflect alike in all directions."""
    store = EnsembleStore.create(
        path,
        poses_positions=positions,
        poses_rotations=rotations,
        split=np.zeros(len(positions), int),
        range=RANGE,
        frequency=FREQUENCY,
        attributes={"echo_hash": "a", "reference": 6.25 / 1000, "speed_of_sound": 343.0},
    )
    heard = places if callable(places) else lambda p, r: echoes(p, r, places)
    for index, (position, rotation) in enumerate(zip(positions, rotations, strict=True)):
        store.write_pose(index, heard(position, rotation))
    store.seal()
    return EchoEvidence(store, EARS, **{"reach": HALF_WINDOW, **options})


def around(count=60, radius=0.4):
    positions = radius * fibonacci_sphere(count)
    return positions, look_at(positions, np.zeros(3))


def test_an_echo_is_as_long_as_the_window():
    def reach(**changes):
        return echo_reach(CallSettings(), SpectrogramSettings(**changes), 343.0)

    sample = 343.0 / 2 / 1e6
    assert reach() == pytest.approx(31.5 * sample)
    assert reach(window=127) == pytest.approx(63 * sample)
    assert reach(sampling_rate=2e6) == pytest.approx(31.5 * sample / 2)
    assert echo_reach(CallSettings(), SpectrogramSettings(), 686.0) == pytest.approx(63 * sample)


def test_the_power_of_an_echo_is_that_of_the_rows_it_sounds_in():
    power = echo_power(CallSettings(), SpectrogramSettings())
    np.testing.assert_allclose(power, np.hamming(64) ** 2, rtol=1e-12)
    # Of a sweep down to 40 kHz the rows below hold nothing: they are left out.
    call, analysis = CallSettings(kind="linear", frequency_end=40e3), SpectrogramSettings()
    rows = effective_window(call, analysis)[frequency_axis(analysis) >= 40e3]
    np.testing.assert_allclose(echo_power(call, analysis), (rows**2).mean(axis=0), rtol=1e-12)
    assert len(rows) < len(effective_window(call, analysis))
    # Where no row is called at all, the first stands for all.
    beyond = SpectrogramSettings(frequency_min=20e3, frequency_max=30e3)
    np.testing.assert_allclose(
        echo_power(call, beyond), effective_window(call, beyond)[0] ** 2, rtol=1e-12
    )


def test_an_echo_of_a_sweep_is_as_long_as_the_sweep_stays_in_the_window():
    analysis = SpectrogramSettings(window=64, frequency_min=45e3)

    def reach(duration):
        call = CallSettings(kind="linear", duration=duration, frequency_end=20e3)
        return echo_reach(call, analysis, 343.0)

    # Slow sweeps stay in the window's main lobe, 31 kHz to either side, for 31 / 130 of the call;
    # 5 % of the middle are left after nine tenths of that.
    assert reach(3e-3) == pytest.approx(0.9 * 31.25 / 130 * 3e-3 * 343 / 2, rel=0.05)
    assert reach(6e-3) == pytest.approx(2 * reach(3e-3), rel=0.03)
    assert 31.5e-6 * 343 / 2 < reach(0.1e-3) < 63e-6 * 343 / 2  # never shorter than the window
    call = CallSettings(kind="linear", duration=3e-3, frequency_end=20e3)
    # Rows that are not called have nothing to be measured.
    beyond = analysis.model_copy(update={"frequency_max": 300e3})
    assert echo_reach(call, beyond, 343.0) == pytest.approx(reach(3e-3), rel=0.1)


PLACES = np.array([[0.03, -0.02, 0.01], [-0.02, 0.03, -0.02], [0.0, -0.03, 0.03]])


def test_the_box_holds_the_places_and_hardly_more(tmp_path):
    found = evidence(tmp_path / "s", *around(), PLACES)
    box = found.box(margin=0.0)
    assert (box[0] <= PLACES.min(axis=0)).all()
    assert (box[1] >= PLACES.max(axis=0)).all()
    # An echo is as long as the window, and its threshold is met half a window off the middle.
    spare = np.concatenate((PLACES.min(axis=0) - box[0], box[1] - PLACES.max(axis=0)))
    assert spare.max() < 0.025
    wider = found.box(margin=0.01)
    np.testing.assert_allclose(wider - box, [[-0.01] * 3, [0.01] * 3], atol=1e-12)


def test_the_box_goes_where_the_places_go(tmp_path):
    shift = np.array([1.0, -2.0, 0.5])
    positions, rotations = around()
    one = evidence(tmp_path / "1", positions, rotations, PLACES).box()
    two = evidence(tmp_path / "2", positions + shift, rotations, PLACES + shift).box()
    np.testing.assert_allclose(two, one + shift, atol=2e-3)


def test_places_are_needed_and_the_air_between_is_not(tmp_path):
    far = np.array([[0.06, 0.0, 0.0], [-0.06, 0.0, 0.0]])
    found = evidence(tmp_path / "s", *around(100), far)
    probes = np.concatenate((far, [[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.06, 0.0]]))
    grid = np.concatenate((probes, np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3))))
    needed = found.needed(grid, 0.002)
    assert needed[:5].tolist() == [True, True, False, False, False]


def test_how_long_an_echo_is_says_what_it_explains(tmp_path):
    """The tails of a sweep's long echoes are no echoes of something else."""
    long = 0.03
    place = PLACES[:1]

    def heard(position, rotation):
        return echoes(position, rotation, place, long)

    right = evidence(tmp_path / "s", *around(), heard, reach=long)
    short = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW)
    probes = np.concatenate((place, place + 0.03 * fibonacci_sphere(100)))
    assert right.needed(probes, 0.002).tolist() == [True] + [False] * 100
    assert short.needed(probes, 0.002).sum() > 50


def test_silence_carves(tmp_path):
    """What lies before the first echo of many poses is empty, whatever the other echoes say."""
    found = evidence(tmp_path / "s", *around(), PLACES[:1])
    towards = PLACES[0] + 0.05 * fibonacci_sphere(50)
    about = found.about(np.concatenate((PLACES[:1], towards)), 0.002)
    assert about.possible.tolist() == [True] + [False] * 50
    # There the poses agree; 50 mm off, each place is at the range of a few poses' echo by chance.
    assert about.energy[0] > 4 * about.energy[1:].max()


def test_a_face_that_answers_few_poses_is_kept(tmp_path):
    """A mirror answers only from straight ahead; who sees it aslant hears what stands behind."""
    # How tightly the box fits is not asked: few poses say where such a face ends.
    face, ball = np.array([0.05, 0.0, 0.0]), np.array([-0.03, 0.0, 0.0])

    def heard(position, rotation):
        ahead = position[0] / np.linalg.norm(position) > np.cos(np.radians(35))
        return echoes(position, rotation, [ball, face] if ahead else [ball])

    box = evidence(tmp_path / "s", *around(100), heard).box(margin=0.0)
    for place in (face, ball):
        assert (box[0] <= place).all()
        assert (box[1] >= place).all()


def hull_of(places, positions, rotations):
    """What the first echoes of some places leave."""
    emitters = positions + rotations @ EARS.emitter
    receivers = positions[:, None] + np.einsum("pij,ej->pei", rotations, EARS.positions)
    ways = np.linalg.norm(receivers[:, :, None] - places, axis=-1)
    ways = (ways + np.linalg.norm(emitters[:, None] - places, axis=-1)[:, None]) / 2
    return EchoHull(emitters, receivers, ways.min(axis=2), rotations[:, :, 0])


def test_what_is_left_lies_behind_every_first_echo(tmp_path):
    """One of a hundred poses is enough; without the hull a share of them is asked for."""
    positions, rotations = around(100)
    few = np.arange(100) < 1
    ball = np.array([[0.0, 0.0, 0.0]])
    hull = hull_of(ball, positions, rotations)
    found = evidence(tmp_path / "s", positions, rotations, ball, hull=hull)
    plain = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW)
    clear = EchoHull(
        hull.emitters, hull.receivers, np.where(few[:, None], hull.first, -np.inf), hull.axes
    )
    asked = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW, hull=clear)
    towards = positions[0] / np.linalg.norm(positions[0])
    offsets = np.array([-0.004, 0.0, 0.001, 0.0014, 0.0017, 0.003])
    probes = offsets[:, None] * towards
    # Three tenths of how far a place speaks for its surroundings, and half a millimetre.
    clearance = clear.clearance(probes)[0]
    np.testing.assert_allclose(clearance, -offsets, atol=2e-4)  # ears lie 10 mm off the axis
    assert asked.left(probes, 0.003).tolist() == [True, True, True, True, False, False]
    assert asked.left(probes, 0.010).tolist() == [True] * 6
    # Half of the window before its middle an echo is heard already, without the hull.
    assert plain.left(probes, 0.003).all()
    assert not found.left(probes, 0.003)[-2:].any()


def test_a_silent_face_is_left_by_first_echoes(tmp_path):
    """Three quarters of its witnesses hear what stands behind: the hull knows it all the same."""
    positions, rotations = around(100)
    face, ball = np.array([0.05, 0.0, 0.0]), np.array([-0.03, 0.0, 0.0])
    ahead = positions[:, 0] / 0.4 > np.cos(np.radians(25))

    def heard(position, rotation):
        index = int(np.linalg.norm(positions - position, axis=1).argmin())
        return echoes(position, rotation, [ball, face] if ahead[index] else [ball])

    hull = hull_of(np.stack((face, ball)), positions, rotations)
    first = np.where(ahead[:, None], hull.first, -np.inf)
    knows = EchoHull(hull.emitters, hull.receivers, first, hull.axes)
    found = evidence(tmp_path / "s", positions, rotations, heard, hull=knows)
    plain = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW)
    assert found.left(face[None], 0.001).tolist() == [True]
    assert plain.left(face[None], 0.001).tolist() == [False]


def test_nothing_outside_the_hull_is_needed(tmp_path):
    """Else the place where a sound is repeated would be, say a second bounce before the body."""
    positions, rotations = around()
    ghost = np.array([[0.09, 0.0, 0.0]])
    hull = hull_of(PLACES, positions, rotations)
    grid = np.concatenate((PLACES, ghost))
    places = np.concatenate((PLACES, ghost))
    found = evidence(tmp_path / "s", positions, rotations, places, hull=hull)
    plain = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW)
    assert plain.needed(grid, 0.002).all()
    assert found.needed(grid, 0.002).tolist() == [True, True, True, False]
    assert found.box(margin=0.0)[1, 0] < 0.08 < plain.box(margin=0.0)[1, 0]


def test_poses_that_hear_nothing_carve_nothing(tmp_path):
    positions, rotations = around()
    deaf = np.arange(len(positions)) % 2 == 0

    def heard(position, rotation):
        index = int(np.linalg.norm(positions - position, axis=1).argmin())
        return echoes(position, rotation, [] if deaf[index] else PLACES)

    box = evidence(tmp_path / "s", positions, rotations, heard).box()
    assert (box[0] <= PLACES.min(axis=0)).all()
    assert (box[1] >= PLACES.max(axis=0)).all()


def test_no_echo_is_an_error(tmp_path):
    with pytest.raises(NumericalError, match="no pose received an echo"):
        evidence(tmp_path / "s", *around(6), [])


def test_echoes_that_do_not_meet_are_an_error(tmp_path):
    """One pose alone hears something: no second one confirms it."""
    positions, rotations = around(20)

    def heard(position, rotation):
        alone = np.allclose(position, positions[0])
        return echoes(position, rotation, PLACES if alone else [])

    with pytest.raises(NumericalError, match=r"set region\.lower"):
        evidence(tmp_path / "s", positions, rotations, heard).box()


def test_validation_and_test_poses_are_not_asked(tmp_path):
    positions, rotations = around(40)
    store = EnsembleStore.create(
        tmp_path / "s",
        poses_positions=positions,
        poses_rotations=rotations,
        split=np.arange(40) % 2,
        range=RANGE,
        frequency=FREQUENCY,
        attributes={"echo_hash": "a", "reference": 6.25 / 1000},
    )
    for index in range(0, 40, 2):  # the others are not even there
        store.write_pose(index, echoes(positions[index], rotations[index], PLACES))
    assert len(EchoEvidence(store, EARS, reach=HALF_WINDOW).sources) == 20
    few = EchoEvidence(store, EARS, reach=HALF_WINDOW, most=5)
    assert len(few.sources) == 5
    head = (EARS.emitter + EARS.positions.mean(axis=0)) / 2
    expected = positions[[0, 8, 18, 28, 38]] + rotations[[0, 8, 18, 28, 38]] @ head
    np.testing.assert_allclose(few.sources, expected)


def test_noise_is_not_heard(tmp_path):
    """36 dB below the echoes and so 24 dB above the zero of the decibels, with tops."""
    generator = np.random.default_rng(0)

    def noisy(position, rotation):
        power = 0.1**2 * generator.gamma(10.0, 0.1, size=(2, len(RANGE), len(FREQUENCY)))
        return np.sqrt(echoes(position, rotation, PLACES) ** 2 + power)

    plain = evidence(tmp_path / "plain", *around(), PLACES)
    found = evidence(tmp_path / "noisy", *around(), noisy)
    assert found.heard.mean() < 1.1 * plain.heard.mean()
    # Silence tells less where something may lie under the noise.
    assert (plain.shares, found.shares) == (SILENT_SHARES, SILENT_SHARES[-1:])
    np.testing.assert_allclose(found.box(), plain.box(), rtol=0, atol=0.012)


@pytest.mark.parametrize("looks", ["at", "along"])
def test_a_flight_in_a_line(tmp_path, looks):
    """All poses in one plane, or on one side: the box has room off the plane as well."""
    place = np.array([[0.3, 0.1, 0.02]])
    positions = np.linspace([0.0, -0.2, 0.0], [0.0, 0.4, 0.0], 40)
    towards = place[0] if looks == "at" else positions + np.eye(3)[0]
    rotations = look_at(positions, towards * [1, 1, 0])
    box = evidence(tmp_path / "s", positions, rotations, place).box()
    assert (box[0] <= place[0]).all()
    assert (box[1] >= place[0]).all()


GROUND = np.array([[x, y, -0.08] for x in (-0.09, 0.0, 0.09) for y in (-0.09, 0.0, 0.09)])
FAINT = np.array([[0.0, 0.0, 0.05]])


def over_loud_ground(position, rotation):
    """The ground answers 30 dB louder than what stands above it."""
    return echoes(position, rotation, GROUND) + 10**-1.5 * echoes(position, rotation, FAINT)


def test_what_is_heard_first_is_in_the_box_however_faint_it_is(tmp_path):
    """Of all sound it is less than the part that may stay unexplained."""
    positions, rotations = around(100)
    hull = hull_of(np.concatenate((GROUND, FAINT)), positions, rotations)
    found = evidence(tmp_path / "s", positions, rotations, over_loud_ground, hull=hull)
    plain = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW)
    assert plain.box(margin=0.0)[1][2] < FAINT[0, 2] - 0.08
    lower, upper = found.box(margin=0.0)
    assert (lower <= GROUND.min(axis=0)).all()
    assert (upper[:2] >= GROUND.max(axis=0)[:2]).all()
    # A place speaks for its surroundings, 6 mm at last, and for half of a window around its range.
    assert upper[2] == pytest.approx(FAINT[0, 2], abs=0.02)


def test_where_few_poses_are_asked_each_has_its_own_first_echo(tmp_path):
    positions, rotations = around(100)
    hull = hull_of(PLACES, positions, rotations)
    found = evidence(tmp_path / "s", positions, rotations, PLACES, hull=hull, most=50)
    asked = [int(np.linalg.norm(positions - at, axis=1).argmin()) for at in found.sources]
    assert len(set(asked)) == 50
    np.testing.assert_array_equal(found.nearest, hull.first[asked].min(axis=1))


def test_a_first_echo_that_few_share_adds_no_place(tmp_path):
    """Two poses that heard a click in front of everything, each in a place of its own."""
    positions, rotations = around(100)
    clicks = {10: 0.3 * positions[10], 60: 0.3 * positions[60]}

    def heard(position, rotation):
        index = int(np.linalg.norm(positions - position, axis=1).argmin())
        click = clicks.get(index)
        loud = echoes(position, rotation, PLACES)
        return loud if click is None else loud + 10**-1.5 * echoes(position, rotation, [click])

    hull = hull_of(PLACES, positions, rotations)
    plain = evidence(tmp_path / "s", positions, rotations, heard, hull=hull)
    clicked = hull.first.copy()
    for index, click in clicks.items():
        alone = hull_of(click[None], positions, rotations)
        clicked[index] = alone.first[index]
    wrong = EchoHull(hull.emitters, hull.receivers, clicked, hull.axes)
    found = EchoEvidence(EnsembleStore.open(tmp_path / "s"), EARS, reach=HALF_WINDOW, hull=wrong)
    np.testing.assert_array_equal(found.box(), plain.box())


def test_ears_that_tell_nothing_are_not_asked(tmp_path):
    positions, rotations = around(100)
    hull = hull_of(np.concatenate((GROUND, FAINT)), positions, rotations)
    one, none = hull.first.copy(), np.full_like(hull.first, -np.inf)
    one[:, 0] = -np.inf
    evidence(tmp_path / "s", positions, rotations, over_loud_ground, hull=hull)
    tops = []
    for first in (one, none):
        deaf = EchoHull(hull.emitters, hull.receivers, first, hull.axes)
        store = EnsembleStore.open(tmp_path / "s")
        tops.append(EchoEvidence(store, EARS, reach=HALF_WINDOW, hull=deaf).box(margin=0.0)[1][2])
    assert tops[0] > FAINT[0, 2] - 0.02
    assert tops[1] < FAINT[0, 2] - 0.08
