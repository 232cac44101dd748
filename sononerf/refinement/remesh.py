# SPDX-License-Identifier: MIT
"""Meshes whose vertices move: areas, curvature, smoothing, and even triangles anew."""

from __future__ import annotations

import warnings

import numpy as np
import torch
import trimesh
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from sononerf.geometry.lattice import level_surface, signed_volume
from sononerf.geometry.meshes import Plane
from sononerf.geometry.raycast import contains
from sononerf.numerics import Floats, Ints, Singles

CURVATURE_LENGTH = 0.5
"""Length over which curvature is averaged, shortest wavelengths."""

SOLVER_TOLERANCE = 0.02
"""Relative residual at which the smoothing's conjugate gradients end; a step need not be exact."""
MOST_ITERATIONS = 200
"""Largest number of iterations of the conjugate gradients; smoothing lengths of a hundred edges
reach it."""


class MeshOperators:
    """Operators of one connectivity, on the device of its tensors.

    In: faces (T, 3).

    Attributes:
        faces (T, 3): Triangles.
        edges (K, 2): Each once.
        degree (V,): Neighbours of each vertex.
    """

    def __init__(self, faces: Tensor, count: int) -> None:
        self.faces, self.count = faces, count
        table: Ints = faces.detach().cpu().numpy()
        pairs = np.concatenate([table[:, [0, 1]], table[:, [1, 2]], table[:, [2, 0]]])
        pairs = np.unique(np.sort(pairs, axis=1), axis=0)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        links = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
        self.edges = torch.as_tensor(pairs).to(faces.device)
        self._adjacency = sparse_tensor(links).to(faces.device)
        self._single = self._adjacency.float()
        self.degree = torch.as_tensor(np.diff(links.tocsr().indptr).astype(np.float64)).to(
            faces.device
        )
        self._corners = faces.reshape(-1)

    def areas(self, vertices: Tensor) -> Tensor:
        """Vector areas (V, 3) of vertices (V, 3): a third of that of each triangle about them."""
        a, b, c = vertices[self.faces].unbind(1)
        third = torch.linalg.cross(b - a, c - a) / 6.0
        return torch.zeros_like(vertices).index_add(
            0, self._corners, third.repeat_interleave(3, dim=0)
        )

    def edge_length(self, vertices: Tensor) -> float:
        """Mean length of the edges, m."""
        ends = vertices[self.edges]
        return float((ends[:, 0] - ends[:, 1]).norm(dim=1).mean())

    def neighbours(self, values: Tensor) -> Tensor:
        """Sum over the neighbours of each vertex (V, K) of values (V, K)."""
        single = values.dtype == torch.float32
        return (self._single if single else self._adjacency) @ values

    def averaged(self, values: Tensor) -> Tensor:
        """Mean (V, K) over each vertex and its neighbours of values (V, K)."""
        degree = self.degree.to(values.dtype)[:, None]
        return (self.neighbours(values) + values) / (degree + 1.0)

    def smoothed(self, values: Tensor, strength: float) -> Tensor:
        r"""Return :math:`(I + \lambda L)^{-1}` times values (V, K), with the graph's Laplacian.

        On an even mesh of edge h it smooths over the length :math:`h \sqrt{1.5 \lambda}`.

        In: values (V, K), strength (1). Out: smoothed (V, K).
        """
        diagonal = 1.0 + strength * self.degree[:, None]

        def apply(x: Tensor) -> Tensor:
            return diagonal * x - strength * (self._adjacency @ x)

        # The Jacobi sweep's start is close where values are smooth already.
        solution = self.averaged(values)
        residual = values - apply(solution)
        scale = values.square().sum(0).clamp_min(1e-300)
        direction = residual / diagonal
        inner = (residual * direction).sum(0)
        for _ in range(MOST_ITERATIONS):
            if bool((residual.square().sum(0) <= SOLVER_TOLERANCE**2 * scale).all()):
                break
            image = apply(direction)
            along = inner / (direction * image).sum(0).clamp_min(1e-300)
            solution = solution + along * direction
            residual = residual - along * image
            conditioned = residual / diagonal
            after = (residual * conditioned).sum(0)
            direction = conditioned + (after / inner.clamp_min(1e-300)) * direction
            inner = after
        return solution

    def relaxed(self, vertices: Tensor, normals: Tensor, part: float) -> Tensor:
        """Move vertices (V, 3) along the surface by a part of the way to their neighbours' mean."""
        towards = self.averaged(vertices) - vertices
        towards = towards - (towards * normals).sum(1, keepdim=True) * normals
        return vertices + part * towards

    def bending(self, vertices: Tensor, normals: Tensor, passes: int) -> Tensor:
        """Curvature tensors, 1/m, positive where the surface is convex.

        In: vertices, normals (V, 3). Out: bending ((V, 6), 1/m).
        """
        a, b, c = vertices[self.faces].unbind(1)
        na, nb, nc = normals[self.faces].unbind(1)
        ab, ac = b - a, c - a
        sides = torch.linalg.cross(ab, ac)
        square = sides.square().sum(1, keepdim=True).clamp_min(1e-300)
        second, third = (
            torch.linalg.cross(ac, sides) / square,
            torch.linalg.cross(sides, ab) / square,
        )
        to_second, to_third = nb - na, nc - na
        change = second[:, :, None] * to_second[:, None] + third[:, :, None] * to_third[:, None]
        change = 0.5 * (change + change.transpose(1, 2))
        parts = torch.stack(
            [
                change[:, 0, 0], change[:, 1, 1], change[:, 2, 2],
                change[:, 0, 1], change[:, 0, 2], change[:, 1, 2],
            ],
            dim=1,
        )  # fmt: skip
        area = square.sqrt()
        weighted = torch.cat([parts * area, area], dim=1).repeat_interleave(3, dim=0)
        total = torch.zeros(self.count, 7, dtype=vertices.dtype, device=vertices.device)
        total = total.index_add(0, self._corners, weighted)
        found = total[:, :6] / total[:, 6:].clamp_min(1e-300)
        for _ in range(passes):
            found = self.averaged(found)
        return found


def sparse_tensor(matrix: coo_array | csr_array) -> Tensor:
    """Return a sparse matrix as a tensor in double precision."""
    rows = matrix.tocsr()
    ends, columns = (torch.as_tensor(p.astype(np.int64)) for p in (rows.indptr, rows.indices))
    data = torch.as_tensor(rows.data.astype(np.float64))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch calls them beta; products are all we use
        return torch.sparse_csr_tensor(ends, columns, data, rows.shape, check_invariants=False)


def unit(vectors: Tensor) -> Tensor:
    """Vectors (..., 3) of length 1; those of length 0 stay."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-300)


def tangents(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (N, 3) square to unit normals (N, 3) and to each other [1]_.

    References:
        .. [1] T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    x, y, z = normals.unbind(1)
    sign = torch.where(z >= 0.0, 1.0, -1.0).to(normals.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (
        torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], dim=1),
        torch.stack([b, sign + y * y * a, -y], dim=1),
    )


def smoothing_passes(wavelength: float, edge: float) -> int:
    """Return the number of averages of curvature, from wavelength and edge, m."""
    return max(1, round(2.0 * (CURVATURE_LENGTH * wavelength / edge) ** 2))


VOXEL_PER_EDGE = 1.1
"""Side of a voxel over the wanted edge: marching cubes then leave as many vertices as even
triangles of that edge have."""
BAND_VOXELS = 2
"""Number of voxels on each side of the surface for which distances are computed."""
RELAXATION_STEPS = 8
"""Number of steps of tangential relaxation; marching cubes leave slivers."""
RELAXATION = 0.7
"""Fraction of the way to the neighbours' mean that one of these steps moves a vertex."""
MIN_PIECE_SIZE = 1.5
"""Side of the cube with the volume of the smallest piece that is kept, edges. Torn films leave
smaller crumbs."""
MAX_LOST = 0.01
"""Largest fraction of the old surface that may be missing from the new one if it is not blurred, no
unit. A sheet thinner than a voxel would be lost."""
MAX_LOST_BLURRED = 0.1
"""The same where it is blurred, no unit. A blur of 0.6 wavelengths takes 0.64 of a helix of wire,
0.02 of a stool and nothing of a cone; a neck between two bodies, which it shall cut, is a few
hundredths."""

CHORD_DEPTH = 0.005
"""Depth of the middles of edges below the smooth surface, shortest wavelengths, above which
triangles are divided."""


def remesh(
    mesh: trimesh.Trimesh, edge: float, blur: float = 0.0, plane: Plane | None = None
) -> trimesh.Trimesh | None:
    """Return a surface with even triangles. In: edge (m), blur (m)."""
    if not mesh.is_watertight or not len(mesh.faces):
        return None
    spacing = VOXEL_PER_EDGE * edge
    whole = mesh if plane is None else plane.with_image(mesh)[0]
    if not whole.is_watertight:
        return None
    lower, distance = signed_distance(
        whole, spacing, margin=2 * BAND_VOXELS + round(2 * blur / spacing)
    )
    if blur:
        distance = ndimage.gaussian_filter(distance, blur / spacing)
    if plane is not None:
        places = lower + spacing * np.argwhere(np.ones(distance.shape, dtype=bool))
        below = -plane.height(places).reshape(distance.shape)
        distance = np.maximum(distance, below.astype(np.float32))
        distance = np.where(np.abs(distance) < 1e-3 * spacing, 1e-3 * spacing, distance)
    if not (distance < 0).any():
        return None
    remeshed = level_surface(distance, 0.0, lower, spacing)
    remeshed.merge_vertices()
    pieces = remeshed.split(only_watertight=False)
    pieces = [
        piece for piece in pieces if abs(signed_volume(piece)) >= (MIN_PIECE_SIZE * edge) ** 3
    ]
    if not pieces:
        return None
    remeshed = trimesh.util.concatenate(pieces) if len(pieces) > 1 else pieces[0]
    old = np.asarray(mesh.vertices)
    at = ((old - lower) / spacing).T
    buried = ndimage.map_coordinates(distance, at, order=1) < -0.5 * spacing
    near = cKDTree(remeshed.vertices).query(old, distance_upper_bound=1.5 * edge + blur)[0]
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area_faces, 3), len(old))
    if np.average(np.isinf(near) & ~buried, weights=area) > (
        MAX_LOST_BLURRED if blur else MAX_LOST
    ):
        return None
    return relaxed(remeshed)


def relaxed(mesh: trimesh.Trimesh, steps: int = RELAXATION_STEPS) -> trimesh.Trimesh:
    """Return the mesh with its vertices spread evenly along the surface."""
    faces = np.array(mesh.faces, dtype=np.int64)
    places = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64))
    operators = MeshOperators(torch.as_tensor(faces), len(places))
    for _ in range(steps):
        places = operators.relaxed(places, unit(operators.areas(places)), RELAXATION)
    return trimesh.Trimesh(places.numpy(), faces, process=False)


def finer(
    mesh: trimesh.Trimesh, values: Floats, wavelength: float
) -> tuple[trimesh.Trimesh, Floats]:
    """Return a finer mesh of the same smooth surface where triangles cut too deep below it.

    Each triangle becomes four. The middle of an edge is put where a curve runs that is square to
    the normals at both ends [1]_.

    In: values (V, ...), wavelength (m). Out: values (V', ...).

    References:
        .. [1] A. Vlachos et al., "Curved PN triangles", I3D 2001.
    """
    places, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    edges, of = np.asarray(mesh.edges_unique), np.asarray(mesh.edges_unique_inverse)
    a, b = edges.T
    edge_vector = places[b] - places[a]
    to_a = (edge_vector * normals[a]).sum(1, keepdims=True)
    to_b = (edge_vector * normals[b]).sum(1, keepdims=True)
    depth = (to_b * normals[b] - to_a * normals[a]) / 8.0
    if np.linalg.norm(depth, axis=1).mean() < CHORD_DEPTH * wavelength:
        return mesh, values
    vertices = np.concatenate([places, (places[a] + places[b]) / 2.0 + depth])
    faces = np.asarray(mesh.faces)
    ab, bc, ca = (len(places) + of.reshape(-1, 3)).T
    first, second, third = faces.T
    whole = np.concatenate(
        [
            np.stack(part, axis=1)
            for part in ((first, ab, ca), (ab, second, bc), (ca, bc, third), (ab, bc, ca))
        ]
    )
    found = trimesh.Trimesh(vertices, whole, process=False)
    return found, np.concatenate([values, (values[a] + values[b]) / 2.0])


def signed_distance(
    mesh: trimesh.Trimesh, spacing: float, *, margin: int
) -> tuple[Floats, Singles]:
    """Signed distance near closed bodies on a lattice, positive outside of all of them.

    In: spacing (m). Out: lower ((3,), m), distance ((X, Y, Z) float32, m).
    """
    bounds = np.asarray(mesh.bounds)
    lower = bounds[0] - margin * spacing
    shape = np.ceil((bounds[1] - bounds[0]) / spacing).astype(int) + 2 * margin + 1
    distance = np.full(tuple(shape), (BAND_VOXELS + 0.5) * spacing, dtype=np.float32)
    for body in mesh.split(only_watertight=False):
        if signed_volume(body) <= 0.0:
            continue
        first = np.floor((body.bounds[0] - lower) / spacing).astype(int) - BAND_VOXELS - 1
        last = np.ceil((body.bounds[1] - lower) / spacing).astype(int) + BAND_VOXELS + 2
        part = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        found = _of_body(body, lower + first * spacing, tuple(last - first), spacing)
        distance[part] = np.minimum(distance[part], found)
    return lower, distance


def _of_body(
    body: trimesh.Trimesh, lower: Floats, shape: tuple[int, ...], spacing: float
) -> Singles:
    """Signed distance of one closed body on a lattice around it."""
    points, normals = _samples(body, 0.5 * spacing)
    near = np.zeros(shape, dtype=bool)
    near[tuple(np.rint((points - lower) / spacing).astype(np.int64).T)] = True
    near = ndimage.binary_dilation(near, iterations=BAND_VOXELS)
    height = _heights(lower + spacing * np.argwhere(near), points, normals, spacing)
    farthest = (BAND_VOXELS + 0.5) * spacing
    distance = np.full(shape, farthest, dtype=np.float32)
    distance[near] = np.clip(height, -farthest, farthest)
    # Where the surface crosses itself, planes give wrong signs, and one would empty the whole body.
    # So the regions beyond the band are judged one by one, by rays.
    regions, count = ndimage.label(~near)
    if count > 1:
        _, voxel = np.unique(regions.ravel(), return_index=True)
        places = lower + spacing * np.stack(np.unravel_index(voxel[-count:], shape), axis=1)
        inside = contains(body.vertices, body.faces, places)
        distance[np.isin(regions, 1 + np.flatnonzero(inside))] = -farthest
    # Voxels that cannot be reached from the outside are inside.
    labels, _ = ndimage.label(distance > 0)
    enclosed = (distance > 0) & (labels != labels[0, 0, 0])
    distance[enclosed] = -distance[enclosed]
    return distance


def distance_from(mesh: trimesh.Trimesh, places: Floats, spacing: float) -> Floats:
    """Return the distance (N,), m, of places (N, 3), m, from a mesh. In: spacing (m)."""
    return np.abs(_heights(places, *_samples(mesh, 0.5 * spacing), spacing))


def _heights(places: Floats, points: Floats, normals: Floats, spacing: float) -> Floats:
    """Return the signed distance (N,) of places (N, 3) from samples of a surface, m."""
    away, nearest = cKDTree(points, balanced_tree=False, compact_nodes=False).query(places)
    height: Floats = ((places - points[nearest]) * normals[nearest]).sum(axis=1)
    # Beside the edge of the nearest piece of surface its plane is not enough.
    aside = np.sqrt(np.maximum(away**2 - height**2, 0.0)) > spacing
    return np.where(aside, np.copysign(away, height), height)


def _samples(mesh: trimesh.Trimesh, spacing: float) -> tuple[Floats, Floats]:
    """Points on a mesh about a spacing apart, and smooth normals there."""
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    normals = np.asarray(mesh.vertex_normals)[np.asarray(mesh.faces)]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.clip(np.ceil(longest / spacing).astype(int), 1, 64)
    points, directions = [np.asarray(mesh.vertices)], [np.asarray(mesh.vertex_normals)]
    for count in np.unique(parts):
        some = parts == count
        i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
        kept = i + j < count
        first, second = (i[kept] + 1 / 3) / count, (j[kept] + 1 / 3) / count
        weights = np.stack([1 - first - second, first, second], axis=1)
        points.append(np.einsum("wc,tcd->twd", weights, corners[some]).reshape(-1, 3))
        directions.append(np.einsum("wc,tcd->twd", weights, normals[some]).reshape(-1, 3))
    found = np.concatenate(directions)
    length = np.linalg.norm(found, axis=1, keepdims=True)
    return np.concatenate(points), found / np.maximum(length, 1e-12)
