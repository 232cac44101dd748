# SPDX-License-Identifier: MIT
import logging

import numpy as np
import pytest
import trimesh

from sononerf import plugins
from sononerf.errors import InputError, SettingsError
from sononerf.scene import Material, Scene, list_scenes, load_scene


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


@pytest.mark.parametrize(("size", "unit"), [(101.0, "mm"), (0.9e-3, "m")])
def test_sizes_that_speak_of_another_unit_are_refused(size, unit):
    with pytest.raises(InputError, match=f"set the unit to {unit}$"):
        Scene(box(size))


@pytest.mark.parametrize("size", [99.0, 1.1e-3])
def test_sizes_within_the_bounds_pass(size):
    Scene(box(size))


def test_open_and_inside_out_meshes_are_told_of(caplog):
    mesh = box()
    Scene(trimesh.Trimesh(mesh.vertices, mesh.faces[:-1]))
    Scene(trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1]))
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    assert "open (3 edges" in caplog.messages[0]
    assert "inside out" in caplog.messages[1]
    assert {record.name for record in caplog.records} == {"sononerf"}


@pytest.mark.parametrize(
    "arguments",
    [
        {"frequency": (2.0, 1.0)},
        {"frequency": (0.0, 1.0)},
        {"strength": (1.0,)},
        {"strength": (1.0, -0.1)},
        {"reflection": (1.0, 1.1)},
        {"lobe_width": (0.0, 0.1)},
        {"lobe_width": (float("nan"), 0.1)},
    ],
)
def test_materials_that_make_no_sense_are_refused(arguments):
    with pytest.raises(ValueError, match="material"):
        Material(**arguments)


def test_built_in_scenes_are_listed():
    names = {plugin.name for plugin in list_scenes() if plugin.distribution == "sononerf"}
    assert {"sphere", "three_spheres", "ua", "mesh"} <= names


def test_options_reach_the_factory():
    assert load_scene("sphere", {"radius": 0.05}).mesh.extents[0] == pytest.approx(0.1)


def test_wrong_options_and_names_are_refused():
    with pytest.raises(SettingsError, match=r"scene\.options: radios: unknown key; .*radius"):
        load_scene("sphere", {"radios": 1.0})
    with pytest.raises(SettingsError, match="radius"):
        load_scene("sphere", {"radius": -1.0})
    with pytest.raises(SettingsError, match="did you mean sphere"):
        load_scene("spher")


@pytest.mark.parametrize(
    ("factory", "match"),
    [
        (lambda: 5, "returned int, expected a Scene"),
        (lambda: 1 / 0, "failed: ZeroDivisionError: division by zero"),
    ],
)
def test_a_faulty_factory_is_named_with_its_distribution(monkeypatch, factory, match):
    monkeypatch.setattr(plugins, "load", lambda group, name: factory)
    with pytest.raises(InputError, match=rf"^scene 'sphere' of sononerf 0\.\S+ {match}$"):
        load_scene("sphere")
