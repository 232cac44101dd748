# SPDX-License-Identifier: MIT
import logging
import sys

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError, SettingsError
from sononerf.geometry.meshes import Plane
from sononerf.scene.material import LEAF, MATERIALS, RIGID, Material
from sononerf.scene.scene import Scene, SurfaceSizeError, list_scenes, load_scene
from sononerf.settings import loading


def box(size=0.1):
    return trimesh.creation.box((size, size, size))


def test_a_good_mesh_passes_without_a_word(caplog):
    assert Scene(box()).material == Material()
    assert not caplog.records


def test_a_mesh_without_triangles_is_refused():
    with pytest.raises(InputError, match="no triangles"):
        Scene(trimesh.Trimesh())


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_the_first_vertex_that_is_no_number_is_named(value):
    mesh = trimesh.Trimesh(box().vertices.copy(), box().faces, process=False, validate=False)
    mesh.vertices[5, 1] = value
    with pytest.raises(InputError, match="vertex 5 of the mesh"):
        Scene(mesh)


def test_a_triangle_that_names_no_vertex_is_refused():
    mesh = trimesh.Trimesh(np.eye(3), [[0, 1, 3]], process=False, validate=False)
    with pytest.raises(InputError, match="names no vertex"):
        Scene(mesh)


@pytest.mark.parametrize(("size", "said"), [(101.0, "101"), (0.9e-3, "0.0009")])
def test_sizes_beyond_any_scene_are_refused(size, said):
    # What is to be done about it only those know who made the mesh.
    message = f"^the mesh is {said} m large, expected 0.001 to 100 m$"
    with pytest.raises(SurfaceSizeError, match=message) as caught:
        Scene(box(size))
    assert caught.value.is_too_large == (size > 1)


@pytest.mark.parametrize("size", [99.0, 1.1e-3])
def test_sizes_within_the_bounds_pass(size):
    assert Scene(box(size)).mesh.extents.max() == pytest.approx(size)


@pytest.mark.parametrize(
    ("size", "said"),
    [
        (5.1, "5.1 m large; were millimetres taken for metres? It would be 5.1 mm"),
        (4.9e-3, "4.9 mm large; were metres taken for millimetres? It would be 4.9 m"),
    ],
)
def test_sizes_of_likely_another_unit_are_told_of(caplog, size, said):
    Scene(box(size))
    assert caplog.messages == [f"the mesh is {said}"]
    caplog.clear()
    Scene(box(min(max(size, 5.1e-3), 4.9)))
    assert not caplog.records


def test_a_fault_is_told_of_once_and_its_image_in_a_plane_says_nothing(caplog):
    inside_out = trimesh.util.concatenate([box(), box().apply_translation((0.3, 0.0, 0.0))])
    inside_out.faces[:12] = inside_out.faces[:12, ::-1]
    scene = Scene(inside_out)
    assert len(caplog.messages) == 1
    scene.with_image(Plane((0.0, 0.0, -0.05), (0.0, 0.0, 1.0)))
    Scene(inside_out, warns=False)
    assert len(caplog.messages) == 1


def test_open_and_inside_out_meshes_are_told_of(caplog):
    mesh = box()
    Scene(trimesh.Trimesh(mesh.vertices, mesh.faces[:-1]))
    Scene(trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1]))
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    assert "open (3 edges" in caplog.messages[0]
    assert "inside out" in caplog.messages[1]
    assert {record.name for record in caplog.records} == {"sononerf"}


@pytest.mark.parametrize(
    ("material", "part", "match"),
    [
        ((RIGID, LEAF), None, "given together"),
        (RIGID, np.zeros(12, int), "given together"),
        ((RIGID, LEAF), np.zeros(11, int), r"part has shape \(11,\), .*each of the 12 triangles"),
        ((RIGID, LEAF), np.zeros((12, 1), int), r"part has shape \(12, 1\)"),
        ((RIGID, LEAF), np.full(12, 2), "expected 0 to 1"),
        ((RIGID, LEAF), np.full(12, -1), "expected 0 to 1"),
        ((RIGID, LEAF), np.full(12, 0.5), "expected 0 to 1"),
    ],
)
def test_parts_that_do_not_fit_the_mesh_or_the_materials_are_refused(material, part, match):
    with pytest.raises(InputError, match=match) as error:
        Scene(box(), material, part)
    assert "\n" not in str(error.value)


def test_each_triangle_may_have_its_material():
    assert Scene(box()).materials == (RIGID,)
    scene = Scene(box(), (RIGID, LEAF), np.repeat([0, 1], 6).astype(np.uint8))
    assert scene.materials == (RIGID, LEAF)
    assert scene.part.dtype == np.int64
    np.testing.assert_array_equal(scene.part, np.repeat([0, 1], 6))


@pytest.mark.parametrize(
    ("background", "match"),
    [
        (np.zeros(11, bool), r"bool of shape \(11,\), expected one bool for each of the 12"),
        (np.zeros((12, 1), bool), r"shape \(12, 1\)"),
        (np.zeros(12, int), "background is int64"),
        (np.ones(12, bool), "all triangles are background"),
    ],
)
def test_a_background_that_does_not_fit_or_is_all_is_refused(background, match):
    with pytest.raises(InputError, match=match) as error:
        Scene(box(), background=background)
    assert "\n" not in str(error.value)


def test_some_triangles_may_be_background():
    assert Scene(box()).background is None
    background = np.arange(12) > 0
    np.testing.assert_array_equal(Scene(box(), background=background).background, background)


def test_target_and_surroundings_are_taken_apart():
    whole = Scene(box())
    assert whole.surface(background=True) is None
    assert len(whole.surface(background=False).faces) == 12
    marked = np.asarray(box().face_normals)[:, 2] < -0.5  # the two triangles below
    scene = Scene(box(), background=marked)
    below, rest = scene.surface(background=True), scene.surface(background=False)
    assert len(below.faces) == 2
    np.testing.assert_allclose(below.face_normals, [[0, 0, -1]] * 2)
    assert len(below.vertices) == 4
    assert len(rest.faces) == 10
    assert len(scene.mesh.faces) == 12


def test_built_in_scenes_are_listed():
    names = {plugin.name for plugin in list_scenes() if plugin.distribution == "sononerf"}
    assert {"sphere", "three_spheres", "ua", "mesh"} <= names


def test_options_reach_the_factory():
    assert load_scene("sphere", {"radius": 0.05}).mesh.extents[0] == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["sphere", "three_spheres", "ua"])
@pytest.mark.parametrize("material", ["rigid", "sonotracelab", "leaf", "insect"])
def test_the_material_of_a_built_in_scene_is_an_option(name, material):
    assert load_scene(name, {"material": material}).material == MATERIALS[material]


@pytest.mark.parametrize("name", ["sphere", "three_spheres", "ua", "mesh"])
def test_an_unknown_material_is_refused_with_the_known_ones(name):
    with pytest.raises(SettingsError, match=r"material.*rigid.*sonotracelab.*leaf.*insect"):
        load_scene(name, {"material": "wood"} | ({"path": "a.stl"} if name == "mesh" else {}))


def test_scenes_are_rigid_unless_told_otherwise():
    assert load_scene("three_spheres").material == RIGID


def test_wrong_options_and_names_are_refused():
    with pytest.raises(SettingsError, match=r"scene\.options\.radios: unknown key; .*radius"):
        load_scene("sphere", {"radios": 1.0})
    with pytest.raises(SettingsError, match="radius"):
        load_scene("sphere", {"radius": -1.0})
    with pytest.raises(SettingsError, match="did you mean sphere"):
        load_scene("spher")


def test_faults_of_options_name_the_file_that_sets_them():
    for name, options in [
        ("sphere", {"radius": -1.0, "radios": 1.0}),  # found before the factory is called
        ("torus", {"major_radius": 0.01, "minor_radius": 0.02}),  # found by the factory
        ("spher", {}),
        ("sphere", {"radius": 100}),  # found by what checks every scene
    ]:
        with pytest.raises(SettingsError) as caught:
            load_scene(name, options, source="mine.yaml")
        assert all(line.startswith("mine.yaml: ") for line in str(caught.value).splitlines())


def test_a_mesh_without_any_area_is_refused():
    line = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(InputError, match="no triangle of the mesh has an area"):
        Scene(line)


def unreadable(size: "NoSuchType" = 1):  # noqa: F821
    """A factory whose annotation names nothing."""


@pytest.mark.parametrize(
    ("factory", "match"),
    [
        (lambda: 5, "returned int, expected a Scene"),
        (lambda: 1 / 0, "failed: ZeroDivisionError: division by zero"),
        (lambda: sys.exit(3), "failed: SystemExit: 3"),
        (unreadable, ": scene.options: the factory's annotations cannot be read: .*NoSuchType.*"),
    ],
)
def test_a_faulty_factory_is_named_with_its_distribution(monkeypatch, factory, match):
    monkeypatch.setattr(loading, "load", lambda group, name: factory)
    with pytest.raises(InputError, match=rf"^scene 'sphere' of sononerf \S+? ?{match}$"):
        load_scene("sphere")
