# SPDX-License-Identifier: MIT
"""Closed surfaces, sheets, and what was heard from one side alone."""

import io

import numpy as np
import pytest
import trimesh
from skimage.measure import marching_cubes

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.meshes import Plane
from sononerf.scene.gltf import Z_UP
from sononerf.start import surface
from sononerf.start.surface import (
    MANY_POSES,
    MAX_SHEET_THICKNESS,
    MIN_FACING,
    Openness,
    confidence_colours,
    known_part,
    leaving_out,
    linear_light,
    mesh_bytes,
    without_unseen,
)

RADIUS, DISTANCE, RESOLUTION = 0.02, 0.4, 0.006
THINNEST = MAX_SHEET_THICKNESS * RESOLUTION
CAP = np.radians(30)


def judge_openness(mesh, sources, resolution=RESOLUTION, plane=None):
    return surface.judge_openness(mesh, sources, resolution=resolution, plane=plane)


def sphere():
    return trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)


def all_around(count=200):
    return DISTANCE * fibonacci_sphere(count)


def cap(angle=CAP):
    """Poses around the x axis, dense at the cap's edge, which alone says how far they see."""
    turn = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    rings = [
        np.stack((0 * turn + np.cos(a), np.sin(a) * np.cos(turn), np.sin(a) * np.sin(turn)), axis=1)
        for a in (0.0, angle / 2, angle)
    ]
    return DISTANCE * np.concatenate(rings)


def farthest_seen(angle=CAP):
    """Angle from the x axis down to which a sphere's surface faces a pose at the cap's edge."""
    past = np.linspace(0, np.pi / 2, 100_001)  # angle between a normal and the edge's pose
    ahead = DISTANCE * np.cos(past) - RADIUS
    aside = DISTANCE * np.sin(past)
    return angle + past[np.flatnonzero(ahead / np.hypot(ahead, aside) > MIN_FACING)[-1]]


def plate(thickness, side=0.04):
    return trimesh.creation.box((side, side, thickness)).subdivide_to_size(0.005)


def cup(depth=0.04, inner=0.02, wall=0.008):
    """A pot that is open upwards, and which of its triangles are inside of it."""
    bottom = -wall
    profile = [
        (0.0, bottom), (inner + wall, bottom), (inner + wall, depth), (inner, depth), (inner, 0.0),
        (0.0, 0.0),
    ]  # fmt: skip
    mesh = trimesh.creation.revolve(profile, sections=48).subdivide_to_size(0.005)
    middles = mesh.triangles_center
    out = np.linalg.norm(middles[:, :2], axis=1)
    inside = (out < inner + 1e-6) & (middles[:, 2] > -1e-6) & (middles[:, 2] < depth - 1e-6)
    assert mesh.is_watertight
    assert mesh.volume > 0
    return mesh, inside


def test_a_body_that_was_heard_from_all_around_is_closed():
    found = judge_openness(sphere(), all_around())
    assert found.kind == "closed"
    assert found.unseen.shape == (5120,)
    assert not found.unseen.any()
    assert (found.unseen_share, found.thin_share) == (0.0, 0.0)


def test_of_a_body_heard_from_one_side_the_far_side_is_cut_off():
    mesh = sphere()
    found = judge_openness(mesh, cap())
    edge = farthest_seen()
    assert 105 < np.degrees(edge) < 115
    # What lies behind has a share of (1 + cos) / 2. Its edge is rugged by half a triangle's
    # height, a thirtieth of the radius.
    rugged = 1 / 30
    assert found.unseen_share == pytest.approx((1 + np.cos(edge)) / 2, abs=rugged / 4)
    assert found.kind == "one-sided"
    angle = np.arccos(mesh.triangles_center[:, 0] / np.linalg.norm(mesh.triangles_center, axis=1))
    assert angle[found.unseen].min() > edge - rugged
    assert angle[~found.unseen].max() < edge + rugged
    cut = without_unseen(mesh, found)
    assert len(cut.faces) == (~found.unseen).sum()
    assert len(np.unique(cut.faces)) == len(cut.vertices) < len(mesh.vertices)
    np.testing.assert_allclose(cut.triangles, mesh.triangles[~found.unseen])
    assert not cut.is_watertight
    assert cut.area == pytest.approx((1 - found.unseen_share) * mesh.area)
    assert len(mesh.faces) == 5120  # the given one stays whole


def from_above():
    """Poses around the z axis, as a hand reaches above a table."""
    return cap(np.radians(70))[:, [2, 1, 0]]


def test_what_stands_on_a_support_is_closed():
    """A low cylinder: its bottom is a third of its area, and no pose hears it."""
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.02).subdivide_to_size(0.005)
    bottom = mesh.face_normals[:, 2] < -0.5
    table = Plane((0.0, 0.0, -0.01), (0.0, 0.0, 1.0))
    alone = judge_openness(mesh, from_above())
    assert alone.unseen_share == pytest.approx(0.25, abs=0.01)
    np.testing.assert_array_equal(alone.unseen, bottom)
    assert not judge_openness(mesh, from_above(), plane=table).unseen.any()
    # A gap that sound tells from none is left out; the poses' images see the bottom through it
    # where the image of the bottom is not in the way.
    low = Plane((0.0, 0.0, -0.01 - 0.2 * RESOLUTION), (0.0, 0.0, 1.0))
    assert not judge_openness(mesh, from_above(), plane=low).unseen.any()
    lower = Plane((0.0, 0.0, -0.01 - 0.6 * RESOLUTION), (0.0, 0.0, 1.0))
    hidden = judge_openness(mesh, from_above(), plane=lower).unseen
    assert hidden.any()
    assert not hidden[~bottom].any()


def test_the_underside_is_seen_by_way_of_the_support():
    ball = sphere()
    table = Plane((0.0, 0.0, -2 * RADIUS), (0.0, 0.0, 1.0))
    assert judge_openness(ball, from_above()).unseen_share > 0.05
    assert judge_openness(ball, from_above(), plane=table).unseen_share < 0.02


def test_what_hardly_anyone_missed_is_closed_by_guess():
    """Poses over more than a half leave a share of 0.12: less than a quarter."""
    found = judge_openness(sphere(), cap(np.radians(60)))
    expected = (1 + np.cos(farthest_seen(np.radians(60)))) / 2
    assert 0.1 < expected < 0.15
    assert found.unseen_share == pytest.approx(expected, abs=1 / 120)
    assert found.kind == "closed"


def test_what_stands_in_the_way_hides_what_lies_behind():
    """Of two balls in a row, heard from one end, the rear one is hidden by the front one."""
    front, rear = (trimesh.creation.icosphere(subdivisions=3, radius=r) for r in (0.02, 0.01))
    rear.apply_translation([-0.04, 0.0, 0.0])
    alone = judge_openness(rear, np.array([[DISTANCE, 0.0, 0.0]]))
    assert alone.unseen_share == pytest.approx(0.55, abs=0.02)  # faces the pose, by MIN_FACING
    both = judge_openness(trimesh.util.concatenate([front, rear]), np.array([[DISTANCE, 0.0, 0.0]]))
    count = len(front.faces)
    np.testing.assert_array_equal(
        both.unseen[:count], judge_openness(front, np.array([[DISTANCE, 0.0, 0.0]])).unseen
    )
    assert both.unseen[count:].all()


@pytest.mark.parametrize("thickness", [0.0015, THINNEST - 1e-5])
def test_a_thin_plate_is_a_sheet(thickness):
    mesh = plate(thickness)
    found = judge_openness(mesh, all_around(300))
    assert found.kind == "sheet"
    # Its narrow sides are not thin; their other sides are 40 mm away.
    share = 0.04 / (0.04 + 2 * thickness)
    assert found.thin_share == pytest.approx(share, rel=1e-6)
    assert found.unseen_share == 0.0


@pytest.mark.parametrize("thickness", [THINNEST + 1e-5, 0.01])
def test_a_thick_plate_is_closed(thickness):
    found = judge_openness(plate(thickness), all_around(300))
    assert found.kind == "closed"
    assert found.thin_share == 0.0


def test_what_is_thin_follows_from_the_resolution_and_not_from_the_size_of_triangles():
    mesh = plate(0.004)
    assert judge_openness(mesh, all_around(), 0.006).kind == "sheet"
    assert judge_openness(mesh, all_around(), 0.005).kind == "closed"
    large = mesh.copy().apply_scale(10)
    assert judge_openness(large, 10 * all_around(), 0.06).kind == "sheet"
    fine = mesh.subdivide()
    found = judge_openness(fine, all_around(), 0.006)
    assert found.thin_share == pytest.approx(judge_openness(mesh, all_around(), 0.006).thin_share)


def test_a_plate_that_was_heard_from_one_side_is_one_sided():
    sources = all_around(300)
    mesh = plate(0.0015)
    found = judge_openness(mesh, sources[sources[:, 2] > 0.1])
    assert found.kind == "one-sided"
    top = mesh.face_normals[:, 2] > 0.5
    assert not found.unseen[top].any()
    assert found.unseen[mesh.face_normals[:, 2] < -0.5].all()


def test_a_pit_that_poses_look_into_was_heard():
    mesh, inside = cup(depth=0.01)
    found = judge_openness(mesh, all_around(300))
    assert inside.sum() > 100
    assert not found.unseen.any()
    assert found.kind == "closed"


@pytest.mark.parametrize("count", [100, 400])
def test_a_deep_pit_was_heard_by_poses_that_its_walls_hardly_face(count):
    """The wall faces best the poses that the wall across hides, and more of them the more are."""
    mesh, inside = cup(depth=0.06)
    found = judge_openness(mesh, all_around(count))
    assert inside.mean() > 0.3
    assert found.unseen_share < 0.001
    assert found.kind == "closed"


def test_a_pit_that_no_pose_looks_into_was_not():
    mesh, inside = cup(depth=0.04)
    sources = all_around(300)
    # From 15 degrees above the rim one sees a centimetre of the wall, and no bottom.
    found = judge_openness(mesh, sources[sources[:, 2] < DISTANCE * np.sin(np.radians(15))])
    depth = 0.04 - mesh.triangles_center[:, 2]
    assert inside[depth > 0.02].any()
    assert found.unseen[inside & (depth > 0.02)].all()
    assert not found.unseen[~inside & (depth > 0.002)].any()


@pytest.mark.parametrize(
    ("unseen", "thin", "kind"),
    [
        (0.0, 0.0, "closed"),
        (0.25, 0.75, "closed"),
        (0.26, 0.0, "one-sided"),
        (0.25, 0.76, "sheet"),
        (0.5, 0.9, "one-sided"),  # a sheet that was heard from one side alone
    ],
)
def test_what_is_called_what(unseen, thin, kind):
    assert Openness(np.zeros(3, dtype=bool), unseen, thin).kind == kind


def hull_over(sources):
    """First echoes off the sphere, for heads that call and hear at one place."""
    return EchoHull(
        emitters=sources,
        receivers=sources[:, None],
        first=np.linalg.norm(sources, axis=1, keepdims=True) - RADIUS,
        axes=-sources / np.linalg.norm(sources, axis=1, keepdims=True),
    )


def room_behind(half=0.06):
    """What the onsets of a cap leave of a box, with the walls of the box behind."""
    spacing = 0.002
    hull = hull_over(cap())
    axis = np.arange(-half, half + spacing / 2, spacing)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    inside = hull.clearance(places.reshape(-1, 3))[0].reshape(places.shape[:3])
    vertices, faces, _, _ = marching_cubes(
        np.pad(-inside, 1, constant_values=spacing), 0.0, gradient_direction="ascent"
    )
    mesh = trimesh.Trimesh(vertices * spacing - half - spacing, faces)
    if mesh.volume < 0:
        mesh.invert()
    return mesh, hull, half


def heard_where(mesh, chosen, poses=5):
    return np.where(chosen(mesh.vertices), poses, 0).astype(np.int32)


def test_an_open_surface_ends_where_what_was_heard_ends():
    """Behind a ball heard from one side the onsets leave a cone up to the region's walls."""
    mesh, hull, half = room_behind()
    assert np.abs(mesh.vertices).max() > 0.98 * half
    heard = heard_where(mesh, lambda p: np.linalg.norm(p, axis=1) < RADIUS + 0.001)
    known = known_part(mesh, heard, hull, resolution=RESOLUTION)
    middles = mesh.triangles_center
    away = np.linalg.norm(middles, axis=1)
    assert known[(away < RADIUS) & (middles[:, 0] > 0)].all()
    assert not known[away > RADIUS + 2 * RESOLUTION].any()
    judged = judge_openness(mesh, cap())
    assert judged.kind == "one-sided"
    left = leaving_out(judged, ~known, mesh.area_faces)
    assert left.kind == "one-sided"
    open_ = without_unseen(mesh, left)
    assert 0 < open_.area < 2 * np.pi * RADIUS**2
    assert left.unseen_share == pytest.approx(1 - open_.area / mesh.area)
    assert np.abs(open_.vertices).max() < half - RESOLUTION


def test_between_what_was_heard_the_onsets_close_an_open_surface():
    """Only the middle and a ring of a ball's side are heard; what lies between is kept."""
    mesh, hull, _ = room_behind()

    def rings(places):
        off = np.linalg.norm(places[:, 1:], axis=1)
        return (places[:, 0] > 0) & ((off < 0.004) | (np.abs(off - 0.012) < 0.0015))

    known = known_part(mesh, heard_where(mesh, rings), hull, resolution=RESOLUTION)
    off = np.linalg.norm(mesh.triangles_center[:, 1:], axis=1)
    between = (off > 0.006) & (off < 0.009) & (mesh.triangles_center[:, 0] > 0.01)
    assert between.sum() > 50
    # A ball bulges out of the convex hull of its places by less than the resolution.
    assert known[between].all()
    assert not known[off > 0.02].any()


def test_colours_brighten_evenly_from_grey_to_yellow():
    colours = confidence_colours([0, 1, 3, 10, 30, MANY_POSES, 10 * MANY_POSES])
    assert ((colours >= 0) & (colours <= 1)).all()
    assert np.ptp(colours[0]) < 0.05
    assert colours[-2, 0] > 0.85
    assert colours[-2, 2] < 0.7
    np.testing.assert_array_equal(colours[-2], colours[-1])
    # The eye's lightness, CIE L*, from relative luminance: a rule that the map was not made with.
    even = np.expm1(np.linspace(0, 1, 9) * np.log1p(MANY_POSES))
    luminance = linear_light(confidence_colours(even)) @ [0.2126, 0.7152, 0.0722]
    lightness = 116 * np.cbrt(luminance) - 16
    steps = np.diff(lightness)
    assert steps.min() > 0.8 * steps.mean()
    assert steps.max() < 1.2 * steps.mean()
    assert lightness[0] < 30
    assert lightness[-1] > 85


@pytest.mark.parametrize("file_type", ["ply", "stl", "glb"])
def test_a_file_reads_back_as_the_same_body_and_is_always_the_same(file_type):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.015)
    mesh.apply_translation([0.1, 0.2, 0.3])
    data = mesh_bytes(mesh, file_type)
    back = trimesh.load(io.BytesIO(data), file_type=file_type, force="mesh")
    if file_type == "glb":  # y is up
        back.vertices = back.vertices @ Z_UP.T
    np.testing.assert_allclose(back.bounds, mesh.bounds, atol=1e-7)
    assert back.volume == pytest.approx(mesh.volume, rel=1e-5)
    mesh.metadata["file_name"] = "/somewhere/else.ply"
    assert mesh_bytes(mesh, file_type) == data


def test_what_cannot_be_written_is_refused():
    mesh = trimesh.creation.box()
    with pytest.raises(ValueError, match="file_type"):
        mesh_bytes(mesh, "obj")
    with pytest.raises(NumericalError, match="empty"):
        mesh_bytes(trimesh.Trimesh(), "ply")
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="not finite"):
        mesh_bytes(broken, "ply")


@pytest.mark.parametrize("file_type", ["ply", "glb"])
def test_confidence_is_carried_as_colours(file_type):
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.015)
    poses = np.arange(len(mesh.vertices)) * 3
    data = mesh_bytes(mesh, file_type, confidence=poses)
    assert mesh_bytes(mesh, file_type, confidence=poses) == data
    back = trimesh.load(io.BytesIO(data), file_type=file_type, force="mesh", process=False)
    expected = confidence_colours(poses)
    if file_type == "glb":  # glTF wants linear light
        expected = linear_light(expected)
        back.vertices = back.vertices @ Z_UP.T
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_allclose(back.visual.vertex_colors[:, :3] / 255, expected, atol=0.003)


def test_ply_holds_the_numbers_of_poses_and_stl_nothing_new():
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.015)
    poses = np.arange(len(mesh.vertices)) * 3
    data = mesh_bytes(mesh, "ply", confidence=poses)
    assert b"property int poses" in data.split(b"end_header")[0]
    back = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    read = back.metadata["_ply_raw"]["vertex"]["data"]["poses"]
    np.testing.assert_array_equal(np.ravel(read), poses)
    assert mesh_bytes(mesh, "stl", confidence=poses) == mesh_bytes(mesh, "stl")


@pytest.mark.parametrize("wrong", [[1, 2, 3], -1])
def test_a_wrong_confidence_is_refused(wrong):
    mesh = trimesh.creation.box()
    given = wrong if isinstance(wrong, list) else np.full(len(mesh.vertices), wrong)
    with pytest.raises(ValueError, match="confidence"):
        mesh_bytes(mesh, "ply", confidence=given)
