import pytest
from sononerf.errors import SettingsError
from sononerf.scene import load_scene


def test_it_is_as_large_as_it_should_be():
    assert load_scene("my_scene").mesh.extents == pytest.approx([0.02, 0.02, 0.07], rel=0.02)


def test_its_options_change_it():
    larger = load_scene("my_scene", {"length": 0.1, "radius": 0.02}).mesh
    assert larger.extents == pytest.approx([0.04, 0.04, 0.14], rel=0.02)


def test_it_is_closed():
    assert load_scene("my_scene").mesh.is_watertight


@pytest.mark.parametrize("options", [{"radius": 0}, {"radius": "thick"}, {"radios": 0.01}])
def test_a_wrong_option_is_refused(options):
    with pytest.raises(SettingsError, match="scene.options"):
        load_scene("my_scene", options)
