# SPDX-License-Identifier: MIT
"""A surface: its mesh, its confidence, its openings, and its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from sononerf import storage
from sononerf.display import NotebookRepr
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.echoes.region import MIN_POSES
from sononerf.errors import InputError, NumericalError, expect
from sononerf.geometry.lattice import Volume
from sononerf.geometry.meshes import Plane
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats
from sononerf.scene.gltf import Z_UP
from sononerf.start.network import StartMethod

MeshFormat = Literal["ply", "stl", "glb"]
MAX_SHEET_THICKNESS = 0.7
"""Distance of the other side below which a place is thin, range resolutions. The sides of a sheet
share one echo, so neither is known to better than a fraction of the resolution."""
ALIGNED = 0.3
"""Distance that a place may lie outside of the convex hull of heard ones and still be on one smooth
surface with them, range resolutions."""


def mesh_bytes(
    mesh: trimesh.Trimesh,
    file_type: MeshFormat,
    *,
    confidence: ArrayLike | None = None,
    error: ArrayLike | None = None,
) -> bytes:
    """Return a mesh as the bytes of a file; the same mesh gives the same bytes.

    With a confidence PLY and GLB carry a colour per vertex: from dark grey, heard by no pose, to
    bright yellow, heard by a hundred or more, in steps even to the eye over the logarithm (see
    :func:`~sononerf.start.surface.confidence_colours`). PLY also holds the numbers
    themselves, as the vertices' property ``poses``, their error (m) as the property ``error``, and
    always their normals. STL knows none of them. In GLB y is up, as its standard says.

    In: confidence (V,), error ((V,), m).
    """
    if file_type not in ("ply", "stl", "glb"):
        raise ValueError(f"file_type: {file_type!r}, expected 'ply', 'stl' or 'glb'")
    if not len(mesh.faces):
        raise NumericalError("the mesh is empty: there is nothing to write")
    if not np.isfinite(mesh.vertices).all():
        raise NumericalError("the mesh has vertices that are not finite")
    # A bare copy: names, paths and times that a loader attached stay out of the file.
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, validate=False)
    if confidence is not None:
        _carry(bare, file_type, np.asarray(confidence))
    if error is not None and file_type == "ply":
        bare.vertex_attributes["error"] = np.asarray(error, dtype=np.float32)
    if file_type == "glb":
        bare.vertices = bare.vertices @ Z_UP
    options = {"vertex_normal": True} if file_type == "ply" else {}
    return bytes(bare.export(file_type=file_type, **options))


def _carry(mesh: trimesh.Trimesh, file_type: MeshFormat, poses: NDArray[Any]) -> None:
    """Colour a mesh by its confidence, in place, if the format has colours."""
    if poses.shape != (len(mesh.vertices),) or not (poses >= 0).all():
        raise ValueError(
            f"confidence: shape {poses.shape}, expected ({len(mesh.vertices)},), zero or more"
        )
    if file_type == "stl":
        return
    colours = confidence_colours(poses)
    if file_type == "glb":
        colours = linear_light(colours)  # glTF's own rule; a viewer would show sRGB too bright
    else:
        mesh.vertex_attributes["poses"] = poses.astype(np.int32)
    mesh.visual = trimesh.visual.ColorVisuals(
        mesh, vertex_colors=np.round(255 * colours).astype(np.uint8)
    )


def confidence_of(mesh: trimesh.Trimesh) -> NDArray[np.int32] | None:
    """Return the number of poses that heard each vertex (V,) of a mesh from a PLY file.

    None where the file does not say.
    """
    found = _property(mesh, "poses")
    return None if found is None else found.astype(np.int32)


def error_of(mesh: trimesh.Trimesh) -> NDArray[np.float32] | None:
    """Return the error ((V,), m) of each vertex of a mesh that was read from a PLY file.

    None where the file does not say.
    """
    found = _property(mesh, "error")
    return None if found is None else found.astype(np.float32)


def _property(mesh: trimesh.Trimesh, name: str) -> NDArray[Any] | None:
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    if raw is None or name not in (raw.dtype.names or ()) or len(raw) != len(mesh.vertices):
        return None
    return np.asarray(raw[name])


# Number of poses from which on the colour is the brightest.
MANY_POSES = 100
# Dark grey and bright yellow in OKLab; on the line between the two, equal steps look equal.
FEW_COLOUR, MANY_COLOUR = (0.34, 0.0, -0.01), (0.93, -0.02, 0.15)


def confidence_colours(poses: ArrayLike) -> Floats:
    """Colour numbers of poses: dark grey for none, bright yellow for a hundred and more.

    Steps are even to the eye (a straight line in OKLab [1]_) over the logarithm of one plus the
    number, and the ends are the same for every mesh, so that pictures can be compared.

    In: poses (N,). Out: colours (N, 3).

    References:
        .. [1] B. Ottosson, "A perceptual color space for image processing", 2020.
    """
    counts = np.asarray(poses, dtype=np.float64)
    share = np.clip(np.log1p(counts) / np.log1p(MANY_POSES), 0, 1)[..., None]
    few, many = np.asarray(FEW_COLOUR), np.asarray(MANY_COLOUR)
    lightness, a, b = np.moveaxis(few + share * (many - few), -1, 0)
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    linear = np.stack(
        [
            4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
            -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
            -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
        ],
        axis=-1,
    ).clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def linear_light(colours: ArrayLike) -> Floats:
    """Turn sRGB colours (..., 3), 0 to 1, into linear light, as glTF has them."""
    given = np.asarray(colours, dtype=np.float64)
    return np.where(given <= 0.04045, given / 12.92, ((given + 0.055) / 1.055) ** 2.4)


FORMATS: tuple[MeshFormat, ...] = get_args(MeshFormat)
"""Kinds of mesh files that are written."""


@dataclass(frozen=True, eq=False)
class Surface(NotebookRepr):
    """A reconstructed surface, or one of your own: ``Surface(mesh)``.

    Attributes:
        mesh: World frame, m.
        volume: The field's energy, or its loudness for an iso-surface; None without a field.
        method: Method of the surface.
        level: Level of an iso-surface, in the unit of the volume; None for other methods.
        openness: Kind of surface; None for an iso-surface and for one of your own.
        confidence ((V,) int32 or None): Number of poses that heard the surface around each vertex.
        error ((V,) float32 or None, m): Distance within which the true surface is with a
            probability of 90 %, where the confidence is above zero; None without a refinement.
        refined: Whether it was refined.
        error_db (dB): Objective of the refinement on validation poses; None without a refinement.
        faults: Faults of the refinement, one line each.
        echoes: Echoes of its field; None if unknown.
        starts: Closed surfaces that a refinement begins with, m; the mesh itself where empty.

    Raises:
        InputError: If the mesh has no triangles, or a vertex is not finite.
    """

    mesh: trimesh.Trimesh
    volume: Volume | None = None
    method: StartMethod = "given"
    level: float | None = None
    openness: Openness | None = None
    confidence: NDArray[np.int32] | None = None
    error: NDArray[np.float32] | None = None
    refined: bool = False
    error_db: float | None = None
    faults: Sequence[str] = ()
    echoes: Echoes | None = field(default=None, repr=False)
    starts: Mapping[StartMethod, trimesh.Trimesh] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        expect(self.mesh, trimesh.Trimesh, "mesh")
        if not len(self.mesh.faces) or not np.isfinite(self.mesh.vertices).all():
            raise InputError("the mesh has no triangles, or a vertex is not finite")

    def save(self, path: Path | str) -> None:
        """Write the mesh, m: PLY (with normals, confidence, error), STL or GLB, by the ending.

        Args:
            path: The file; one that is there is replaced whole.

        Raises:
            InputError: If the ending is another one.
            StorageError: If the file cannot be written.
        """
        path = Path(path)
        kind = path.suffix.lower().removeprefix(".")
        if kind not in FORMATS:
            raise InputError(f"{path}: expected a name that ends in .{', .'.join(FORMATS)}")
        storage.commit_bytes(path, self.file(kind))

    def file(self, kind: MeshFormat) -> bytes:
        """Return the mesh as the bytes of a file, see :meth:`save`."""
        return mesh_bytes(self.mesh, kind, confidence=self.confidence, error=self.error)


def surface_as_heard(
    mesh: trimesh.Trimesh, echoes: Echoes, *, confidence: NDArray[np.int32], **facts: Any
) -> Surface:
    """Return the surface of a closed mesh, without the triangles that no pose can have heard.

    An open surface also ends where what was heard ends. ``facts`` are further attributes of it.

    In: confidence (V,).
    """
    hull, resolution = echoes.hull, echoes.head.resolution
    error = facts.pop("error", None)
    openness = judge_openness(mesh, hull.sources, resolution=resolution, plane=hull.plane)
    if openness.kind == "one-sided":
        part = known_part(mesh, confidence, hull, resolution=resolution)
        part &= ~at_wall(mesh.triangles_center, echoes.bounds, resolution / 2)
        if (part & ~openness.unseen).any():
            openness = leaving_out(openness, ~part, mesh.area_faces)
        used = np.unique(mesh.faces[~openness.unseen])
        mesh, confidence = without_unseen(mesh, openness), confidence[used]
        error = None if error is None else error[used]
    return Surface(
        mesh, openness=openness, confidence=confidence, error=error, echoes=echoes, **facts
    )


MIN_FACING = 0.1
"""Least cosine between a triangle's normal and the direction to a pose for the triangle to face
it."""
UNSEEN_SHARE = 0.25
"""Fraction of the area that cannot have been heard above which a surface is one-sided."""
THIN_SHARE = 0.75
"""Fraction of the area that is thin above which a surface is a sheet."""
STANDING_HEIGHT = 0.5
"""Height over the support up to which a triangle stands on it, range resolutions: sound does not
resolve a smaller gap."""
_LIFT = 1e-3  # depth at which the search for the other side begins, over the root of the area
_POSES = 12  # poses that are tested at a time, those that a triangle faces best first
_CHUNK = 4096  # triangles at a time; it bounds the memory


@dataclass(frozen=True)
class Openness:
    """Kind of a surface: closed, one-sided or a sheet."""

    # (T,): The triangles that no pose can have heard, or that are unknown, see :func:`known_part`
    unseen: Bools
    # Fractions of the area: of these triangles; that has the other side close behind it
    unseen_share: float
    thin_share: float

    @property
    def kind(self) -> Literal["closed", "sheet", "one-sided"]:
        """A body's skin, a sheet that was heard from both sides, or one side of something."""
        if self.unseen_share > UNSEEN_SHARE:
            return "one-sided"
        return "sheet" if self.thin_share > THIN_SHARE else "closed"

    @property
    def text(self) -> str:
        """What is told of a surface that does not enclose a body; empty for a closed one."""
        if self.kind == "sheet":
            return (
                f"the surface is a sheet: {self.thin_share:.0%} of it has its other side right "
                "behind it"
            )
        if self.kind == "one-sided":
            return (
                f"the surface is open: {self.unseen_share:.0%} of it, which no pose heard, is left "
                "out"
            )
        return ""


def judge_openness(
    mesh: trimesh.Trimesh, sources: Floats, *, resolution: float, plane: Plane | None = None
) -> Openness:
    """Judge whether a surface is a closed body, one-sided, or a sheet.

    A support mirrors sound, so that poses also hear from their images. A triangle that stands on
    the support counts as seen: no pose hears it, but the support gives its place.

    In: sources ((P, 3), m), resolution (m).
    """
    middles = np.asarray(mesh.triangles_center, dtype=np.float64)
    normals = np.asarray(mesh.face_normals, dtype=np.float64)
    areas = np.asarray(mesh.area_faces, dtype=np.float64)
    caster = RayCaster(mesh)
    if plane is None:
        unseen = ~_seen(caster, middles, normals, sources)
    else:
        image = trimesh.Trimesh(plane.mirrored(mesh.vertices), mesh.faces[:, ::-1], process=False)
        both = RayCaster(trimesh.util.concatenate([mesh, image]))
        heads = np.concatenate([sources, plane.mirrored(sources)])
        stands = plane.height(np.asarray(mesh.triangles)).max(axis=1) < STANDING_HEIGHT * resolution
        unseen = ~(stands | _seen(both, middles, normals, heads))
    lift = _LIFT * np.sqrt(areas)
    inward = caster.first_hit(middles - lift[:, None] * normals, -normals)
    thin = inward.ray[inward.distance + lift[inward.ray] < MAX_SHEET_THICKNESS * resolution]
    total = areas.sum()
    return Openness(unseen, float(areas[unseen].sum() / total), float(areas[thin].sum() / total))


def _seen(caster: RayCaster, middles: Floats, normals: Floats, sources: Floats) -> Bools:
    seen = np.zeros(len(middles), dtype=bool)
    for start in range(0, len(middles), _CHUNK):
        some = slice(start, start + _CHUNK)
        to_sources = sources[None] - middles[some, None]
        to_sources /= np.linalg.norm(to_sources, axis=2, keepdims=True)
        facing = np.einsum("tpi,ti->tp", to_sources, normals[some])
        order = np.argsort(-facing, axis=1)
        left = np.arange(len(facing))
        for first in range(0, len(sources), _POSES):
            best = order[left, first : first + _POSES]
            row, column = np.nonzero(np.take_along_axis(facing[left], best, axis=1) > MIN_FACING)
            if not len(row):
                break
            which = start + left[row]
            tested = sources[best[row, column]]
            seen[which[caster.visible(middles[which], tested, normals=normals[which])]] = True
            left = left[~seen[start + left]]
    return seen


def known_part(
    mesh: trimesh.Trimesh, heard: NDArray[np.int32], hull: EchoHull, *, resolution: float
) -> Bools:
    """Return the mask of the triangles that were heard, of a surface heard from one side.

    These are the triangles that two poses heard. A triangle between such triangles is also known if
    it lies within one range resolution behind an onset. Between means in their convex hull, or as
    little out of it as one smooth surface may be.

    In: heard ((V,) int32), resolution (m). Out: (T,).
    """
    middles = np.asarray(mesh.triangles_center, dtype=np.float64)
    bounded = hull.clearance(middles)[0] < resolution
    enough = heard >= min(MIN_POSES, int(heard.max(initial=0)))
    if not heard.any():
        return np.asarray(bounded)
    places = np.asarray(mesh.vertices)[enough]
    try:
        planes = ConvexHull(places).equations
    except (QhullError, ValueError):  # too few, or all in one plane
        return np.asarray(enough[mesh.faces].any(axis=1))
    between = np.ones(len(middles), dtype=bool)
    for plane in planes:
        between &= middles @ plane[:3] + plane[3] <= ALIGNED * resolution
    return np.asarray(enough[mesh.faces].any(axis=1) | (between & bounded))


def at_wall(points: Floats, box: Floats, voxel: float) -> Bools:
    """Return the mask (N,) of points (N, 3), m, within a voxel of the region's walls, or beyond."""
    inner = (points > box[0] + voxel) & (points < box[1] - voxel)
    return np.asarray(~inner.all(axis=1))


def leaving_out(openness: Openness, unknown: Bools, areas: Floats) -> Openness:
    """Return the openness with triangles (T,) of these areas among the unseen ones."""
    unseen = openness.unseen | unknown
    share = float(areas[unseen].sum() / areas.sum())
    return replace(openness, unseen=unseen, unseen_share=share)


def without_unseen(mesh: trimesh.Trimesh, openness: Openness) -> trimesh.Trimesh:
    """Return the mesh without the triangles that no pose can have heard."""
    kept = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces[~openness.unseen].copy(), process=False)
    kept.remove_unreferenced_vertices()
    return kept
