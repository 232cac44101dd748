# SPDX-License-Identifier: MIT
from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh

from sononerf.errors import InputError
from sononerf.head.head import Head
from sononerf.refinement import objective as objectives_module
from sononerf.refinement import refine as module
from sononerf.refinement.descent import (
    Candidate,
    Descent,
    Stage,
    after_first_stage,
    planned,
    poses_that_hear,
)
from sononerf.refinement.objective import ErrorLevel, OnsetRanges
from sononerf.refinement.optics import Optics
from sononerf.refinement.refine import Refinement
from sononerf.refinement.remesh import distance_from, remesh
from sononerf.run.simulate import head_of
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Hearing, hearing_of
from sononerf.simulation.simulator import Simulator
from tests.memory import changed, deaf_hull, echoes_of
from tests.refinement.conftest import RADIUS
from tests.refinement.test_objective import heard as onsets_of


def unasked(mesh):
    raise AssertionError("no stage asks for the simulator")


def refined(meshes, echoes, optics, *, simulate=unasked, stages=None, **given):
    return Refinement(
        meshes if isinstance(meshes, dict) else {"given": meshes},
        echoes,
        optics,
        simulate=simulate,
        seed=1,
        stages=stages or SHORT,
        **given,
    ).run()


def begun(meshes, echoes, optics, **given):
    return Refinement(
        meshes, echoes, optics, simulate=unasked, seed=1, **{"stages": SHORT, **given}
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
    work = begun({"given": bumpy}, tilted, optics)
    work.first_stage()
    assert work.candidates[0].drawn == SHORT[0].steps  # the next stage begins with other poses
    gain = work.candidates[0].level.gain[0].exp().numpy()
    assert gain[-1] / gain[0] > 5.0


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    monkeypatch.setattr(objectives_module, "RAYS", 4000)


@pytest.fixture(scope="module")
def bumpy():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    way = np.asarray(mesh.vertices) / RADIUS
    height = 4e-4 * (1 + np.sin(5 * way[:, 0] + 1) * np.cos(4 * way[:, 1]))
    return trimesh.Trimesh(way * (RADIUS + height)[:, None], mesh.faces, process=False)


def test_a_bumpy_sphere_becomes_round(bumpy, echoes, optics):
    found = refined(bumpy, echoes, optics)
    assert len(found.confidence) == len(found.mesh.vertices)
    assert found.gain.shape == (2, len(optics.frequencies))
    assert [(one["stage"], one["schedule"]) for one in found.history][:2] == [
        (0, "blurred"),
        (0, "sharp"),
    ]
    assert [one["stage"] for one in found.history] == [0, 0, 1]

    def off(mesh):
        return np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).mean()

    assert off(found.mesh) < 0.5 * off(bumpy)


@pytest.fixture
def simulated_stage(settings):
    """Two short stages, the second one corrected by the simulator."""
    few = settings.simulation.model_copy(update={"rays": 2000})

    def simulate(mesh):
        return Simulator(Scene(mesh, warns=False), head_of(settings), few)

    last = dataclasses.replace(SHORT[1], beyond="simulate")
    return {"simulate": simulate, "stages": (SHORT[0], last)}


def test_a_surface_that_cannot_be_simulated_is_refined_all_the_same_and_told(
    bumpy, echoes, optics, simulated_stage, caplog
):
    def refuse(mesh):
        raise InputError("the mesh is 1e-06 m large")

    simulated_stage["simulate"] = refuse
    fault = "stage 1 goes without the simulator's correction: the mesh is 1e-06 m large"
    saved = {}
    for _ in range(2):  # the second time the stages are saved
        found = refined(bumpy, echoes, optics, saved=saved, **simulated_stage)
        assert found.faults == [fault]
    assert fault in caplog.text


@pytest.mark.parametrize("corrected", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_saved_stages_are_not_repeated_and_the_end_is_the_same(
    bumpy, echoes, optics, simulated_stage, corrected
):
    given = simulated_stage if corrected else {}
    saved, ends = {}, {}
    whole = refined(bumpy, echoes, optics, saved=saved, **given)
    assert list(saved) == [
        "given-blurred-0",
        "given-sharp-0",
        f"given-{whole.history[-1]['schedule']}-1",
    ]
    for kept in range(4):  # a kill after each stage
        some = dict(list(saved.items())[:kept])
        steps = []
        ends[kept] = refined(
            bumpy, echoes, optics, saved=some, after_step=lambda n, _, s=steps: s.append(n), **given
        )
        assert steps == [8] * kept + [1] * 8 * (3 - kept)
        assert ends[kept].history == whole.history
        assert np.array_equal(ends[kept].mesh.vertices, whole.mesh.vertices)
        assert np.array_equal(ends[kept].gain, whole.gain)


def test_a_world_three_times_as_large_gives_the_same_three_times_as_large(
    bumpy, echoes, optics, settings
):
    factor = 3.0
    old = hearing_of(optics.head)
    original = settings.spectrogram
    slow = original.model_copy(
        update={
            "sampling_rate": original.sampling_rate / factor,
            "frequency_min": original.frequency_min / factor,
            "frequency_max": original.frequency_max / factor,
            "range_min": original.range_min * factor,
            "range_max": original.range_max * factor,
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

    def optics_at(scale, front_end):
        head = Scaled(ears=settings.ears, spectrogram=front_end)
        head.__dict__.update(scale=scale, window=np.zeros((1, original.window)))
        synthesis = dataclasses.replace(old.synthesis, nodes=old.synthesis.nodes / scale)
        return Optics(head, Hearing(head, synthesis))

    def moved(scale, front_end):
        world = changed(
            echoes,
            positions=echoes.positions * scale,
            read=lambda number: echoes.store.read_pose(number) / np.float32(scale),
        )
        heard = optics_at(scale, front_end)
        mesh = trimesh.Trimesh(bumpy.vertices * scale, bumpy.faces, process=False)
        made = module.remesh(mesh, 0.8 * heard.wavelength, 0.3 * heard.wavelength)
        level = ErrorLevel(heard.ears, len(heard.frequencies), heard.get_buffer("wavenumber"))
        work = Descent(
            made, world, heard, level, smoothing=1.5 * heard.wavelength, rate=0.02, seed=0
        )
        for step in range(4):
            work.step(step, step / 4)
        return work.vertices / scale

    one, three = moved(1.0, original), moved(factor, slow)
    assert one.shape == three.shape
    assert float((one - three).abs().max()) < 2e-3 * optics.wavelength


def test_levels_is_refined_from_the_fuller_surface_too():
    assert planned(["levels", "fuller"]) == [
        ("levels", "sharp"),
        ("fuller", "blurred"),
        ("fuller", "sharp"),
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


@pytest.mark.slow
def test_flat_parts_move_as_planes_and_go_on_alone_where_they_are_right(box, box_echoes, optics):
    fine = box.subdivide_to_size(0.6 * optics.wavelength)
    worn = trimesh.smoothing.filter_laplacian(fine.copy().apply_scale(1.02), iterations=3)
    saved = {}
    found = refined({"levels": worn}, box_echoes, optics, saved=saved)
    assert [(one["stage"], one["schedule"]) for one in found.history] == [
        (0, "planes"),
        (0, "sharp"),
        (1, "planes"),
    ]
    del saved["levels-planes-1"]
    again = refined({"levels": worn}, box_echoes, optics, saved=saved)
    np.testing.assert_array_equal(found.mesh.vertices, again.mesh.vertices)
    off = [distance_from(box, np.asarray(m.vertices), 1e-3).mean() for m in (worn, found.mesh)]
    assert off[1] < 0.5 * off[0]
    angles = np.sort(found.mesh.face_adjacency_angles)
    assert np.degrees(angles[-20:]).min() > 80.0


@pytest.mark.slow
def test_planes_that_begin_from_the_fuller_surface_compete_with_levels(box, box_echoes, optics):
    fine = box.subdivide_to_size(0.6 * optics.wavelength)
    fuller = trimesh.smoothing.filter_laplacian(fine.copy(), iterations=2)
    levels = trimesh.smoothing.filter_laplacian(fine.copy().apply_scale(0.9), iterations=3)
    starts = {"levels": levels, "fuller": fuller}
    work = begun(starts, box_echoes, optics)
    first = work.candidates[0]
    np.testing.assert_array_equal(first.meshes[0].vertices, fuller.vertices)
    work.first_stage()
    assert (first.schedule, first.start) == ("planes", "levels")
    np.testing.assert_array_equal(first.meshes[0].vertices, levels.vertices)
    assert math.isfinite(first.objectives[0])


def test_a_ball_has_no_flat_parts(bumpy, echoes, optics):
    work = begun({"levels": bumpy}, echoes, optics)
    assert [one.schedule for one in work.candidates] == ["sharp"]


@pytest.mark.slow
def test_a_candidate_does_not_depend_on_the_others(bumpy, echoes, optics):
    ends = []
    for starts in ({"given": bumpy}, {"levels": bumpy.copy().apply_scale(1.05), "given": bumpy}):
        saved = {}
        begun(starts, echoes, optics, saved=saved).first_stage()
        ends.append(saved)
    for way in ("blurred", "sharp"):
        one, other = (saved[f"given-{way}-0"]["vertices"].numpy() for saved in ends)
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("objectives", "best"),
    [
        ((9.0, 5.0, 5.4, 4.0), 3),
        ((9.0, 5.0, 5.1, 5.4), 1),
        ((math.nan, 5.0, 4.4, 4.3), 3),  # the start does not count
        ((4.0, 5.0, math.inf), 1),  # what cannot be traced
    ],
)
def test_the_refined_surface_with_the_least_objective_is_kept(bumpy, objectives, best):
    candidate = Candidate("sharp", "given", None, [bumpy] * len(objectives), list(objectives))
    assert candidate.best == best


def test_planes_are_compared_with_free_surfaces_without_their_onsets(bumpy):
    def candidate(schedule, objective, misfit):
        mesh = bumpy.copy()
        mesh.metadata["misfit"] = misfit
        return Candidate(schedule, "levels", None, [bumpy, mesh], [math.nan, objective])

    def misfit(mesh):
        return mesh.metadata["misfit"]

    planes, near = candidate("planes", 6.0, 3.0), candidate("sharp", 5.0, 1.0)
    far = candidate("blurred", 5.5, 3.0)
    assert after_first_stage([planes, near, far], misfit) == [planes]
    assert after_first_stage([near, far], misfit) == [near]
    assert after_first_stage([candidate("planes", 6.0, 1.0), near, far], misfit) == [near]
    doubtful = candidate("planes", 6.0, 1.9)
    assert after_first_stage([doubtful, near, far], misfit) == [doubtful, near]


@pytest.fixture(scope="module")
def too_large():
    return remesh(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS + 4e-4), 2.5e-3)


def descent_on(mesh, echoes, optics):
    level = ErrorLevel(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
    level.learns = "none"
    smoothing = 1.5 * optics.wavelength
    return Descent(mesh, echoes, optics, level, smoothing=smoothing, rate=0.02, seed=0)


def off(descent, heard):
    return float((descent.vertices[heard].norm(dim=1) - RADIUS).abs().mean())


def test_a_sphere_that_is_too_large_shrinks_to_what_is_heard(too_large, echoes, optics):
    work = descent_on(too_large, echoes, optics)
    heard = poses_that_hear(too_large, echoes, optics) > 0
    assert 0.05 < float(heard.double().mean()) < 1.0
    before = off(work, heard)
    errors = [work.step(number, number / 25) for number in range(25)]
    assert off(work, heard) < 0.4 * before
    assert np.mean(errors[-5:]) < 0.7 * np.mean(errors[:3])


def test_where_nobody_listens_nothing_moves(too_large, echoes, optics):
    places = echoes.positions[echoes.training]
    some = echoes.training[places[:, 2] > 0.1]
    split = np.full(len(echoes.positions), 1)
    split[some] = 0
    upper = changed(echoes, split=split)
    work = descent_on(too_large, upper, optics)
    start = work.vertices.clone()
    for number in range(6):
        work.step(number, 0.0)
    moved = ((work.vertices - start) * torch.nn.functional.normalize(start, dim=1)).sum(1).abs()
    below = start[:, 2] < -0.6 * RADIUS
    above = start[:, 2] > 0.3 * RADIUS
    assert float(moved[below].mean()) < 0.35 * float(moved[above].mean())


def test_onsets_move_the_surface_to_where_it_must_begin(echoes, optics):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    onsets = OnsetRanges(
        onsets_of(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS + 1e-3)), 0.006, seed=0
    )
    sizes = []
    for known in (None, onsets):
        level = ErrorLevel(optics.ears, len(optics.frequencies), optics.get_buffer("wavenumber"))
        work = Descent(
            ball, echoes, optics, level, smoothing=0.004, rate=0.02, onsets=known, seed=0
        )
        for number in range(5):
            work.step(number, 0.0)
        sizes.append(float(work.vertices.norm(dim=1).mean()))
    assert sizes[1] > sizes[0] + 5e-5
