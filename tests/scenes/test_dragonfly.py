# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.blade import Blade
from sononerf_scenes.bodies import EDGE
from sononerf_scenes.dragonfly import WING_CLEARANCE, Seat, dragonfly_on

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults


def blade(curl=0.0, bend=0.0, undulation=0.0, width=0.1):
    return Blade.drawn(
        1,
        length=0.18,
        width=width,
        thickness=4e-4,
        curl=np.radians(curl),
        bend=np.radians(bend),
        undulation=undulation,
    )


def seat(leaf, along=0.0, across=0.0, heading=0.0, length=0.05):
    return Seat(leaf, along, across, np.radians(heading), length)


def parts(mesh):
    return sorted(mesh.split(only_watertight=True), key=lambda part: -part.extents.max())


@pytest.fixture(scope="module")
def on_flat():
    return dragonfly_on(seat(blade()))


def test_it_has_all_its_parts_each_closed_and_fine(on_flat):
    assert surface_faults(on_flat) == []
    bodies = parts(on_flat)
    # Head, two eyes, thorax, abdomen, six legs and four wings.
    assert len(bodies) == 15
    assert all(body.euler_number == 2 for body in bodies)
    assert on_flat.edges_unique_length.max() <= EDGE


def test_on_a_flat_leaf_it_is_as_long_as_said_and_alike_on_both_sides(on_flat):
    # Heading 0: the head is towards the tip, +z.
    bodies = parts(on_flat)
    abdomen = next(b for b in bodies if 0.03 < b.extents[2] and b.extents[1] < 0.004)
    assert abdomen.bounds[0, 2] == pytest.approx(-0.025, abs=1e-6)
    head = [b for b in bodies if b.bounds[1, 2] > 0.02 and b.extents[0] > 2e-3]
    assert max(b.bounds[1, 2] for b in head) == pytest.approx(0.025, abs=3e-4)
    np.testing.assert_allclose(on_flat.bounds[:, 1].sum(), 0.0, atol=2e-4)
    # Wings: 36 mm each from a root 1 mm off the middle.
    assert on_flat.extents[1] == pytest.approx(0.073, abs=2e-3)


def test_wings_are_thin_sheets_that_do_not_touch(on_flat):
    wings = parts(on_flat)[:5]
    wings = [wing for wing in wings if wing.extents[1] > 0.03]
    assert len(wings) == 4
    for wing in wings:
        # Its volume is the area of one side, without the rim, times the thickness.
        flat = wing.face_normals[wing.area_faces.argmax()]
        sides = wing.area_faces[np.abs(wing.face_normals @ flat) > 0.99].sum()
        assert wing.volume / (sides / 2) == pytest.approx(3e-4, rel=1e-3)
    for side in (1.0, -1.0):
        fore, hind = sorted(
            (wing for wing in wings if wing.centroid[1] * side > 0.0),
            key=lambda wing: -wing.centroid[2],
        )
        gap = np.linalg.norm(fore.vertices[:, None] - hind.vertices[None, ::3], axis=-1).min()
        assert gap > 1e-3


@pytest.mark.parametrize(
    ("curl", "bend", "heading"), [(0.0, 0.0, 0.0), (90.0, 30.0, 70.0), (-90.0, -60.0, 200.0)]
)
def test_the_body_stands_3_to_6_mm_above_the_leaf_and_the_feet_reach_it(curl, bend, heading):
    leaf = blade(curl, bend, undulation=7e-4)
    place = seat(leaf, 0.01, -0.005, heading)
    bodies = parts(dragonfly_on(place))
    heights = [leaf.clearance(body.vertices) for body in bodies]
    thin = [body.volume < 6e-9 and body.extents.max() > 6e-3 for body in bodies]
    legs = [high for high, is_leg in zip(heights, thin, strict=True) if is_leg]
    assert len(legs) == 6
    for high in legs:
        assert -3e-4 < high.min() < 0.0
    wing = [body.volume < 1e-7 and body.extents.max() > 0.025 for body in bodies]
    assert sum(wing) == 4
    stands = [
        high.min()
        for high, is_leg, is_wing in zip(heights, thin, wing, strict=True)
        if not (is_leg or is_wing)
    ]
    # Head, thorax and abdomen; the eyes are higher up.
    assert 3e-3 < min(stands)
    assert sorted(stands)[2] < 6e-3


def test_ten_segments_and_a_waist(on_flat):
    abdomen = max(parts(on_flat), key=lambda b: b.extents[2] if b.extents[1] < 0.004 else 0.0)
    middle = abdomen.vertices[:-2].reshape(-1, 12, 3)
    radius = np.linalg.norm(middle - middle.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    inner = radius[2:-2]
    furrows = (inner[1:-1] < inner[:-2]) & (inner[1:-1] < inner[2:])
    assert furrows.sum() == 9
    share = np.linspace(0.0, 1.0, len(radius))
    around = [radius[(share > low) & (share < low + 0.1)].max() for low in (0.02, 0.18, 0.4)]
    assert around[1] < 0.85 * min(around[0], around[2])


def test_heading_turns_it_about_the_normal():
    # Counter-clockwise seen from above the leaf, from +x: from +z to -y.
    mesh = dragonfly_on(seat(blade(), 0.01, 0.02, 90.0))
    abdomen = max(parts(mesh), key=lambda b: b.extents[1] if b.extents[2] < 0.004 else 0.0)
    assert abdomen.bounds[1, 1] == pytest.approx(0.02 + 0.025, abs=1e-6)
    assert abdomen.bounds[:, 2].mean() == pytest.approx(0.01, abs=1e-6)


@pytest.mark.parametrize("heading", [45.0, 90.0, -130.0])
def test_all_of_it_turns_together(on_flat, heading):
    """Wings, eyes and legs too; the feet alone find a vein here and there, 0.6 mm high."""
    cos, sin = np.cos(np.radians(heading)), np.sin(np.radians(heading))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])  # +z to -y about +x
    found = dragonfly_on(seat(blade(), heading=heading))
    middles = [[part.centroid for part in mesh.split()] for mesh in (on_flat, found)]
    np.testing.assert_allclose(middles[1], np.array(middles[0]) @ turn.T, atol=6e-4)


def test_wings_stay_clear_of_a_hollow_leaf():
    leaf = blade(curl=100.0)
    mesh = dragonfly_on(seat(leaf, length=0.06))
    wings = [b for b in parts(mesh)[:5] if b.volume < 2e-7 and b.extents.max() > 0.03]
    assert len(wings) == 4
    points = np.concatenate([wing.vertices for wing in wings])
    along, across, _ = leaf.unplaced(points)
    over = leaf.outline.contains(np.stack([along, across], axis=1))
    low = leaf.clearance(points[over]).min()
    assert WING_CLEARANCE - 2e-4 < low < WING_CLEARANCE + 2e-3
    # On a flat leaf they are spread lower.
    level = dragonfly_on(seat(blade(), length=0.06))
    assert level.bounds[1, 0] < mesh.bounds[1, 0] - 0.01


def test_a_seat_holds_what_stays_over_the_leaf():
    assert seat(blade()).holds()
    assert seat(blade(), across=0.03).holds()
    assert not seat(blade(), across=0.03, heading=90.0).holds()
    assert not seat(blade(), along=0.07).holds()
    # Feet reach 10 mm to the side, and 2 mm are to be left.
    assert not seat(blade(), across=0.039).holds()


def test_a_leaf_rolled_up_has_no_room_for_wings():
    with pytest.raises(SettingsError, match="curled too tightly for the wings"):
        dragonfly_on(seat(blade(curl=350.0, width=0.07), length=0.08))
