# SPDX-License-Identifier: MIT
"""Entry points: one door for all, and a broken plugin hurts only who asks for it."""

from __future__ import annotations

import sys
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

from sononerf.errors import InputError, ResourceError, SettingsError
from sononerf.settings import loading

PLUGIN_FILES = ("pyproject.toml", "fixture_bar.py")


def distribution(folder, name, entries, modules=None, group=loading.SCENES):
    """Lay a distribution's metadata into a folder, as an installer would."""
    info = folder / f"{name.replace('-', '_')}-2.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 2.0\n")
    lines = [f"{entry} = {value}" for entry, value in entries.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]) + "\n")
    for module, text in (modules or {}).items():
        (folder / f"{module}.py").write_text(text)


@pytest.fixture
def install(tmp_path, monkeypatch):
    before = set(sys.modules)

    def installer(name, entries, modules=None):
        distribution(tmp_path / name, name, entries, modules)
        monkeypatch.syspath_prepend(tmp_path / name)

    yield installer
    for module in set(sys.modules) - before:
        if module.startswith("plugin_"):
            del sys.modules[module]


def names(group=loading.SCENES):
    return [plugin.name for plugin in loading.registered(group)]


def test_ours_come_through_the_same_door():
    assert {"sphere", "three_spheres", "ua", "mesh"} <= set(names())
    assert {"grid", "fourier"} <= set(names(loading.FIELDS))
    assert {"profile", "shell"} <= set(names(loading.RENDERERS))
    assert names() == sorted(names())


def test_an_installed_distribution_is_found_and_makes_its_scene(plugin):
    (found,) = [p for p in loading.registered(loading.SCENES) if p.name == "fixture_bar"]
    assert (found.distribution, found.version) == ("sononerf-fixture", "1.0")
    assert "fixture_bar" not in sys.modules  # looking up imports nothing
    factory = loading.load(loading.SCENES, "fixture_bar")
    options = loading.check_options(factory, {"length": 0.05}, where="scene.options")
    assert options == {"length": 0.05, "radius": 0.01}
    scene = factory(**options)
    assert scene.mesh.is_watertight
    assert scene.mesh.extents == pytest.approx([0.02, 0.02, 0.07], rel=0.02)


def test_without_its_folder_the_scene_is_gone():
    assert "fixture_bar" not in names()


def test_a_complete_scene_is_at_most_twenty_lines(request):
    folder = request.path.parents[1] / "plugin"
    files = sorted(path.name for path in folder.iterdir() if path.is_file())
    assert files == sorted(PLUGIN_FILES)
    assert sum(len((folder / name).read_text().splitlines()) for name in files) <= 20


def test_an_unknown_name_lists_what_there_is():
    with pytest.raises(
        SettingsError, match="unknown scene 'sphrere'; did you mean sphere"
    ) as caught:
        loading.load(loading.SCENES, "sphrere")
    assert "three_spheres" in str(caught.value)
    with pytest.raises(SettingsError, match="unknown field 'zzz'; there are:"):
        loading.load(loading.FIELDS, "zzz")


@pytest.mark.parametrize(
    "text", ["raise RuntimeError('boom')", "import no_such_module", "def (", "raise SystemExit(0)"]
)
def test_a_broken_plugin_hurts_only_who_asks_for_it(install, text):
    install("broken", {"broken": "plugin_broken:make"}, {"plugin_broken": text})
    assert "broken" in names()
    assert callable(loading.load(loading.SCENES, "sphere"))
    with pytest.raises(
        InputError, match=r"scene 'broken' of broken 2\.0 cannot be loaded"
    ) as caught:
        loading.load(loading.SCENES, "broken")
    assert "\n" not in str(caught.value)


def test_a_plugin_without_its_factory(install):
    install("hollow", {"hollow": "plugin_hollow:make"}, {"plugin_hollow": ""})
    with pytest.raises(InputError, match="cannot be loaded: AttributeError"):
        loading.load(loading.SCENES, "hollow")


def test_a_plugin_that_is_no_factory(install):
    install("number", {"number": "plugin_number:x"}, {"plugin_number": "x = 3"})
    with pytest.raises(InputError, match="is int, expected a function or class"):
        loading.load(loading.SCENES, "number")


def test_two_claims_of_one_name_matter_only_when_it_is_asked_for(install):
    for owner in ("first", "second"):
        install(owner, {"twin": f"plugin_{owner}:make"}, {f"plugin_{owner}": "def make(): ..."})
    assert callable(loading.load(loading.SCENES, "sphere"))
    with pytest.raises(SettingsError, match=r"claimed by first 2\.0 and second 2\.0"):
        loading.load(loading.SCENES, "twin")


def test_the_same_distribution_seen_twice_is_one_claim(install, tmp_path, monkeypatch):
    install("once", {"once": "plugin_once:make"}, {"plugin_once": "def make(): ..."})
    distribution(tmp_path / "again", "once", {"once": "plugin_once:make"})
    monkeypatch.syspath_prepend(tmp_path / "again")
    assert callable(loading.load(loading.SCENES, "once"))


def factory(
    poses: list[str], size: float = 1.0, *, kind: Literal["a", "b"] = "a", **more: int
) -> None:
    """A factory of all sorts."""


class Factory:
    """A factory that is a class."""

    def __init__(self, count: int = 3) -> None:
        self.count = count


def check(options, target=factory, **more):
    return loading.check_options(target, options, where="field.options", **more)


def test_options_are_filled_in_and_converted():
    assert check({"poses": []}) == {"poses": [], "size": 1.0, "kind": "a"}
    assert check({"size": 2}, given=1) == {"size": 2.0, "kind": "a"}
    assert check({}, Factory) == {"count": 3}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": [], "sise": 1}, "field.options.sise: unknown key; did you mean size?"),
        ({}, "field.options.poses: missing"),
        ({"poses": [], "size": "big"}, "field.options.size: found 'big'"),
        ({"poses": [], "size": float("nan")}, "field.options.size: found nan"),
        ({"poses": [], "kind": "c"}, "field.options.kind: found 'c'"),
        ({"poses": [], "size": True}, "field.options.size: give a number, not yes or no"),
    ],
)
def test_wrong_options_are_told(options, message):
    with pytest.raises(SettingsError, match=message.replace("?", r"\?")):
        check(options)


def test_yes_and_no_are_no_numbers_wherever_they_stand():
    def truthful(pair: tuple[float, float] = (0, 1), flat: bool = False, name: Any = None):
        """A factory that takes numbers and truths."""

    assert check({"flat": True, "name": True}, truthful)["flat"] is True
    said = r"^field\.options\.pair\.1: give a number, not yes or no$"
    with pytest.raises(SettingsError, match=said):
        check({"pair": [0.0, False]}, truthful)


def test_a_list_that_is_too_short_is_told_in_one_line():
    def needy(size: tuple[float, float, float] = (1, 1, 1)):
        """A factory that takes three numbers."""

    with pytest.raises(SettingsError) as caught:
        check({"size": [4]}, needy)
    assert str(caught.value) == "field.options.size: found [4]; give 3 values"


def test_options_are_told_with_default_and_bounds():
    def many(
        size: Annotated[float, Field(gt=0, le=2)],
        place: tuple[float, float, float] = (0, 1, 2),
        *,
        kind: Literal["a", "b"] = "a",
        count: Annotated[int, Field(ge=1)] | None = None,
        names: list[str] | None = None,
        own: Factory | None = None,
    ):
        """A factory of all sorts."""

    assert [tuple(row.values()) for row in loading.describe_options(many)] == [
        ("size", None, True, "a number above 0 to 2"),
        ("place", [0, 1, 2], False, "3 of: a number"),
        ("kind", "a", False, "a, b"),
        ("count", None, False, "a whole number from 1 or none"),
        ("names", None, False, "a list of: text or none"),
        ("own", None, False, "see the source"),  # what has no schema keeps no other from it
    ]


def test_where_there_are_no_options_none_are_listed():
    with pytest.raises(SettingsError, match=r"size: unknown key; there is none to set here$"):
        check({"size": 1}, lambda: None)


def test_a_choice_of_types_is_told_under_its_own_key():
    def choosy(level: float | Literal["auto"] = "auto"):
        """A factory that takes one of two types."""

    with pytest.raises(SettingsError) as caught:
        check({"level": "high"}, choosy)
    for line in str(caught.value).splitlines():
        assert line.startswith("field.options.level: found 'high'")


def test_annotations_that_cannot_be_read():
    def strange(x: NoSuchType):  # noqa: F821
        """A factory whose annotation names nothing."""

    with pytest.raises(InputError, match="annotations cannot be read"):
        check({}, strange)


@pytest.mark.parametrize(
    ("raised", "error", "message"),
    [
        (ValueError("no\nluck"), InputError, "field 'mine' failed: ValueError: no luck"),
        (SystemExit(3), InputError, "field 'mine' failed: SystemExit: 3"),
        (MemoryError(), ResourceError, "more memory than there is"),
        (SettingsError("levels: too many"), SettingsError, "^levels: too many$"),
    ],
)
def test_a_factory_that_raises_is_one_line(raised, error, message):
    def factory(region, *, levels):
        raise raised

    with pytest.raises(error, match=message):
        loading.call("field 'mine'", factory, None, levels=3)
