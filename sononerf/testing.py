# SPDX-License-Identifier: MIT
"""Contract tests of scenes, fields and renderers, for the authors of plugins.

Each function raises ``AssertionError`` with the found and the expected value.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sononerf.field.field import Field
from sononerf.field.module import FieldFactory, RendererFactory, make
from sononerf.field.renderer import Renderer
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings import loading

REGION = torch.tensor([[-0.02, -0.02, -0.02], [0.02, 0.02, 0.03]])
"""Box of the tests, m."""
HEAD = Head(spectrogram={"frequency_min": 30e3, "frequency_max": 60e3, "range_min": 0.2,
                      "range_max": 0.3})  # fmt: skip
"""Head of the tests: its ranges cover the box from poses at a quarter of a metre."""
POINTS = 50


def check_scene(scene: str | Callable[..., Scene], **options: Any) -> Scene:
    """Check a scene: a surface of a sensible size, and the same one each time.

    Args:
        scene: Its name, where its package is installed, or its function.
        options: Its arguments.

    Returns:
        scene: The object under test.
    """

    def made() -> Scene:
        if isinstance(scene, str):
            return load_scene(scene, options)
        return scene(**loading.check_options(scene, options, where="scene.options"))

    first, second = made(), made()
    _holds(isinstance(first, Scene), f"makes a {type(first).__name__}, expected a sononerf Scene")
    same = np.array_equal(first.mesh.vertices, second.mesh.vertices)
    same &= np.array_equal(first.mesh.faces, second.mesh.faces)
    _holds(same, "two calls with the same options make different meshes; draw from a fixed seed")
    return first


def check_field(field: str | FieldFactory, **options: Any) -> Field:
    """Check a field: shapes, zero outside the region, gradients, frequencies, weights.

    Args:
        field: Its name, where its package is installed, or its factory.
        options: Its keyword arguments.

    Returns:
        field: The object under test.
    """
    torch.manual_seed(0)
    made = make(field, Field, REGION, HEAD, options)
    torch.manual_seed(0)
    again = make(field, Field, REGION, HEAD, options)
    for (name, one), two in zip(
        made.state_dict().items(), again.state_dict().values(), strict=True
    ):
        _holds(torch.equal(one, two), f"{name} differs between two fields of the same torch seed")
    _holds(0 < made.resolution < 0.1, f"resolution is {made.resolution} m, expected 0 to 0.1 m")
    places, directions = _places(POINTS)
    count = len(made.frequency)
    values = made(places, directions)
    _shape(values, (POINTS, count), "the reflectivity of (N, 3) places")
    _finite(values, "the reflectivity")
    several = directions.expand(4, POINTS, 3)
    _shape(made(places.expand(4, POINTS, 3), several), (4, POINTS, count), "of (4, N, 3) places")
    _shape(made.select(places, several, torch.tensor([0, 2])), (4, POINTS, 2), "select")
    some = made.select(places, directions, torch.tensor([0, 2]))
    _close(some, values[:, [0, 2]], "select differs from the reflectivity at these frequencies")
    alone = torch.cat([made(places[n : n + 1], directions[n : n + 1]) for n in range(5)])
    _close(alone, values[:5], "a place has another value when it is evaluated alone")
    outside = places + 1.0
    _holds(not bool(made(outside, directions).abs().any()), "it is not zero outside the region")
    _has_gradients(values, made)
    energy = made.energy(places, 20)
    _shape(energy, (POINTS,), "energy")
    _holds(bool((energy >= 0).all()), "an energy is negative")
    _shape(made.loudness(places, 20), (POINTS,), "loudness")
    audible = made.audible(places, places[:3] + 0.3)
    _shape(audible, (3, POINTS), "audible")
    response, lead = made.echo(places, directions, torch.tensor([1]))
    _shape(response, (POINTS, 1), "the response of echo")
    _shape(lead, (POINTS,), "the lead of echo")
    _same_after_loading(made, again, lambda part: part(places, directions))
    return made


def check_renderer(
    renderer: str | RendererFactory, *, field: str | FieldFactory = "grid", **options: Any
) -> Renderer:
    """Check a renderer: shapes, silence of a silent field, gradients, slices, frequencies.

    Args:
        renderer: Its name, where its package is installed, or its factory.
        field: Field that it renders; needed where it works with some fields alone.
        options: Its keyword arguments.

    Returns:
        renderer: The object under test.
    """
    made = make(renderer, Renderer, REGION, HEAD, options)
    torch.manual_seed(1)
    heard = make(field, Field, REGION, HEAD, {})
    with torch.no_grad():
        for parameter in heard.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    poses = Poses.sphere(2, radius=0.25)
    position, rotation = (
        torch.as_tensor(part, dtype=torch.float32) for part in (poses.positions, poses.rotations)
    )
    slices, count = len(made.range), len(made.frequency)
    rows = torch.arange(slices).expand(2, -1)
    made.prepare(heard, None, 0)
    values = made(heard, position, rotation, rows)
    _shape(values, (2, len(HEAD.receivers), slices, count), "magnitude (P, E, R, F)")
    _finite(values, "the magnitude")
    _holds(bool((values >= 0).all()), "a magnitude is negative")
    _holds(bool((values > 0).any()), "a field that reflects is silent")
    bins = torch.tensor([0, 2])
    some = made(heard, position, rotation, rows, bins)
    _close(some, values[..., bins], "it differs at these frequencies when they are evaluated alone")
    if not made.whole_poses:
        few = made(heard, position, rotation, rows[:, 3:6])
        _close(few, values[:, :, 3:6], "it differs at these slices when they are evaluated alone")
    _has_gradients(values, heard)
    before = made(heard, position, rotation, rows).square().sum()
    made.calibrate(values.detach(), 2 * values.detach())
    after = made(heard, position, rotation, rows).square().sum()
    _close(after / before, torch.tensor(4.0), "calibrate does not scale it to what was measured")
    again = make(renderer, Renderer, REGION, HEAD, options)
    _same_after_loading(made, again, lambda part: part(heard, position, rotation, rows))
    return made


def _places(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(count, 3, generator=generator)
    directions = torch.randn(count, 3, generator=generator)
    places = REGION[0] + share * (REGION[1] - REGION[0])
    return places, directions / directions.norm(dim=-1, keepdim=True)


def _holds(good: bool, fault: str) -> None:
    if not good:
        raise AssertionError(fault)


def _shape(values: Tensor, expected: tuple[int, ...], what: str) -> None:
    shape = tuple(values.shape)
    _holds(shape == expected, f"{what}: shape {shape}, expected {expected}")


def _finite(values: Tensor, what: str) -> None:
    _holds(bool(values.isfinite().all()), f"{what} holds NaN or infinite values")


def _close(values: Tensor, expected: Tensor, fault: str) -> None:
    values, expected = values.detach(), expected.detach()
    scale = float(expected.abs().max())
    _holds(torch.allclose(values, expected, rtol=1e-3, atol=1e-4 * scale + 1e-12), fault)


def _has_gradients(values: Tensor, module: torch.nn.Module) -> None:
    parameters = [p for p in module.parameters() if p.requires_grad]
    _holds(bool(parameters), "it has no parameters to learn")
    gradients = torch.autograd.grad(values.abs().sum(), parameters, allow_unused=True)
    known = [gradient for gradient in gradients if gradient is not None]
    _holds(any(bool(gradient.any()) for gradient in known), "no gradient reaches its parameters")
    for gradient in known:
        _finite(gradient, "a gradient")


def _same_after_loading(
    first: torch.nn.Module, second: torch.nn.Module, answer: Callable[[Any], Tensor]
) -> None:
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    _close(answer(second), answer(first), "it answers otherwise after its weights were loaded")
