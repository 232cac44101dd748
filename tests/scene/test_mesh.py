# SPDX-License-Identifier: MIT

import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_gltf

from sononerf.errors import InputError, SettingsError
from sononerf.scene.material import MATERIALS
from sononerf.scene.scene import load_scene

BOX = trimesh.creation.box((30.0, 20.0, 10.0))


HEAD = trimesh.creation.icosphere(subdivisions=1, radius=5.0)
BESIDE = trimesh.transformations.translation_matrix([40.0, 0.0, 0.0])


def load(path, **options):
    return load_scene("mesh", {"path": str(path), **options}).mesh


Y_UP = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])


def whole_gltf(shape):
    """Return a glTF that carries its numbers itself."""
    return export_gltf(trimesh.Scene(shape), embed_buffers=True)["model.gltf"]


@pytest.fixture
def insect():
    """A body and a head; the head stands where the scene graph moves it."""
    scene = trimesh.Scene()
    scene.add_geometry(BOX, geom_name="body", node_name="below")
    scene.add_geometry(HEAD, geom_name="head", node_name="above", transform=BESIDE)
    return scene


@pytest.mark.parametrize(
    "name", ["a.stl", "a.ply", "a.obj", "a.off", "a.glb", "a.gltf", "UPPER.STL", "text.stl"]
)
def test_formats_and_units(tmp_path, name):
    path = tmp_path / name
    kind = "stl_ascii" if name == "text.stl" else path.suffix[1:].lower()
    moved = BOX.copy()
    moved.apply_translation([5.0, 6.0, 7.0])
    if kind == "gltf":
        path.write_bytes(whole_gltf(moved.apply_transform(Y_UP)))
    elif kind == "glb":
        moved.apply_transform(Y_UP).export(path)
    else:
        moved.export(path, file_type=kind)
    mesh = load(path, unit="mm")
    np.testing.assert_allclose(
        mesh.bounds, [[-0.015, -0.01, -0.005], [0.015, 0.01, 0.005]], atol=1e-8
    )
    assert mesh.is_watertight
    np.testing.assert_allclose(
        load(path, unit="cm", centre=False).bounds.mean(axis=0), [0.05, 0.06, 0.07], atol=1e-7
    )


def test_a_mesh_is_moved_with_a_word_and_the_way_back_is_kept(tmp_path, caplog):
    moved = BOX.copy()
    moved.apply_translation([5.0, 6.0, 7.0])
    moved.export(tmp_path / "a.stl")
    scene = load_scene("mesh", {"path": str(tmp_path / "a.stl"), "unit": "mm", "scale": 2.0})
    (told,) = caplog.messages
    assert "moved by (-10, -12, -14) mm" in told
    assert "centre=false" in told
    back = scene.mesh.copy().apply_transform(scene.to_original)
    np.testing.assert_allclose(back.bounds, moved.bounds, atol=1e-5)
    caplog.clear()
    kept = load_scene("mesh", {"path": str(tmp_path / "a.stl"), "unit": "mm", "centre": False})
    assert caplog.messages == []
    np.testing.assert_allclose(kept.to_original, np.diag([1e3, 1e3, 1e3, 1.0]))
    np.testing.assert_allclose(kept.mesh.bounds.mean(axis=0), [0.005, 0.006, 0.007], atol=1e-7)


def test_glb_and_gltf_are_in_metres(tmp_path):
    BOX.export(tmp_path / "a.glb")
    (tmp_path / "a.gltf").write_bytes(whole_gltf(BOX))
    for name in ("a.glb", "a.gltf"):
        np.testing.assert_allclose(load(tmp_path / name).extents, [30, 10, 20])


def test_the_scale_multiplies_the_units(tmp_path):
    BOX.export(tmp_path / "a.stl")
    mesh = load(tmp_path / "a.stl", unit="mm", scale=2.5)
    np.testing.assert_allclose(mesh.extents, [0.075, 0.05, 0.025])
    for wrong in (0.0, -1.0, float("inf")):
        with pytest.raises(SettingsError, match=r"scene\.options\.scale: found"):
            load(tmp_path / "a.stl", unit="mm", scale=wrong)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.obj"])
def test_parts_stand_in_their_places_with_their_materials(tmp_path, insect, name):
    path = tmp_path / name
    if name != "a.obj":
        insect.apply_transform(Y_UP)
    if name == "a.gltf":
        path.write_bytes(whole_gltf(insect))
    else:
        insect.export(path)
    options = {"path": str(path), "unit": "mm", "material": "rigid"}
    scene = load_scene("mesh", {**options, "materials": {"head": "insect"}})
    assert scene.mesh.extents == pytest.approx([0.06, 0.02, 0.01])
    assert scene.mesh.is_watertight
    middles = scene.mesh.triangles_center
    of_head = np.array([material == MATERIALS["insect"] for material in scene.materials])
    np.testing.assert_array_equal(of_head[scene.part], middles[:, 0] > 0.01)
    assert set(scene.materials) == {MATERIALS["insect"], MATERIALS["rigid"]}
    assert load_scene("mesh", options).material == MATERIALS["rigid"]


def test_a_part_that_stands_twice_and_mirrored_is_one(tmp_path, insect):
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    insect.graph.update("other", matrix=mirror @ BESIDE, geometry="head")
    insect.apply_transform(Y_UP).export(tmp_path / "a.glb")
    options = {"path": str(tmp_path / "a.glb"), "unit": "mm"}
    scene = load_scene("mesh", {**options, "materials": {"head": "leaf"}})
    assert scene.mesh.extents == pytest.approx([0.09, 0.02, 0.01])
    assert scene.mesh.volume == pytest.approx(1e-9 * (BOX.volume + 2 * HEAD.volume))
    assert np.count_nonzero(np.equal(scene.part, 1)) == 2 * len(HEAD.faces)


def test_a_part_that_is_not_there_is_refused_with_those_that_are(tmp_path, insect):
    insect.export(tmp_path / "a.glb")
    for given, words in [
        ({"heed": "leaf"}, "no part 'heed'; did you mean head.* there are: body, head"),
        ({"head": "wood"}, r"scene\.options\.materials\.head: found 'wood'; .*'leaf'"),
    ]:
        with pytest.raises(SettingsError, match=words):
            load(tmp_path / "a.glb", materials=given)


@pytest.mark.parametrize("name", ["a.stl", "a.ply", "a.obj", "a.off"])
def test_other_formats_must_be_told_the_unit(tmp_path, name):
    BOX.export(tmp_path / name)
    with pytest.raises(InputError, match=r"set scene\.options\.unit to m, cm or mm"):
        load(tmp_path / name)
    with pytest.raises(SettingsError, match="unit"):
        load(tmp_path / name, unit="inch")


def test_relative_paths_start_at_the_working_directory(tmp_path, monkeypatch):
    BOX.export(tmp_path / "a.stl")
    monkeypatch.chdir(tmp_path)
    assert len(load("a.stl", unit="mm").faces) == 12


def test_a_sphere_in_millimetres_taken_for_metres_is_refused(tmp_path):
    trimesh.creation.icosphere(radius=120.0).export(tmp_path / "a.stl")
    with pytest.raises(InputError, match=r"a\.stl: the mesh is 240 m large.*set the unit to mm"):
        load(tmp_path / "a.stl", unit="m")
    with pytest.raises(InputError, match=r"a\.stl: the mesh is 0\.00024 m .*set the unit to m$"):
        load(tmp_path / "a.stl", unit="mm", scale=1e-3)


def test_seams_between_patches_are_closed(tmp_path, caplog):
    seam = trimesh.Trimesh(
        BOX.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    for name in ("a.obj", "a.ply"):
        seam.export(tmp_path / name)
        assert load(tmp_path / name, unit="mm").is_watertight
    assert not caplog.records


def test_faults_of_a_file_are_told_of(tmp_path, caplog):
    trimesh.Trimesh(BOX.vertices, BOX.faces[:-1, ::-1]).export(tmp_path / "a.stl")
    load(tmp_path / "a.stl", unit="mm")
    assert [message.split(" (")[0] for message in caplog.messages] == ["the mesh is open"]


def test_the_material_is_that_of_its_name(tmp_path):
    BOX.export(tmp_path / "a.stl")
    options = {"path": str(tmp_path / "a.stl"), "unit": "mm"}
    assert load_scene("mesh", options).material == MATERIALS["rigid"]
    assert load_scene("mesh", {**options, "material": "leaf"}).material == MATERIALS["leaf"]
