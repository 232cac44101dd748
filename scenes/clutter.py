# SPDX-License-Identifier: MIT
"""A target among things that are not: stones on the ground below it, a twig with leaves behind."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field

from sononerf.scene import Part, Scene, compose

from .bodies import ball, rounded
from .composed import OWN, load_within
from .leaf import Seed, leaf
from .loft import loft

GROUND, GROUND_RADIUS, GROUND_THICKNESS = -0.16, 0.2, 0.01
"""Height of the ground's surface, radius and thickness of its disc, m. It lies lower if the target
reaches lower."""
BEHIND = -0.09
"""Largest x of the twig and its leaves, m; they stay behind the target if that reaches farther
back."""
APART = 0.01
"""Least distance between the target and other bodies, m."""
MOST_STONES, MOST_LEAVES = 50, 10
STONE = (0.005, 0.013)
"""Half axes of stones along the ground, m."""
STONE_HEIGHT = (0.5, 0.8)
"""Half of a stone's height over the smaller of these half axes."""
TRIES = 2000
TWIG_RADIUS, TWIG_REACH = 2.5e-3, 0.16
"""Radius of the twig, and its reach from -y to +y, m."""


def clutter(
    target: Annotated[str, Field(min_length=1)] = "leaf_dragonfly",
    target_options: dict[str, Any] | None = None,
    density: Annotated[float, Field(ge=0, le=1)] = 0.5,
    seed: Seed = 0,
) -> Scene:
    """Build a scene by its name over stony ground, before a twig with leaves; both are background.

    Density, 0 to 1, is how many stones and leaves there are; the seed draws them.
    """
    body = load_within(target, target_options or {}, f"{OWN}.target", f"{OWN}.target_options")
    low = np.asarray(body.mesh.bounds)[0]
    stones, twig = np.random.default_rng([seed, 2]).spawn(2)
    ground = _ground(round(density * MOST_STONES), stones)
    highest = float(ground.bounds[1, 2])
    level = min(GROUND, float(low[2]) - APART - highest)
    branch = _twig(round(density * MOST_LEAVES), twig)
    back = min(BEHIND, float(low[0]) - APART) - float(branch.mesh.bounds[1, 0])
    return compose(
        [
            Part(body, name=target),
            Part(Scene(ground), (0.0, 0.0, level), background=True, name="ground"),
            Part(branch, (back, 0.0, 0.0), background=True, name="twig"),
        ],
        may_cross=True,  # a leaf of the twig may lie on a stone; the target is kept clear of both
    )


def _ground(count: int, random: np.random.Generator) -> trimesh.Trimesh:
    """Build a disc whose upper side is z = 0, and stones half sunk in it that do not touch."""
    # Flat faces need no fine triangles, but a disc's rim is to be round.
    disc = trimesh.creation.cylinder(GROUND_RADIUS, GROUND_THICKNESS, sections=180)
    disc.apply_translation((0.0, 0.0, -0.5 * GROUND_THICKNESS))
    bodies: list[trimesh.Trimesh] = [disc]
    places: list[tuple[NDArray[np.float64], float]] = []
    for _ in range(TRIES):
        if len(places) == count:
            break
        axes = random.uniform(*STONE, 2)
        reach = float(axes.max())
        distance = (GROUND_RADIUS - reach) * np.sqrt(random.uniform())
        turn, roll = random.uniform(0.0, 2.0 * np.pi, 2)
        place = distance * np.array((np.cos(turn), np.sin(turn)))
        height = axes.min() * random.uniform(*STONE_HEIGHT)
        if all(np.linalg.norm(place - other) > reach + wide for other, wide in places):
            places.append((place, reach))
            bodies.append(_stone(place, np.array((*axes, height)), float(roll)))
    return rounded(*_arrays(trimesh.util.concatenate(bodies)))


def _stone(place: NDArray[np.float64], axes: NDArray[np.float64], turn: float) -> trimesh.Trimesh:
    """Build an ellipsoid of half axes (3,) m, turned about z, the lower third in the ground."""
    largest = float(axes.max())
    body = ball(np.zeros(3), largest)
    vertices = np.asarray(body.vertices) / largest * axes
    cos, sin = np.cos(turn), np.sin(turn)
    vertices = vertices @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    middle = np.array((*place, axes[2] / 3.0))
    return trimesh.Trimesh(vertices + middle, body.faces, process=False)


def _twig(count: int, random: np.random.Generator) -> Scene:
    """Build a twig along y, and leaves that grow from it."""
    # Rounded at both ends.
    turn = np.linspace(0.0, 0.5 * np.pi, 8)
    cap = TWIG_REACH - TWIG_RADIUS * (1.0 - np.cos(turn))
    y = np.concatenate([-cap[:-1], np.linspace(-cap[-1], cap[-1], 320), cap[-2::-1]])
    ends = np.concatenate([np.sin(turn[:-1]), np.ones(320), np.sin(turn[-2::-1])])
    wave, phase = random.uniform(15.0, 30.0, 2), random.uniform(0.0, 2.0 * np.pi, 2)
    wobble = 0.006 * np.sin(wave * y[:, None] + phase)
    path = np.stack([wobble[:, 0], y, 0.02 + 0.45 * y + wobble[:, 1]], axis=1)
    wood = loft(path, TWIG_RADIUS * (1.2 - y / TWIG_REACH * 0.5) * ends)
    parts = [Part(Scene(rounded(*_arrays(wood))))]
    places = np.linspace(-0.85, 0.95, count) * TWIG_REACH
    for number, place in enumerate(places):
        foot = np.array([np.interp(place, y, path[:, axis]) for axis in range(3)])
        parts.append(_grown(foot, 1.0 if number % 2 else -1.0, random))
    return compose(parts, may_cross=True)  # leaves grow from the twig


def _grown(foot: NDArray[np.float64], side: float, random: np.random.Generator) -> Part:
    """Return a leaf whose stalk ends in a point (3,) m, up (1) or down (-1) in the y-z plane."""
    length = random.uniform(0.05, 0.08)
    yaw, pitch = random.uniform(-30.0, 30.0), random.uniform(-20.0, 20.0)
    lean = random.uniform(-40.0, 20.0)
    # Roll 180 hangs the leaf with its tip down.
    grown = leaf(
        seed=int(random.integers(2**32)),
        length=length,
        width=length * random.uniform(0.4, 0.55),
        curl=random.uniform(20.0, 90.0),
        bend=random.uniform(0.0, 60.0),
        yaw=yaw,
        pitch=pitch,
        roll=lean if side > 0.0 else 180.0 - lean,
    )
    # The stalk's end is where the leaf's length is least: its first vertices are the rim's.
    end = np.asarray(grown.mesh.vertices)[0]
    return Part(grown, foot - end)


def _arrays(mesh: trimesh.Trimesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
