# SPDX-License-Identifier: MIT
"""The contract tests accept what is built in, and name what is wrong with others."""

from __future__ import annotations

import pytest
import torch
import trimesh

from sononerf import testing
from sononerf.field.fields import GridField
from sononerf.field.profile import ProfileRenderer
from sononerf.scene.scene import Scene


@pytest.mark.parametrize(
    ("name", "options"),
    [("grid", {"finest": 0.01, "levels": 2}), ("fourier", {"width": 16, "octaves": 6})],
)
def test_built_in_fields_hold(name, options):
    testing.check_field(name, **options)


@pytest.mark.parametrize(
    ("name", "options"), [("profile", {"start": 5000}), ("shell", {"directions": 300})]
)
def test_built_in_renderers_hold(name, options):
    testing.check_renderer(name, **options)


def test_built_in_scenes_hold():
    assert len(testing.check_scene("sphere", radius=0.01).mesh.faces) > 0


class Everywhere(GridField):
    """Reflects outside the region too."""

    def forward(self, positions, directions):
        return torch.ones(*positions.shape[:-1], len(self.frequency)) + 0 * self.weight()

    def weight(self):
        return next(self.parameters()).sum()


class Deaf(GridField):
    """Passes no gradient on."""

    def forward(self, positions, directions):
        return super().forward(positions, directions).detach().requires_grad_()


class Short(GridField):
    """Forgets a frequency."""

    def forward(self, positions, directions):
        return super().forward(positions, directions)[..., 1:]


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Everywhere, "not zero outside the region"),
        (Deaf, "no gradient reaches"),
        (Short, r"shape \(50, .*\), expected \(50, "),
    ],
)
def test_a_wrong_field_is_named(kind, message):
    with pytest.raises(AssertionError, match=message):
        testing.check_field(lambda region, frequency: kind(region, frequency, finest=0.01))


class Loud(ProfileRenderer):
    """Forgets to choose among frequencies."""

    def forward(self, field, position, rotation, rows, bins=None):
        return super().forward(field, position, rotation, rows)[
            ..., : 2 if bins is not None else None
        ]


def test_a_wrong_renderer_is_named():
    with pytest.raises(AssertionError, match="differs at these frequencies"):
        testing.check_renderer(lambda region, head: Loud(region, head, start=2000))


def test_a_scene_that_changes_is_named():
    sizes = iter((0.01, 0.02))
    with pytest.raises(AssertionError, match="two calls with the same options"):
        testing.check_scene(lambda: Scene(trimesh.creation.icosphere(radius=next(sizes))))
