# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import InputError, SettingsError
from sononerf.scene.scene import MATERIALS, load_scene
from sononerf.settings.loading import load_settings

BOX = {"scene": "box", "options": {"size": [0.02, 0.04, 0.06]}}


def composed(*parts):
    return load_scene("composed", {"parts": list(parts)})


def test_parts_are_placed_and_not_centred_again():
    far = {"position": [0.1, 0.2, 0.3], "yaw": 90.0, "scale": 0.5, "background": True}
    scene = composed({**BOX, "material": "leaf"}, {**BOX, **far})
    both = scene.mesh.vertices[:8], scene.mesh.vertices[8:]
    np.testing.assert_allclose(np.ptp(both[0], axis=0), [0.02, 0.04, 0.06])
    np.testing.assert_allclose(both[0].mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.ptp(both[1], axis=0), [0.02, 0.01, 0.03])
    np.testing.assert_allclose(both[1].mean(axis=0), [0.1, 0.2, 0.3])
    assert scene.materials == (MATERIALS["leaf"], MATERIALS["rigid"])
    np.testing.assert_array_equal(scene.background, np.arange(24) >= 12)


def test_a_matrix_turns_as_angles_do():
    turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    by_matrix, by_angle = composed({**BOX, "rotation": turn}), composed({**BOX, "yaw": 90.0})
    np.testing.assert_allclose(by_matrix.mesh.vertices, by_angle.mesh.vertices, atol=1e-12)


def test_composed_scenes_may_be_parts():
    inner = {"scene": "composed", "options": {"parts": [{**BOX, "position": [0.1, 0.0, 0.0]}]}}
    scene = composed({**inner, "scale": 2.0, "position": [0.0, 0.0, 1.0]})
    np.testing.assert_allclose(scene.mesh.bounds.mean(axis=0), [0.2, 0.0, 1.0])


def test_settings_of_a_file_are_enough(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(
        "scene: {name: composed, options: {parts: [{scene: sphere, options: {radius: 0.02}}, "
        "{scene: plate, position: [-0.1, 0, 0], background: true}]}}\n"
    )
    settings = load_settings(file)
    scene = load_scene(settings.scene.name, settings.scene.options)
    np.testing.assert_allclose(scene.mesh.bounds[:, 0], [-0.1005, 0.02])
    assert scene.background.sum() == 12


def nested(**part):
    return {"scene": "composed", "options": {"parts": [BOX, {**BOX, **part}]}}


@pytest.mark.parametrize(
    ("part", "kind", "said"),
    [
        ({"scene": "bax"}, SettingsError, "scene.options.parts.1.scene: unknown scene 'bax'"),
        ({"options": {"sise": 1}}, SettingsError, "scene.options.parts.1.options.sise: unknown"),
        (
            {"scene": "mesh", "options": {"path": "a.stl"}},
            InputError,
            "scene.options.parts.1.scene: a.stl: cannot be read",
        ),
        (
            {"scene": "letters", "options": {"text": "?"}},
            SettingsError,
            "scene.options.parts.1.options.text: no letter",
        ),
        (
            nested(options={"size": 1}),
            SettingsError,
            "scene.options.parts.1.options.parts.1.options.size",
        ),
        (
            {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]},
            SettingsError,
            "scene.options.parts.1.rotation: found a matrix that is not orthonormal",
        ),
        (
            {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]},
            SettingsError,
            "scene.options.parts.1.rotation: found a reflection",
        ),
        ({"scale": 0}, SettingsError, "scene.options.parts.1.scale: found 0"),
        ({"scal": 1}, SettingsError, "scene.options.parts.1.scal: unknown key; did you mean scale"),
        ({"position": [0, 0]}, SettingsError, "scene.options.parts.1.position"),
        ({"material": "wood"}, SettingsError, "scene.options.parts.1.material: found 'wood'"),
        (
            {"rotation": np.eye(3).tolist(), "yaw": 0},
            SettingsError,
            "scene.options.parts.1: rotation and yaw, pitch, roll are both set",
        ),
    ],
)
def test_a_fault_is_told_with_its_place(part, kind, said):
    with pytest.raises(kind) as error:
        composed(BOX, {**BOX, **part})
    assert str(error.value).startswith(said)
    assert "\n" not in str(error.value)


def test_no_parts_and_background_alone_are_refused():
    with pytest.raises(SettingsError, match=r"scene\.options\.parts"):
        composed()
    with pytest.raises(SettingsError, match=r"scene\.options\.parts: all are background"):
        composed({**BOX, "background": True})


def test_parts_that_cut_through_one_another_are_named_by_scene(caplog):
    composed(BOX, {"scene": "sphere", "position": [0.015, 0.0, 0.0]})
    assert "0 (box) and 1 (sphere)" in caplog.messages[0]
