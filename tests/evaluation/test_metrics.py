# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.metrics import geometry_metrics, target_metrics
from sononerf.evaluation.numbers import added_part, compare
from sononerf.evaluation.traced import covered, interval_db, learn_interval
from sononerf.geometry.lattice import Volume, grid_over
from sononerf.head.front_end import RANGE_DB

RADIUS = 0.015


def sphere(radius, centre=(0, 0, 0), subdivisions=5):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.apply_translation(centre)
    return mesh


@pytest.fixture(scope="module")
def grown():
    return geometry_metrics(sphere(RADIUS + 0.0011), sphere(RADIUS), samples=5000)


def test_a_sphere_grown_by_a_millimetre(grown):
    # The tessellation lies up to 0.01 mm below the sphere.
    assert grown["chamfer_m"] == pytest.approx(0.0011, abs=1e-5)
    assert grown["thickness_bias_m"] == pytest.approx(0.0011, abs=1e-5)
    ratio = (16.1 / 15) ** 3
    assert grown["volume_ratio"] == pytest.approx(ratio, rel=1e-3)
    assert grown["iou"] == pytest.approx(1 / ratio, rel=1e-3)
    assert grown["normal_consistency"] == pytest.approx(1, abs=2e-3)
    assert grown["components"] == grown["components_true"] == 1


def test_fscores_step_where_the_distance_is(grown):
    assert grown["fscore"] == {"0.001": 0.0, "0.002": 1.0, "0.005": 1.0}


def test_a_shrunken_sphere_has_a_negative_bias():
    found = geometry_metrics(sphere(RADIUS - 0.001), sphere(RADIUS), samples=2000)
    assert found["thickness_bias_m"] == pytest.approx(-0.001, abs=1e-5)
    assert found["chamfer_m"] == pytest.approx(0.001, abs=1e-5)


def test_a_perfect_reconstruction_is_perfect():
    box = trimesh.creation.box((0.02, 0.03, 0.04))
    found = geometry_metrics(box, box, samples=2000)
    assert found["chamfer_m"] < 1e-9
    assert abs(found["thickness_bias_m"]) < 1e-9
    assert found["iou"] == pytest.approx(1)
    assert found["fscore"]["0.001"] == 1


def test_a_missing_part_costs_recall_alone():
    both = trimesh.util.concatenate([sphere(RADIUS), sphere(RADIUS, (0, 0.1, 0))])
    found = geometry_metrics(sphere(RADIUS), both, samples=5000)
    # Precision 1, recall one half; three standard deviations of the recall are 0.02.
    assert found["fscore"]["0.001"] == pytest.approx(2 / 3, abs=0.02)
    assert found["volume_ratio"] == pytest.approx(0.5, rel=1e-3)
    assert found["iou"] == pytest.approx(0.5, rel=1e-3)
    assert found["thickness_bias_m"] == pytest.approx(0, abs=1e-6)
    assert (found["components"], found["components_true"]) == (1, 2)
    # Of a sphere's points the mean distance from a place at d outside is d + R² / 3 d.
    away = 0.1 + RADIUS**2 / 0.3 - RADIUS
    assert found["chamfer_m"] == pytest.approx(away / 4, rel=0.03)
    grown = geometry_metrics(both, sphere(RADIUS), samples=5000)
    assert grown["chamfer_m"] == pytest.approx(away / 4, rel=0.03)


def test_inner_walls_of_the_truth_do_not_count():
    centres = [(0, 0, 0), (0, 1.6 * RADIUS, 0)]
    truth = trimesh.util.concatenate([sphere(RADIUS, centre) for centre in centres])
    hull = trimesh.util.concatenate([sphere(RADIUS + 1e-3, centre) for centre in centres])
    found = geometry_metrics(hull, truth, samples=5000)
    distance = 1.6
    lens = np.pi * (4 + distance) * (2 - distance) ** 2 / 12
    true_volume = RADIUS**3 * (8 / 3 * np.pi - lens)
    wide = distance * RADIUS / (RADIUS + 1e-3)
    wide_lens = np.pi * (4 + wide) * (2 - wide) ** 2 / 12
    volume = (RADIUS + 1e-3) ** 3 * (8 / 3 * np.pi - wide_lens)
    assert found["volume_ratio"] == pytest.approx(volume / true_volume, rel=2e-3)
    assert found["components_true"] == 1
    # The reconstruction's own inner walls do count: they lie inside, so the bias stays below 1 mm.
    assert found["thickness_bias_m"] < 0.9e-3


def test_the_way_out_of_a_union_does_not_end_at_an_inner_wall():
    centres = [(0, 0, 0), (0, 1.6 * RADIUS, 0)]
    truth = trimesh.util.concatenate([sphere(RADIUS, centre) for centre in centres])
    speck = sphere(1e-4, (0, 0.8 * RADIUS, 0), 1)
    # The seam is 0.6 radii away, true to one triangle of 0.5 mm; the walls inside are at 0.2.
    found = geometry_metrics(speck, truth, samples=500)
    assert found["thickness_bias_m"] == pytest.approx(-0.6 * RADIUS, abs=6e-4)


def test_an_open_reconstruction_has_no_volume():
    sheet = trimesh.Trimesh([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]], [[0, 1, 2]])
    found = geometry_metrics(sheet, sphere(RADIUS), samples=500)
    assert found["volume_ratio"] is found["iou"] is None
    assert found["thickness_bias_m"] < 0
    found = geometry_metrics(sphere(RADIUS), sheet, samples=500)
    assert found["volume_ratio"] is found["iou"] is found["thickness_bias_m"] is None


def test_the_same_seed_gives_the_same_numbers():
    one, other = (
        geometry_metrics(sphere(RADIUS, subdivisions=2), sphere(0.016), samples=500, seed=seed)
        for seed in (7, 7)
    )
    assert one == other


def test_wrong_input_is_refused():
    with pytest.raises(NumericalError, match="empty"):
        geometry_metrics(trimesh.Trimesh(), sphere(RADIUS, subdivisions=1))
    small = sphere(RADIUS, subdivisions=1)
    assert target_metrics(small, small, ground(), samples=1)["chamfer_m"] < 1e-6


def ground(size=0.2):
    """A slab whose upper side lies 50 mm below the origin."""
    slab = trimesh.creation.box((size, size, 0.01))
    slab.apply_translation((0, 0, -0.055))
    return slab


@pytest.mark.slow
def test_surroundings_cost_the_target_nothing():
    """A perfect target beside ground that is 3 mm off: its half of the gap belongs to neither."""
    low = ground()
    low.apply_translation((0, 0, -0.003))
    found = trimesh.util.concatenate([sphere(RADIUS), low])
    of_target = target_metrics(found, sphere(RADIUS), ground(), samples=20_000)
    assert of_target["chamfer_m"] < 1e-5
    assert of_target["fscore"] == {"0.001": 1.0, "0.002": 1.0, "0.005": 1.0}
    assert of_target["share"] == pytest.approx(sphere(RADIUS).area / found.area, rel=0.1)
    assert geometry_metrics(found, sphere(RADIUS), samples=5000)["chamfer_m"] > 0.01


@pytest.mark.slow
def test_what_grew_off_the_target_towards_the_ground_counts_against_it():
    # Two thirds of the way from the sphere (bottom at -15 mm) to the ground (top at -50 mm).
    lump = sphere(0.002, (0, 0, -0.025))
    plain = target_metrics(sphere(RADIUS), sphere(RADIUS), ground(), samples=20_000)
    grown = trimesh.util.concatenate([sphere(RADIUS), lump])
    with_lump = target_metrics(grown, sphere(RADIUS), ground(), samples=20_000)
    share = lump.area / grown.area
    # 10 mm off, give or take the lump's own size; the mean of both ways halves it.
    assert with_lump["chamfer_m"] - plain["chamfer_m"] == pytest.approx(share * 0.01 / 2, rel=0.1)
    below = trimesh.util.concatenate([sphere(RADIUS), sphere(0.002, (0, 0, -0.045))])
    assert target_metrics(below, sphere(RADIUS), ground(), samples=20_000)["chamfer_m"] < 1e-5


def test_a_target_that_is_missing_scores_nothing():
    found = target_metrics(ground(), sphere(RADIUS), ground(), samples=2000)
    assert found == {
        "share": 0.0,
        "chamfer_m": None,
        "fscore": {"0.001": 0.0, "0.002": 0.0, "0.005": 0.0},
    }
    half = trimesh.util.concatenate([ground(), sphere(RADIUS, (0.03, 0, 0))])
    beside = target_metrics(half, sphere(RADIUS), ground(), samples=2000)
    assert beside["chamfer_m"] > 0.005


@pytest.mark.slow
def test_ground_that_lies_near_does_not_stand_in_for_what_is_missing():
    """The upper half of a sphere that lies 1 mm above the ground: with or without the ground."""
    low = sphere(RADIUS, (0, 0, -0.05 + 0.001 + RADIUS))
    upper = low.copy()
    upper.update_faces(upper.triangles_center[:, 2] > -0.05 + 0.001 + RADIUS)
    alone = target_metrics(upper, low, ground(), samples=20_000)
    above = target_metrics(
        trimesh.util.concatenate([upper, ground()]), low, ground(), samples=50_000
    )
    assert alone["share"] == 1
    assert above["chamfer_m"] == pytest.approx(alone["chamfer_m"], rel=0.05)
    # Of the lower half all but a ring of 5 mm (a third of the half) is farther than 5 mm.
    assert alone["fscore"]["0.005"] == pytest.approx(2 / (1 + 1 / 0.67), abs=0.05)


def drawn(seed, poses=12):
    """Levels, and predictions whose error grows with the level and with the frequency."""
    rng = np.random.default_rng(seed)
    predicted = rng.uniform(0.0, 50.0, (poses, 2, 40, 24))
    spread = (0.5 + predicted / 10.0) * np.linspace(0.5, 2.0, 24)
    return predicted + spread * rng.standard_normal(predicted.shape), predicted


def test_nine_tenths_of_new_cells_lie_within_the_interval_at_each_level_and_frequency():
    half = learn_interval(*drawn(0), 3.0)
    measured, predicted = drawn(1)
    found = interval_db(predicted, half)
    assert covered(measured, predicted, found, 3.0) == pytest.approx(0.9, abs=0.02)
    loud = predicted > 30.0
    within = np.abs(measured - predicted) <= found
    for part in (loud[..., :8], loud[..., 16:]):
        cells = within[..., :8] if part is loud[..., :8] else within[..., 16:]
        assert cells[part].mean() == pytest.approx(0.9, abs=0.06)
    assert found[..., -1][loud[..., -1]].mean() > 2.0 * found[..., 0][loud[..., 0]].mean()


def test_levels_that_were_never_predicted_are_as_uncertain_as_lower_ones():
    measured, predicted = drawn(0)
    low = np.minimum(predicted, 20.0)
    half = learn_interval(np.minimum(measured, 20.0), low, 3.0)
    assert (interval_db(np.full((1, 24), 55.0), half) == half[3]).all()


def test_lower_levels_that_were_never_predicted_are_as_uncertain_as_higher_ones():
    measured, predicted = drawn(0)
    half = learn_interval(measured + 24.0, predicted + 24.0, 3.0)
    assert (interval_db(np.full((1, 24), 4.0), half) == half[4]).all()
    assert (half[4] > 0.0).all()


def test_where_nothing_was_heard_a_level_is_not_known():
    silent = np.zeros((2, 1, 5, 3))
    assert (learn_interval(silent, silent, 3.0) == RANGE_DB).all()
    assert covered(silent, silent, silent, 3.0) is None


GRID = grid_over([-0.03] * 3, [0.03] * 3, 0.005)


def bump(place, height=1.0, width=0.006):
    """A Gaussian about a place, m."""
    distance = np.linalg.norm(GRID.points() - place, axis=1)
    values = height * np.exp(-0.5 * (distance / width) ** 2)
    return values.reshape(GRID.shape)


def test_what_only_the_first_has_is_found_where_it_is():
    both, more = bump([0.0, 0.0, -0.015]), bump([0.0, 0.01, 0.015], 0.5)
    found = compare(GRID.with_values(both + more), GRID.with_values(both))
    np.testing.assert_allclose(found.strongest, [0.0, 0.01, 0.015], atol=1e-9)
    np.testing.assert_allclose(found.difference.values, found.first.values - found.second.values)
    assert found.score == pytest.approx(0.5, rel=0.01)
    # What is missing from the first is no place of its own.
    turned = compare(GRID.with_values(both), GRID.with_values(both + more))
    assert turned.score < 0.01
    np.testing.assert_allclose(turned.difference.values, -found.difference.values)


def test_the_common_maximum_is_one():
    faint, loud = GRID.with_values(bump([0, 0, 0], 1e-9)), GRID.with_values(bump([0, 0, 0], 4e-9))
    for pair in ((faint, loud), (loud, faint)):
        found = compare(*pair)
        assert max(found.first.values.max(), found.second.values.max()) == pytest.approx(1.0)
        assert min(found.first.values.max(), found.second.values.max()) == pytest.approx(0.25)


def test_equal_fields_do_not_differ():
    one = GRID.with_values(bump([0, 0, 0]))
    found = compare(one, one)
    assert found.score == 0
    assert found.strongest is None
    assert (found.difference.values == 0).all()


def test_what_is_weaker_everywhere_is_strongest_nowhere():
    found = compare(GRID.with_values(bump([0, 0, 0])), GRID.with_values(bump([0, 0, 0]) + 1.0))
    assert found.score < 0
    assert found.strongest is None


def test_what_cannot_be_compared():
    one = GRID.with_values(bump([0, 0, 0]))
    with pytest.raises(ValueError, match="different grids"):
        compare(one, Volume(one.values, one.origin + 0.001, one.spacing))
    with pytest.raises(ValueError, match="different grids"):
        compare(one, Volume(one.values, one.origin, 0.004))
    with pytest.raises(NumericalError, match="both are silent"):
        compare(GRID, GRID)


def test_what_was_added_is_told_from_what_was_there():
    body = trimesh.creation.box((0.1, 0.02, 0.1))
    more = trimesh.creation.icosphere(radius=0.01).apply_translation([0.0, 0.02, 0.03])
    both = trimesh.util.concatenate([body, more])
    found = added_part(both, body)
    assert len(found.faces) == len(more.faces)
    np.testing.assert_allclose(found.bounds, more.bounds)
    assert added_part(body, both) is None
    assert added_part(body, body) is None
