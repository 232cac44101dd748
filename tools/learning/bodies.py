# SPDX-License-Identifier: MIT
"""Procedural bodies of many kinds, each from its seed: what the start network learns from.

Kinds are drawn about one unit large; :func:`body` turns and scales them.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import manifold3d
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from trimesh import creation
from trimesh.transformations import random_rotation_matrix, rotation_matrix

Random = np.random.Generator
Kind = Callable[[Random], trimesh.Trimesh]
SMALLEST, LARGEST = 0.05, 0.3
"""Longest side of a body, m; half of the bodies are below 0.12 m."""
LEAST = 3e-7
"""Volume of the smallest body, m³."""
EDGE = 0.006
"""Longest edge of a body's triangles, m."""
_TRIES = 50  # drawings of one seed, until one is a closed body


def body(seed: int) -> tuple[str, trimesh.Trimesh]:
    """Return the name of the kind and the mesh of a seed's body, m, centred on the origin.

    Raises:
        ValueError: If no drawing of this seed is a closed body.
    """
    random = np.random.default_rng([46, seed])
    kind = KINDS[seed % len(KINDS)]
    for _ in range(_TRIES):
        try:
            mesh = kind(random)
        except (ValueError, ZeroDivisionError, IndexError):
            continue  # a drawing without a body, such as a cut that takes all
        _turned(mesh, random)
        mesh.merge_vertices()
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        mesh.apply_scale(_size(random) / mesh.extents.max())
        if mesh.is_watertight and mesh.volume > LEAST:
            return kind.__name__, mesh.subdivide_to_size(EDGE)
    raise ValueError(f"seed {seed}: {_TRIES} drawings gave no closed body")


def _size(random: Random) -> float:
    return float(np.exp(random.uniform(*np.log([SMALLEST, LARGEST]))))


def _turned(mesh: trimesh.Trimesh, random: Random) -> trimesh.Trimesh:
    return mesh.apply_transform(random_rotation_matrix(random.uniform(size=3)))


def _moved(mesh: trimesh.Trimesh, random: Random, reach: float) -> trimesh.Trimesh:
    return mesh.apply_translation(random.uniform(-reach, reach, 3))


def _union(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return trimesh.boolean.union(parts, engine="manifold") if len(parts) > 1 else parts[0]


def _without(mesh: trimesh.Trimesh, cut: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.boolean.difference([mesh, cut], engine="manifold")


def _simple(random: Random, size: float = 1.0) -> trimesh.Trimesh:
    """Return a box, cylinder, sphere, cone or capsule."""
    which = random.integers(5)
    if which == 0:
        return creation.box(random.uniform(0.3, 1.6, 3) * size)
    if which == 1:
        radius, height = random.uniform(0.15, 0.7), random.uniform(0.3, 2.0)
        return creation.cylinder(radius * size, height * size, sections=64)
    if which == 2:
        return creation.icosphere(4, random.uniform(0.25, 0.7) * size)
    if which == 3:
        radius, height = random.uniform(0.3, 0.8), random.uniform(0.6, 1.8)
        return creation.cone(radius * size, height * size, sections=64)
    height, radius = random.uniform(0.5, 1.6), random.uniform(0.15, 0.35)
    return creation.capsule(height * size, radius * size, count=[24, 24])


def solids(random: Random) -> trimesh.Trimesh:
    """Return the union of simple bodies; of every second one something is cut out."""
    parts = []
    for _ in range(random.integers(1, 5)):
        part = _simple(random)
        parts.append(_moved(_turned(part, random) if random.random() < 0.6 else part, random, 0.6))
    mesh = _union(parts)
    if random.random() < 0.5:
        if random.random() < 0.5:
            cut = creation.cylinder(random.uniform(0.2, 0.5), 4.0, sections=64)
        else:
            cut = creation.box(random.uniform(0.4, 1.0, 3))
        mesh = _without(mesh, _moved(_turned(cut, random), random, 0.6))
    return mesh


def lathe(random: Random) -> trimesh.Trimesh:
    """Return a turned body, full or hollow and open on top."""
    knots, height = random.integers(3, 8), random.uniform(0.8, 2.2)
    radius = random.uniform(0.2, 0.9, knots)
    if random.random() < 0.3:
        radius[:] = np.linspace(radius[0], radius[random.choice([0, -1])], knots)
    at, along = np.linspace(0.0, height, knots), np.linspace(0.0, height, 48)
    which = random.integers(3)
    outer = PchipInterpolator(at, radius)(along) if which == 0 else np.interp(along, at, radius)
    if which == 2 and knots > 3:  # steps
        outer = radius[np.minimum((along / height * knots).astype(int), knots - 1)]
    profile = [[[0.0, 0.0]], np.column_stack((outer, along))]
    if random.random() < 0.6:
        wall, deep = random.uniform(0.06, 0.16), random.random() < 0.8
        floor = random.uniform(0.06, 0.4) if deep else random.uniform(0.3, 0.8) * height
        inside = np.linspace(height, floor, 48)
        inner = np.maximum(np.interp(inside, along, outer) - wall, 0.05)
        profile += [np.column_stack((inner, inside)), [[0.0, floor]]]
    else:
        profile.append([[0.0, height]])
    return creation.revolve(np.concatenate(profile), sections=96)


def _cross(points: ArrayLike) -> manifold3d.CrossSection:
    return manifold3d.CrossSection([np.asarray(points, float)], manifold3d.FillRule.Positive)


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> manifold3d.CrossSection:
    return _cross([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _around(angle: NDArray[np.float64], radius: NDArray[np.float64]) -> manifold3d.CrossSection:
    return _cross(np.column_stack((radius * np.cos(angle), radius * np.sin(angle))))


def _strokes(random: Random) -> manifold3d.CrossSection:
    """Return a line of strokes between points of a grid, as of a letter."""
    points = random.choice([-0.8, 0.0, 0.8], (random.integers(3, 7), 2)) * [0.7, 1.0]
    wide, found = random.uniform(0.08, 0.2), manifold3d.CrossSection()
    for start, end in pairwise(points):
        length = np.linalg.norm(end - start)
        if length > 0.1:
            along = wide * (end - start) / length
            side = np.array([-along[1], along[0]])
            found += _cross(
                [start - along - side, end + along - side, end + along + side, start - along + side]
            )
    return found


def _outline(random: Random) -> manifold3d.CrossSection:
    """Return a star, a box with cuts, a round polygon, strokes, or a disc with a hole or a gap."""
    which = random.integers(5)
    if which == 0:
        count = random.integers(3, 9)
        angle = np.linspace(0.0, 2 * np.pi, 2 * count + 1)[:-1]
        outer, inner = random.uniform(0.7, 1.2), random.uniform(0.25, 0.8)
        return _around(angle, np.where(np.arange(2 * count) % 2 == 0, outer, inner))
    if which == 1:
        half = random.uniform(0.5, 0.9)
        found = _rectangle(-0.9, -half, 0.9, half)
        for _ in range(random.integers(1, 4)):
            corner = random.uniform(-0.9, 0.4, 2)
            found -= _rectangle(*corner, *(corner + random.uniform(0.3, 1.1, 2)))
        return found
    if which == 2:
        angle = np.sort(random.uniform(0.0, 2 * np.pi, random.integers(4, 10)))
        found = _around(angle, random.uniform(0.4, 1.1, len(angle)))
        return found.offset(random.uniform(0.01, 0.2), manifold3d.JoinType.Round, 2.0, 32)
    if which == 3:
        return _strokes(random)
    disc = manifold3d.CrossSection.circle(random.uniform(0.6, 1.1), 96)
    hole = manifold3d.CrossSection.circle(random.uniform(0.2, 0.5), 64)
    hole = hole.translate(tuple(random.uniform(-0.3, 0.3, 2)))
    return disc - (hole if random.random() < 0.7 else _rectangle(0.0, -0.3, 2.0, 0.3))


def extrusion(random: Random) -> trimesh.Trimesh:
    """Return a prism over an outline."""
    outline = _outline(random)
    made = manifold3d.Manifold.extrude(outline, random.uniform(0.12, 1.3)).to_mesh()
    return trimesh.Trimesh(np.array(made.vert_properties)[:, :3], np.array(made.tri_verts))


def slabs(random: Random) -> trimesh.Trimesh:
    """Return a tower of discs and boxes."""
    parts, height = [], 0.0
    for _ in range(random.integers(2, 6)):
        thick, radius = random.uniform(0.1, 0.7), random.uniform(0.25, 1.0)
        if random.random() < 0.4:
            part = creation.cylinder(radius, thick, sections=64)
        else:
            part = creation.box([2 * radius, 2 * radius * random.uniform(0.4, 1.0), thick])
        part.apply_transform(rotation_matrix(random.uniform(0.0, 6.0), [0, 0, 1]))
        part.apply_translation([*random.uniform(-0.15, 0.15, 2), height + thick / 2])
        height += thick - 1e-3  # they overlap a little, so that they are one body
        parts.append(part)
    return _union(parts)


def _tube(path: NDArray[np.float64], radius: ArrayLike, sides: int = 24) -> trimesh.Trimesh:
    """Return a tube along a path (N, 3), with flat ends."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.cross(along[0], [0.13, 0.2, 1.0])
    angle = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)[:, None]
    rings = []
    for place, way, wide in zip(path, along, np.broadcast_to(radius, len(path)), strict=True):
        normal = normal - way * (normal @ way)
        normal /= np.linalg.norm(normal)
        side = np.cross(way, normal)
        rings.append(place + wide * (np.cos(angle) * normal + np.sin(angle) * side))
    here = np.arange(sides * (len(path) - 1)).reshape(-1, sides)
    beside = np.roll(here, -1, axis=1)
    first, last = sides * len(path), sides * len(path) + 1
    end = here[-1] + sides
    faces = [
        np.stack((here, beside, here + sides), axis=-1).reshape(-1, 3),
        np.stack((beside, beside + sides, here + sides), axis=-1).reshape(-1, 3),
        np.column_stack((np.full(sides, first), beside[0], here[0])),
        np.column_stack((np.full(sides, last), end, np.roll(end, -1))),
    ]
    mesh = trimesh.Trimesh(
        np.concatenate((*rings, path[:1], path[-1:])), np.concatenate(faces), process=False
    )
    mesh.fix_normals()
    return mesh


def tubes(random: Random) -> trimesh.Trimesh:
    """Return a helix, rings, a bent tube, or a twig of capsules."""
    which, radius = random.integers(4), float(np.exp(random.uniform(*np.log([0.035, 0.2]))))
    if which == 0:
        turns, wide = random.uniform(1.0, 4.0), random.uniform(0.4, 0.9)
        part = np.linspace(0.0, 1.0, 300)
        angle, rise = 2 * np.pi * turns * part, turns * random.uniform(2.6, 5.0) * radius
        circle = wide * np.column_stack((np.cos(angle), np.sin(angle)))
        return _tube(np.column_stack((circle, (part - 0.5) * rise)), radius)
    if which == 1:
        rings = []
        for _ in range(random.integers(1, 4)):
            wide = random.uniform(0.5, 1.0)
            ring = creation.torus(wide, radius, major_sections=96, minor_sections=24)
            rings.append(_moved(_turned(ring, random), random, 0.4))
        return _union(rings)
    if which == 2:
        knots = np.cumsum(random.normal(0.0, 0.7, (random.integers(3, 7), 3)), axis=0)
        part = np.linspace(0.0, len(knots) - 1.0, 160)
        path = PchipInterpolator(np.arange(len(knots)), knots)(part)
        return _tube(path, radius * np.interp(part, part[[0, -1]], random.uniform(0.7, 1.6, 2)))
    ends = random.uniform(-1.0, 1.0, (random.integers(4, 7), 3))
    parts = []
    for number in range(1, len(ends)):
        start = ends[random.integers(0, number)]
        way = ends[number] - start
        part = creation.capsule(float(np.linalg.norm(way)), radius, count=[20, 20])
        part.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], way))
        parts.append(part.apply_translation(start))
    return _union(parts)


def table(random: Random) -> trimesh.Trimesh:
    """Return a plate on legs."""
    thick = random.uniform(0.1, 0.25)
    if random.random() < 0.5:
        plate = creation.cylinder(random.uniform(0.6, 1.1), thick, sections=96)
    else:
        plate = creation.box([random.uniform(1.0, 2.0), random.uniform(0.9, 1.8), thick])
    wide, deep, _ = plate.extents
    count, long = random.integers(1, 6), random.uniform(0.5, 1.6)
    radius, out = random.uniform(0.06, 0.15), random.uniform(0.25, 0.42) if count > 1 else 0.0
    parts = [plate]
    for turn in np.linspace(0.0, 2 * np.pi, count + 1)[:-1] + random.uniform(0.0, 6.0):
        if random.random() < 0.5:
            leg = creation.cylinder(radius, long, sections=32)
        else:
            leg = creation.box([1.8 * radius, 1.8 * radius, long])
        place = [out * wide * np.cos(turn), out * deep * np.sin(turn), -long / 2]
        parts.append(leg.apply_translation(place))
    return _union(parts)


def blob(random: Random) -> trimesh.Trimesh:
    """Return a smooth, bumpy body."""
    mesh = creation.icosphere(5, 1.0)
    way = np.array(mesh.vertices)
    bump = np.zeros(len(way))
    for order in np.repeat(np.arange(1, 6), 2):
        phase = order * (way @ random.normal(size=3)) + random.uniform(0.0, 6.0)
        bump += random.normal(0.0, 0.2 / order) * np.sin(phase)
    mesh.vertices = way * (1 + np.clip(bump, -0.5, 0.5))[:, None] * random.uniform(0.5, 1.0, 3)
    return mesh


def cluster(random: Random) -> trimesh.Trimesh:
    """Return simple bodies that do not touch."""
    parts: list[trimesh.Trimesh] = []
    wanted = random.integers(2, 7)
    for _ in range(200):
        if len(parts) == wanted:
            break
        part = _moved(_turned(_simple(random, random.uniform(0.35, 0.6)), random), random, 1.0)
        if not any(_may_touch(part, other) for other in parts):
            parts.append(part)
    return trimesh.util.concatenate(parts)


def _may_touch(one: trimesh.Trimesh, other: trimesh.Trimesh) -> bool:
    between = np.linalg.norm(one.bounds.mean(axis=0) - other.bounds.mean(axis=0))
    reach = (np.linalg.norm(one.extents) + np.linalg.norm(other.extents)) / 2
    return bool(between <= reach)


def sheet(random: Random) -> trimesh.Trimesh:
    """Return a thin plate, bent, curled and twisted."""
    outline = _outline(random)
    thick = float(np.exp(random.uniform(*np.log([0.006, 0.04]))))
    flat = manifold3d.Manifold.extrude(outline, thick).refine_to_length(0.05).to_mesh()
    x, y, z = np.array(flat.vert_properties)[:, :3].T
    turn = random.uniform(0.0, 2 * np.pi)
    x, y = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    x *= random.uniform(0.6, 1.6)
    bend, lift = random.choice([0.0, 1.0], p=[0.2, 0.8]) * random.uniform(0.1, 1.2), z - thick / 2
    angle = bend * y
    across = np.where(bend > 0, (1 / max(bend, 1e-9) - lift) * np.sin(angle), y)
    up = np.where(bend > 0, (1 - np.cos(angle)) / max(bend, 1e-9) + lift * np.cos(angle), lift)
    up = up + random.normal(0.0, 0.15) * x**2 + random.normal(0.0, 0.1) * x * across
    return trimesh.Trimesh(np.column_stack((x, across, up)), np.array(flat.tri_verts))


def gear(random: Random) -> trimesh.Trimesh:
    """Return a toothed wheel with a bore."""
    count, deep = random.integers(6, 24), random.uniform(0.1, 0.3)
    angle = np.linspace(0.0, 2 * np.pi, 8 * count + 1)[:-1]
    tooth = np.clip(1.5 * np.sin(count * angle), -1.0, 1.0)
    outline = _around(angle, 1.0 + deep * tooth)
    if random.random() < 0.7:
        outline -= manifold3d.CrossSection.circle(random.uniform(0.15, 0.6), 64)
    made = manifold3d.Manifold.extrude(outline, random.uniform(0.15, 0.8)).to_mesh()
    return trimesh.Trimesh(np.array(made.vert_properties)[:, :3], np.array(made.tri_verts))


def frame(random: Random) -> trimesh.Trimesh:
    """Return bars between the points of a grid, as of a lattice or a shelf."""
    x, y, z = (int(n) for n in random.integers(2, 4, 3))
    wide, step = random.uniform(0.05, 0.16), random.uniform(0.7, 1.3, 3)
    parts = []
    for place in np.ndindex(x, y, z):
        for axis in range(3):
            if place[axis] + 1 < (x, y, z)[axis] and random.random() < 0.85:
                size = np.full(3, wide)
                size[axis] += step[axis]
                bar = creation.box(size)
                parts.append(bar.apply_translation((np.array(place) + np.eye(3)[axis] / 2) * step))
    whole = _union(parts)
    return max(whole.split(), key=lambda one: one.volume)


def shell(random: Random) -> trimesh.Trimesh:
    """Return a thin shell of a smooth body, open at one side."""
    outer = blob(random)
    wall = float(np.exp(random.uniform(*np.log([0.02, 0.12]))))
    inner = outer.copy()
    inner.vertices = inner.vertices - wall * inner.vertex_normals
    cut = creation.box([4.0, 4.0, 4.0])
    cut.apply_translation([0.0, 0.0, 2.0 + random.uniform(-0.3, 0.5) * outer.extents[2] / 2])
    return _without(_without(outer, inner), _turned(cut, random))


KINDS: tuple[Kind, ...] = (
    solids, lathe, extrusion, tubes, table, blob, cluster, slabs, lathe, tubes,
    sheet, sheet, shell, gear, frame,
)  # fmt: skip
"""Kinds in the order of the seeds."""
