# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.reconstruction.metrics import geometry_metrics

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
    with pytest.raises(ValueError, match="samples"):
        geometry_metrics(sphere(1, subdivisions=1), sphere(1, subdivisions=1), samples=0)
