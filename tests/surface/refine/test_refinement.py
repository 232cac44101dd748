# SPDX-License-Identifier: MIT
from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
import trimesh

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import InputError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.head.head import Head
from sononerf.run.build import head_of
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Hearing, hearing_of
from sononerf.simulation.simulator import Simulator
from sononerf.surface.refine import comparison
from sononerf.surface.refine import refinement as module
from sononerf.surface.refine.candidates import (
    Candidate,
    after_first_stage,
    best_of,
    number_of_steps,
    planned,
)
from sononerf.surface.refine.descent import Descent, Stage
from sononerf.surface.refine.objective import Level
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.refinement import Refinement
from sononerf.surface.refine.remesh import distance_from
from tests.memory import changed, deaf_hull, echoes_of
from tests.surface.conftest import RADIUS


def unasked(mesh):
    raise AssertionError("no stage asks for the simulator")


def refined(mesh, echoes, optics, **given):
    work = started(mesh, echoes, optics, **given)
    while not work.done:
        work.advance()
    return work.result()


def started(mesh, echoes, optics, *, simulate=unasked, stages=None):
    return Refinement(
        {"body": mesh}, echoes, optics, simulate=simulate, seed=1, stages=stages or SHORT
    )


SHORT = (
    Stage(smoothing=2.0, edge=0.8, blur=0.3, rate=0.02, steps=8, beyond="trace"),
    Stage(smoothing=1.2, edge=0.7, blur=0.0, rate=0.02, steps=8, beyond="keep"),
)


def test_the_spectrum_of_a_recording_is_learned_from_the_first_stage_on(bumpy, echoes, optics):
    tilt = np.linspace(0.3, 3.0, len(optics.frequencies)).astype(np.float32)
    tilted = changed(
        echoes, read=lambda n: echoes.store.read_pose(n) * tilt, hull=deaf_hull(), origin="recorded"
    )
    work = Refinement(
        {"body": bumpy},
        tilted,
        optics,
        simulate=unasked,
        seed=1,
        stages=SHORT,
    )
    while work.stage == 0:
        work.advance()
    gain = work.candidate.level.gain[0].exp().numpy()
    assert gain[-1] / gain[0] > 5.0


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    monkeypatch.setattr(comparison, "RAYS", 4000)


@pytest.fixture(scope="module")
def bumpy():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    way = np.asarray(mesh.vertices) / RADIUS
    height = 4e-4 * (1 + np.sin(5 * way[:, 0] + 1) * np.cos(4 * way[:, 1]))
    return trimesh.Trimesh(way * (RADIUS + height)[:, None], mesh.faces, process=False)


def test_a_bumpy_sphere_becomes_round(bumpy, echoes, optics):
    found = refined(bumpy, echoes, optics)
    assert found.kept
    assert len(found.confidence) == len(found.mesh.vertices)
    assert found.gain.shape == (2, len(optics.frequencies))
    assert [(one["stage"], one["way"]) for one in found.history][:2] == [
        (0, "blurred"),
        (0, "sharp"),
    ]
    assert [one["stage"] for one in found.history] == [0, 0, 1]

    def off(mesh):
        return np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).mean()

    assert off(found.mesh) < 0.5 * off(bumpy)


def test_a_surface_that_gets_worse_is_not_kept(echoes, optics, monkeypatch):
    true = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)

    def spoil(self, number, part):
        self.vertices = self.vertices * 1.01
        return 1.0

    monkeypatch.setattr(Descent, "step", spoil)
    found = refined(true, echoes, optics)
    assert not found.kept
    assert np.array_equal(found.mesh.vertices, true.vertices)


def test_of_two_starts_the_one_that_explains_more_is_refined(bumpy, echoes, optics):
    half = bumpy.copy().apply_scale(0.5)
    for starts in ({"whole": bumpy, "half": half}, {"half": half, "whole": bumpy}):
        work = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
        work.advance()
        assert [(one.start, one.way) for one in work.candidates] == [
            ("whole", "blurred"),
            ("whole", "sharp"),
        ]
        (begun,) = work.candidate.meshes
        np.testing.assert_array_equal(begun.vertices, bumpy.vertices)
        again = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
        again.load(work.state())
        assert again.candidate.start == "whole"


@pytest.mark.parametrize(("count", "chosen"), [(20, "filled"), (1000, "hull")])
def test_a_hull_takes_part_only_if_poses_are_dense(bumpy, echoes, optics, count, chosen):
    places = 0.4 * fibonacci_sphere(count)
    ears = np.repeat(places[:, None], 2, axis=1)
    far = np.linalg.norm(places[:, None] - bumpy.vertices, axis=2).min(axis=1)
    heard = EchoHull(places, ears, np.stack([far, far], axis=1), -places / 0.4)
    echoes = changed(echoes, hull=heard)
    starts = {"hull": bumpy, "filled": bumpy.copy().apply_scale(0.5)}
    for given, found in ((starts, chosen), ({"hull": bumpy}, "hull")):
        work = Refinement(given, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
        assert work.candidate.start == found


@pytest.fixture
def simulated_stage(settings):
    """Two short stages, the second one corrected by the simulator."""
    few = settings.simulation.model_copy(update={"rays": 2000})

    def simulate(mesh):
        return Simulator.of(Scene(mesh, warns=False), head_of(settings), few)

    last = dataclasses.replace(SHORT[1], beyond="simulate")
    return {"simulate": simulate, "stages": (SHORT[0], last)}


def test_a_surface_that_cannot_be_simulated_is_refined_all_the_same_and_told(
    bumpy, echoes, optics, simulated_stage, caplog
):
    def refuse(mesh):
        raise InputError("the mesh is 1e-06 m large")

    simulated_stage["simulate"] = refuse
    work = started(bumpy, echoes, optics, **simulated_stage)
    while work.step == 0 or work.stage == 0:
        work.advance()
    again = started(bumpy, echoes, optics, **simulated_stage)
    again.load({name: part.clone() for name, part in work.state().items()})
    while not again.done:
        again.advance()
    found = again.result()
    assert found.kept
    fault = "stage 1 goes without the simulator's correction: the mesh is 1e-06 m large"
    assert found.faults == [fault]
    assert fault in caplog.text


def test_a_start_that_cannot_be_traced_is_told_and_counts_as_the_worst(
    bumpy, echoes, optics, caplog
):
    flat = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)
    work = Refinement(
        {"open": flat, "filled": bumpy}, echoes, optics, simulate=unasked, seed=1, stages=SHORT
    )
    while not work.done:
        work.advance()
    found = work.result()
    assert found.start == "filled"
    (fault,) = found.faults
    assert fault.startswith("the start open cannot be compared and counts as the worst: ")
    assert fault in caplog.text


@pytest.mark.thorough
@pytest.mark.parametrize("corrected", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_going_on_from_any_step_ends_the_same(bumpy, echoes, optics, simulated_stage, corrected):
    given = simulated_stage if corrected else {}
    whole = started(bumpy, echoes, optics, **given)
    states = {}
    while not whole.done:
        states[whole.drawn] = {k: v.clone() for k, v in whole.state().items()}
        whole.advance()
    for step in (5, 8, 20):  # within stages, and between two
        again = started(bumpy, echoes, optics, **given)
        again.load(states[step])
        while not again.done:
            again.advance()
        one, other = again.candidate, whole.candidate
        assert np.array_equal(one.meshes[-1].vertices, other.meshes[-1].vertices)
        assert torch.equal(one.level.gain, other.level.gain)


def test_a_world_three_times_as_large_gives_the_same_three_times_as_large(
    bumpy, echoes, optics, settings
):
    factor = 3.0
    old = hearing_of(optics.head)
    analysis = settings.spectrogram
    slow = analysis.model_copy(
        update={
            "sampling_rate": analysis.sampling_rate / factor,
            "frequency_min": analysis.frequency_min / factor,
            "frequency_max": analysis.frequency_max / factor,
            "range_min": analysis.range_min * factor,
            "range_max": analysis.range_max * factor,
        }
    )

    class Scaled(Head):
        """The same head, larger by a factor, in air that absorbs nothing."""

        scale = 1.0

        def tables(self, frequency):
            return dataclasses.replace(
                old.ears,
                frequency=old.ears.frequency / self.scale,
                emitter=old.ears.emitter * self.scale,
                positions=old.ears.positions * self.scale,
            )

        def absorption(self, frequency):
            return np.zeros(len(frequency))

    def optics_at(scale, spectrogram):
        head = Scaled(ears=settings.ears, analysis=spectrogram)
        head.__dict__.update(scale=scale, window=np.zeros((1, analysis.window)))
        synthesis = dataclasses.replace(old.synthesis, nodes=old.synthesis.nodes / scale)
        return Optics(head, Hearing(head, synthesis))

    def moved(scale, spectrogram):
        world = changed(
            echoes,
            positions=echoes.positions * scale,
            read=lambda number: echoes.store.read_pose(number) / np.float32(scale),
        )
        heard = optics_at(scale, spectrogram)
        mesh = trimesh.Trimesh(bumpy.vertices * scale, bumpy.faces, process=False)
        made = module.remesh(mesh, 0.8 * heard.wavelength, 0.3 * heard.wavelength)
        level = Level(heard.ears, len(heard.frequencies), heard.get_buffer("wavenumber"))
        work = Descent(
            made, world, heard, level, smoothing=1.5 * heard.wavelength, rate=0.02, seed=0
        )
        for step in range(4):
            work.step(step, step / 4)
        return work.vertices / scale

    one, three = moved(1.0, analysis), moved(factor, slow)
    assert one.shape == three.shape
    assert float((one - three).abs().max()) < 2e-3 * optics.wavelength


def test_the_better_of_the_blurred_and_the_sharp_surface_goes_on(
    bumpy, echoes, optics, monkeypatch
):
    # Of two that explain about as much the blurred one goes on.
    for worse, better, value in (
        ("blurred", "sharp", 9.0),
        ("sharp", "blurred", 9.0),
        ("blurred", "blurred", 1.1),
    ):
        work = started(bumpy, echoes, optics)
        monkeypatch.setattr(
            work.comparison,
            "objective",
            lambda *a, work=work, worse=worse, v=value, **k: v if way_of(work) == worse else 1.0,
        )
        ends = []
        while work.stage == 0:
            work.advance()
            if work.step == 0:
                ends.append(work.newest)
        (candidate,) = work.candidates
        assert candidate.way == better
        assert candidate.meshes[1:] == [ends[0] if better == "blurred" else ends[1]]


def test_what_is_too_thin_for_the_first_blur_is_never_blurred(bumpy, echoes, optics):
    thick = 0.5 * optics.wavelength
    disc = trimesh.creation.cylinder(RADIUS, thick, sections=96).subdivide_to_size(thick / 2)
    stages = (dataclasses.replace(SHORT[0], blur=1.2, steps=2), SHORT[1])
    work = started(disc, echoes, optics, stages=stages)
    work.advance()
    again = started(disc, echoes, optics, stages=stages)
    again.load(work.state())
    for one in (work, again):
        while one.stage == 0:
            one.advance()
        assert [(each["stage"], each["way"]) for each in one.history] == [(0, "sharp")]
        assert [each.way for each in one.candidates] == ["sharp"]


def way_of(work):
    return work.candidates[work._at].way if work.candidates else "start"


PLANS = [(start, way) for start in ("levels", "body") for way in ("blurred", "sharp")]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("objectives", "last", "chosen", "stages"),
    [
        # Both go through all stages; the better one is chosen.
        ((2.0, 1.0, 1.1, 1.1), {"levels": 1.0, "body": 0.9}, ("body", "blurred"), 6),
        ((1.1, 1.0, 1.4, 1.1), {"levels": 0.8, "body": 0.9}, ("levels", "sharp"), 6),
        ((9.0, 5.0, 5.4, 5.0), {"levels": 5.0, "body": 2.9}, ("body", "blurred"), 6),
        # One that is clearly worse after the first stage is left behind.
        ((2.0, 1.0, 1.3, 1.2), {"levels": 1.0}, ("levels", "sharp"), 5),
        ((8.0, 6.5, 5.4, 5.0), {"body": 2.9}, ("body", "blurred"), 5),
    ],
)
def test_levels_and_the_best_other_start_stay_until_they_lose(
    bumpy, echoes, optics, monkeypatch, objectives, last, chosen, stages
):
    small, large = (bumpy.copy().apply_scale(factor) for factor in (0.8, 1.1))
    starts = {"small": small, "body": bumpy, "levels": large}
    work = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    first = dict(zip(PLANS, objectives, strict=True))

    def objective(mesh, *given, **named):
        if any(mesh is start for start in work.starts.values()):
            return 9.0 + abs(np.ptp(mesh.vertices[:, 0]) / np.ptp(bumpy.vertices[:, 0]) - 1.0)
        if not work.candidates:
            return math.inf  # its flat parts
        if work.stage == 0:
            return first[work.candidate.start, work.candidate.way]
        return last[work.candidate.start]

    monkeypatch.setattr(work.comparison, "objective", objective)
    while not work.done:
        work.advance()
    assert [(one["start"], one["way"]) for one in work.history[:4]] == PLANS
    assert len(work.history) == stages
    assert work.drawn == 8 * stages <= number_of_steps(starts, SHORT)
    again = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    again.load(work.state())
    assert again.history == work.history
    for one in (work, again):
        found = one.result()
        assert (found.start, found.kept) == (chosen[0], True)
        ways = {each.start: each.way for each in one.candidates}
        assert ways[chosen[0]] == chosen[1]
        listed = {each["start"]: each for each in found.candidates}
        assert [name for name, each in listed.items() if each["chosen"]] == [chosen[0]]
        assert listed["small"]["error_db"] is None
        compared = [each["start_error_db"] for name, each in listed.items() if name in last]
        assert all(each >= 9 for each in compared)
        assert {name: listed[name]["error_db"] for name in last} == pytest.approx(last)


@pytest.mark.parametrize(
    ("error", "closed", "chosen"),
    [
        (5.2, {"levels", "open"}, "levels"),
        (5.9, {"levels", "open"}, "open"),
        (4.5, {"open"}, "open"),  # what no pose can have heard is no body
        (5.2, {"open"}, "open"),
        (5.2, set(), "levels"),
        (2.9, {"open"}, "levels"),  # its error is low
    ],
)
def test_in_doubt_a_closed_candidate_is_chosen_and_levels_before_others(
    bumpy, error, closed, chosen
):
    meshes = {name: bumpy.copy() for name in ("levels", "open")}
    candidates = [
        Candidate("sharp", name, None, [bumpy, mesh], [9.0, 5.0 if name == "open" else error])
        for name, mesh in meshes.items()
    ]
    inside = [meshes[name] for name in closed]
    found = best_of(candidates, lambda mesh: any(mesh is one for one in inside))
    assert found.start == chosen


@pytest.mark.parametrize(
    ("errors", "way", "kept"),
    [
        ({"levels sharp": 3.0, "fuller sharp": 5.0, "fuller blurred": 5.0}, "sharp", "levels"),
        ({"levels sharp": 5.0, "fuller sharp": 3.0, "fuller blurred": 5.0}, "sharp", "fuller"),
        ({"levels sharp": 3.2, "fuller sharp": 3.0, "fuller blurred": 2.3}, "blurred", "fuller"),
        ({"levels sharp": 3.5, "fuller sharp": 3.4, "fuller blurred": 3.3}, "sharp", "fuller"),
        ({"levels sharp": 3.4, "fuller sharp": 3.5, "fuller blurred": 5.0}, "sharp", "fuller"),
    ],
)
def test_the_better_surface_of_the_network_goes_on_as_levels(bumpy, errors, way, kept):
    starts = {name: bumpy.copy() for name in ("levels", "fuller")}
    candidates = []
    for name, error in errors.items():
        start, way_of = name.split()
        after = bumpy.copy()
        after.metadata["of"] = start
        candidates.append(Candidate(way_of, start, None, [starts[start], after], [9.0, error]))
    (found,) = after_first_stage(candidates, lambda mesh: 0.0)
    assert (found.start, found.way) == ("levels", way)
    assert found.meshes[1].metadata["of"] == kept
    assert found.meshes[0] is starts["levels"]  # what is kept where no refined one is better


@pytest.mark.parametrize(
    ("planes", "other", "sheet", "ways"),
    [
        (5.0, 4.0, 9.0, ["planes"]),
        (5.8, 4.0, 9.0, ["planes", "sharp"]),
        (6.0, 3.8, 9.0, ["sharp", "planes"]),
        (6.0, 3.0, 9.0, ["sharp"]),
        (5.0, 4.0, 4.5, ["sheet"]),
        (5.0, 4.0, 4.7, ["planes"]),
    ],
)
def test_planes_are_compared_by_echoes_alone_and_in_doubt_both_go_on(
    bumpy, planes, other, sheet, ways
):
    def candidate(way, start, objective):
        after = bumpy.copy()
        after.metadata["way"] = way
        return Candidate(way, start, None, [bumpy, after], [9.0, objective])

    found = after_first_stage(
        [
            candidate("planes", "levels", planes),
            candidate("sharp", "levels", other),
            candidate("blurred", "open", 5.5),
            candidate("sheet", "sheet", sheet),
        ],
        lambda mesh: 2.0 if mesh.metadata["way"] == "planes" else 0.0,
    )
    assert [one.way for one in found] == ways


def test_levels_is_refined_from_the_fuller_surface_too():
    assert planned({"levels": math.nan, "fuller": math.nan, "open": 5.0, "filled": 4.0}) == [
        ("levels", "sharp"),
        ("fuller", "blurred"),
        ("fuller", "sharp"),
        ("filled", "blurred"),
        ("filled", "sharp"),
    ]


@pytest.fixture(scope="module")
def box():
    found = trimesh.creation.box((0.03, 0.024, 0.02))
    return found.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.8, 1.9))


@pytest.fixture(scope="module")
def box_echoes(box, settings, poses, simulated):
    head, at = head_of(settings), (poses.positions, poses.rotations)
    found = simulated(box, settings, poses)
    return echoes_of(head, *at, lambda i: found[i], hull=deaf_hull())


@pytest.mark.thorough
def test_flat_parts_move_as_planes_and_go_on_alone_where_they_are_right(box, box_echoes, optics):
    fine = box.subdivide_to_size(0.6 * optics.wavelength)
    worn = trimesh.smoothing.filter_laplacian(fine.copy().apply_scale(1.02), iterations=3)
    work = Refinement({"levels": worn}, box_echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    again = Refinement({"levels": worn}, box_echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    for step in itertools.count():
        if work.done:
            break
        if step == 20:
            again.load(work.state())
        work.advance()
    assert [(one["stage"], one["way"]) for one in work.history] == [
        (0, "planes"),
        (0, "sharp"),
        (1, "planes"),
    ]
    while not again.done:
        again.advance()
    found = work.result()
    np.testing.assert_array_equal(found.mesh.vertices, again.result().mesh.vertices)
    off = [distance_from(box, np.asarray(m.vertices), 1e-3).mean() for m in (worn, found.mesh)]
    assert off[1] < 0.5 * off[0]
    angles = np.sort(found.mesh.face_adjacency_angles)
    assert np.degrees(angles[-20:]).min() > 80.0


@pytest.mark.thorough
def test_planes_that_begin_from_the_fuller_surface_compete_with_levels(box, box_echoes, optics):
    fine = box.subdivide_to_size(0.6 * optics.wavelength)
    fuller = trimesh.smoothing.filter_laplacian(fine.copy(), iterations=2)
    levels = trimesh.smoothing.filter_laplacian(fine.copy().apply_scale(0.9), iterations=3)
    starts = {"levels": levels, "fuller": fuller}
    work = Refinement(starts, box_echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    begun = work.candidate
    np.testing.assert_array_equal(begun.meshes[0].vertices, fuller.vertices)
    while work.stage == 0:
        work.advance()
    assert (begun.way, begun.start) == ("planes", "levels")
    np.testing.assert_array_equal(begun.meshes[0].vertices, levels.vertices)
    assert begun.objectives[0] == work.compared["levels"]


def test_a_ball_has_no_flat_parts(bumpy, echoes, optics):
    work = Refinement({"levels": bumpy}, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    assert work.candidate.way == "blurred"
    assert [one.way for one in work.candidates] == ["blurred", "sharp"]


def test_a_candidate_does_not_depend_on_the_others(bumpy, echoes, optics):
    ends = []
    for starts in ({"body": bumpy}, {"levels": bumpy.copy().apply_scale(1.05), "body": bumpy}):
        work = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
        found = {}
        while work.stage == 0:
            work.advance()
            if work.step == 0:
                last = work.history[-1]
                found[last["start"], last["way"]] = work.newest.vertices
        ends.append(found)
    for way in ("blurred", "sharp"):
        np.testing.assert_array_equal(ends[0]["body", way], ends[1]["body", way])


def test_of_two_surfaces_that_sound_alike_one_goes_on(bumpy, echoes, optics):
    starts = {"body": bumpy, "levels": bumpy.copy()}
    work = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    while not work.done:
        work.advance()
    assert len(work.history) == 5


@pytest.mark.parametrize(
    ("objectives", "best"),
    [
        ((9.0, 5.0, 5.1, 5.4), 2),  # of equals the later one; a rise is none
        ((9.0, 5.0, 5.4, 4.0), 3),
        ((4.0, 5.0, 4.4, 4.3), 3),  # the start is better by chance
        ((4.0, 5.0, 6.0, 4.7), 0),  # no stage explains as much as the start
        ((math.inf, 5.0, math.inf), 1),  # what cannot be traced
        ((math.inf, math.inf), 0),
        ((4.0,), 0),
    ],
)
def test_the_later_of_equal_surfaces_is_kept(bumpy, objectives, best):
    candidate = Candidate("sharp", "body", None, [bumpy] * len(objectives), list(objectives))
    assert candidate.best == best


@pytest.mark.parametrize(
    ("objectives", "best"),
    [
        ((9.0, 5.0, 4.8, 4.7), 1),  # the earliest that explains about as much
        ((9.0, 6.0, 5.0, 4.7), 2),
        ((5.0, 5.2, 4.8, 4.7), 0),
        ((5.0, 2.9, 2.85, 2.8), 3),  # it ranks rightly
    ],
)
def test_where_the_error_hardly_ranks_the_earliest_surface_of_levels_is_kept(
    bumpy, objectives, best
):
    candidate = Candidate("sharp", "levels", None, [bumpy] * len(objectives), list(objectives))
    assert candidate.best == best


@pytest.mark.parametrize(("error", "kept"), [(6.0, False), (3.0, True)])
def test_a_torn_surface_loses_unless_its_error_is_low(bumpy, error, kept):
    other = bumpy.copy()
    other.apply_translation([0.1, 0, 0])
    in_two = trimesh.util.concatenate([bumpy, other])
    moved = bumpy.copy()
    moved.apply_scale(2.0)
    for mesh in (in_two, moved):
        candidate = Candidate("sharp", "open", None, [bumpy, mesh], [9.0, error], 0.006)
        assert (candidate.best > 0) == kept


def slab(height):
    """A thin plate, thinner than any voxel of the stages."""
    plate = trimesh.creation.box((0.02, 0.02, height))
    return plate.subdivide().subdivide().subdivide().subdivide()


@pytest.mark.thorough
def test_a_sheet_keeps_its_triangles_and_wins_where_it_is_about_as_good(
    bumpy, echoes, optics, monkeypatch
):
    thin = slab(2e-4)
    for value, start in ((1.1, "sheet"), (2.0, "body")):
        starts = {"body": bumpy, "sheet": thin}
        work = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
        monkeypatch.setattr(
            work.comparison,
            "objective",
            lambda *a, work=work, value=value, **k: value if way_of(work) == "sheet" else 1.0,
        )
        while not work.done:
            work.advance()
        assert work.drawn == number_of_steps(starts, SHORT)
        (candidate,) = work.candidates
        assert candidate.start == start
        again = Refinement(starts, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
        again.load(work.state())
        assert (again.candidate.start, again.candidate.way) == (start, candidate.way)
        assert again.history == work.history
        if start == "sheet":
            assert all(len(mesh.faces) == len(thin.faces) for mesh in candidate.meshes)


def test_a_sheet_alone_is_refined(echoes, optics):
    work = Refinement({"sheet": slab(2e-4)}, echoes, optics, simulate=unasked, seed=0, stages=SHORT)
    while not work.done:
        work.advance()
    assert work.result().start == "sheet"
    assert {one["way"] for one in work.history} == {"sheet"}
