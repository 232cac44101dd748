# SPDX-License-Identifier: MIT
r"""Errors of recording and poses, estimated from a surface and what was heard of it.

The spectrograms of the surface by physical optics are compared with the measured ones, in
compressed decibels. Errors that all poses share (the gain of each receiver, range offset, speed of
sound) and errors of each pose (position, aim) are found together by Gauss-Newton steps [1]_ on an
absolute loss. The surface itself is allowed to grow by a uniform layer and by a scale, because a
surface that was fitted to wrong ranges has taken them up. All derivatives are finite differences.

Each pose has unknowns of its own, so the normal equations have the shape of an arrow and are
reduced to those of the shared errors (Schur complement). Their inverse gives the uncertainties.

References:
    .. [1] B. Triggs et al., "Bundle adjustment, a modern synthesis", Vision Algorithms, 2000.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from sononerf.array_types import Floats, Singles
from sononerf.echoes.echoes import Echoes
from sononerf.head.decibels import ACTIVE_DB
from sononerf.surface.refine.mesh_operators import MeshOperators, smoothing_passes, unit
from sononerf.surface.refine.objective import FLOOR_DB, TRUST
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.visibility import listen, sight_of

Kind = Literal["gain", "range_offset", "speed_of_sound", "position", "aim"]
KINDS: tuple[Kind, ...] = ("gain", "range_offset", "speed_of_sound", "position", "aim")
STEP = 0.02
"""Length of a finite difference, shortest wavelengths: small against interference, large against
rounding."""
TURN = 0.01
"""The same of an aim, rad: small against the beam's width."""
LEAST_DB = 0.5
"""Differences below this have the weight of one of it: physical optics is no better."""
_DB = 20.0 / math.log(10.0)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Errors of a recording; zero where nothing is wrong.

    Attributes:
        gain (E,): Natural logarithm of how much too loud each receiver is.
        range_offset (m): How much too far everything is heard.
        speed_of_sound: Logarithm of the true speed over the assumed one.
        position ((P, 3), m): To be added to the stated positions.
        aim ((P, 3), rad): Rotation vectors, world frame, to be applied to the stated rotations.
    """

    gain: Floats
    range_offset: float
    speed_of_sound: float
    position: Floats
    aim: Floats

    @classmethod
    def none(cls, receivers: int, poses: int) -> Calibration:
        """Return no errors."""
        return cls(np.zeros(receivers), 0.0, 0.0, np.zeros((poses, 3)), np.zeros((poses, 3)))


@dataclass(frozen=True, eq=False)
class Estimate:
    """What was found, and how well.

    Attributes:
        calibration: The errors.
        deviation: One standard deviation of each kind: shared errors in their own unit; position
            (m) and aim (rad) as the root mean square over poses and axes.
        error_db: Mean absolute difference over active cells before each step, and after the last.
    """

    calibration: Calibration
    deviation: dict[str, float]
    error_db: list[float]


class Body:
    """A surface whose spectrograms are rendered for poses with errors.

    Args:
        mesh: m.
        optics: The head.
    """

    def __init__(self, mesh: trimesh.Trimesh, optics: Optics) -> None:
        self.optics = optics
        like = optics.get_buffer("wavenumber")
        faces = np.array(mesh.faces, dtype=np.int64)
        self.vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64)).to(like.device)
        self.operators = MeshOperators(torch.as_tensor(faces).to(like.device), len(self.vertices))
        self.area = self.operators.areas(self.vertices)
        passes = smoothing_passes(optics.wavelength, self.operators.edge_length(self.vertices))
        self.bending = self.operators.bending(self.vertices, unit(self.area), passes)
        self.sight = sight_of(optics, self.vertices.cpu().numpy(), faces)

    def render(
        self, positions: Floats, rotations: Floats, stretch: Floats, late: Floats
    ) -> Singles:
        """Return magnitudes (P, E, R, F) on the whole axis.

        Args:
            positions, rotations ((P, 3), (P, 3, 3)): Of the heads, m.
            stretch, late ((P,), (P,)): Factor on paths, and m added to them.
        """
        optics = self.optics
        shape = (len(positions), optics.ears, optics.rows, len(optics.frequencies))
        found = np.zeros(shape, dtype=np.float32)
        places, turns = (torch.as_tensor(part).to(self.vertices) for part in (positions, rotations))
        with torch.no_grad():
            pieces, heads, middle = listen(
                optics,
                self.operators,
                self.vertices,
                self.area,
                self.bending,
                self.sight,
                places,
                turns,
            )
            if not len(pieces.pose):
                return found
            heard = optics.render(
                (self.vertices - middle).float(),
                self.area.float(),
                pieces,
                heads,
                stretch=torch.as_tensor(stretch).to(heads.emitters),
                late=torch.as_tensor(late).to(heads.emitters),
            )
        magnitude = heard.power.sqrt().cpu().numpy()
        for one, rendered, row in zip(found, magnitude, heard.row.tolist(), strict=True):
            first, last = max(row, 0), min(row + rendered.shape[1], optics.rows)
            if last > first:
                one[:, first:last] = rendered[:, first - row : last - row]
        return found


@dataclass(frozen=True, eq=False)
class _Column:
    """One unknown of a pose or of all, and how a rendering with it changed is made."""

    name: str
    step: float
    axis: int = 0


class Calibrator:
    """Gauss-Newton steps on the errors of a recording.

    Args:
        mesh: The surface, m.
        echoes: What was measured; its training and validation poses take part.
        optics: The head.
        kinds: Which errors are looked for; see :data:`KINDS`.
        dependent: How many cells of a spectrogram share their noise.

    Attributes:
        change: Length of the last step over one standard deviation, of the error that changed most;
            of poses the root mean square.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        echoes: Echoes,
        optics: Optics,
        kinds: Sequence[Kind],
        *,
        dependent: float,
    ) -> None:
        self.mesh, self.echoes, self.optics = mesh, echoes, optics
        self.dependent = dependent
        self.poses = np.concatenate((echoes.training, echoes.validation))
        self.found = Calibration.none(optics.ears, len(echoes.positions))
        self.layer, self.scale = 0.0, 0.0
        unit_length = STEP * optics.wavelength
        reach = float(np.linalg.norm(echoes.positions - mesh.centroid, axis=1).mean())
        self.local = [
            *(_Column("position", unit_length, n) for n in range(3) if "position" in kinds),
            *(_Column("aim", TURN, n) for n in range(3) if "aim" in kinds),
        ]
        self.shared = [_Column("gain", 0.0, n) for n in range(optics.ears) if "gain" in kinds]
        if "range_offset" in kinds:
            self.shared.append(_Column("range_offset", unit_length))
        if "speed_of_sound" in kinds:
            self.shared.append(_Column("speed_of_sound", unit_length / reach))
        if {"range_offset", "speed_of_sound"} & set(kinds):
            self.shared.append(_Column("layer", unit_length))
            self.shared.append(_Column("scale", unit_length / float(mesh.scale)))
        # How far poses may be off, one standard deviation; learned from what is found.
        self.spread = {"position": optics.head.resolution / 2.0, "aim": 5.0 * TURN}
        self.weight = np.ones((optics.ears, 1, len(optics.frequencies)))
        self.error_db: list[float] = []
        self.deviation: dict[str, float] = {}
        self.change = math.inf

    def step(self, shown: Callable[[], None] = lambda: None) -> float:
        """Do one step; return the error before it, dB. ``shown`` is called once per pose."""
        bodies = self._bodies()
        locals_, shareds = len(self.local), len(self.shared)
        size = locals_ + shareds
        total = np.zeros((shareds, shareds))
        towards = np.zeros(shareds)
        kept = []
        errors, cost, cells = [], 0.0, 0.0
        sums = np.zeros((2, *self.weight.shape))
        for number in self.poses.tolist():
            residual, jacobian, active = self._linear(bodies, number)
            shown()
            if not active.any():
                kept.append((number, np.zeros((locals_, size)), np.zeros(locals_)))
                continue
            sums[0] += (np.abs(residual) * active).sum(axis=1, keepdims=True)
            sums[1] += active.sum(axis=1, keepdims=True)
            weight = (self.weight / np.maximum(np.abs(residual), LEAST_DB))[
                np.broadcast_to(active, residual.shape)
            ]
            r, j = residual[active], jacobian[:, active]
            errors.append(float(np.abs(r).mean()))
            weighted = j * weight
            normal, right = weighted @ j.T, weighted @ r
            cost += float((weight * r * r).sum())
            cells += float(len(r))
            total += normal[locals_:, locals_:]
            towards += right[locals_:]
            kept.append((number, normal[:locals_], right[:locals_]))
        self.error_db.append(float(np.mean(errors)) if errors else math.inf)
        self._solve(kept, total, towards, cost / max(cells, 1.0) * self.dependent)
        usual = sums[0] / np.maximum(sums[1], 1.0)
        usual = np.where(sums[1] > 0.0, usual, usual.max())
        power = np.maximum(usual, 0.25 * np.median(usual)) ** -TRUST
        self.weight = power / power.mean()
        return self.error_db[-1]

    def _solve(
        self,
        kept: list[tuple[int, Floats, Floats]],
        total: Floats,
        towards: Floats,
        noise: float,
    ) -> None:
        """Solve the normal equations, move all unknowns, and learn spreads and uncertainties."""
        locals_ = len(self.local)
        prior = np.diag([noise / self.spread[column.name] ** 2 for column in self.local])
        reduced, right = total.copy(), towards.copy()
        inverses = []
        for _, normal, own in kept:
            inverse = np.linalg.inv(normal[:, :locals_] + prior) if locals_ else np.zeros((0, 0))
            cross = normal[:, locals_:]
            # The prior pulls towards no error at all.
            now = own - prior @ self._local_values(_)
            reduced -= cross.T @ inverse @ cross
            right -= cross.T @ inverse @ now
            inverses.append((inverse, cross, now))
        scale = np.sqrt(np.maximum(np.diag(reduced), 1e-30))
        damped = reduced / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
        covariance = np.linalg.pinv(damped, hermitian=True) / np.outer(scale, scale)
        shared = covariance @ right
        unit_of = np.sqrt(np.maximum(noise * np.diag(covariance), 1e-30))
        self.change = float((np.abs(shared) / unit_of).max(initial=0.0))
        steps: list[float] = []
        variances: dict[str, list[float]] = {"position": [], "aim": []}
        squares: dict[str, list[float]] = {"position": [], "aim": []}
        for (number, _, _), (inverse, cross, now) in zip(kept, inverses, strict=True):
            if not locals_:
                break
            step = inverse @ (now - cross @ shared)
            self._move(number, step)
            steps.extend((step**2 / np.maximum(noise * np.diag(inverse), 1e-30)).tolist())
            lever = inverse @ cross
            spread = noise * (np.diag(inverse) + ((lever @ covariance) * lever).sum(axis=1))
            for column, value, variance in zip(
                self.local, self._local_values(number), spread, strict=True
            ):
                variances[column.name].append(float(variance))
                squares[column.name].append(float(value) ** 2)
        self.change = max(self.change, math.sqrt(float(np.mean(steps))) if steps else 0.0)
        for name in {column.name for column in self.local}:
            self.deviation[name] = math.sqrt(float(np.mean(variances[name])))
            self.spread[name] = math.sqrt(float(np.mean(squares[name]) + np.mean(variances[name])))
        self._move_all(shared)
        for column, variance in zip(self.shared, np.diag(covariance), strict=True):
            deviation = math.sqrt(max(noise * float(variance), 0.0))
            self.deviation[column.name] = max(self.deviation.get(column.name, 0.0), deviation)

    def _local_values(self, number: int) -> Floats:
        return np.array(
            [getattr(self.found, column.name)[number, column.axis] for column in self.local]
        )

    def _move(self, number: int, step: Floats) -> None:
        limits = {"position": 0.5 * self.optics.head.resolution, "aim": 5.0 * TURN}
        turn = np.zeros(3)
        for column, value in zip(self.local, step, strict=True):
            bounded = float(np.clip(value, -limits[column.name], limits[column.name]))
            if column.name == "position":
                self.found.position[number, column.axis] += bounded
            else:
                turn[column.axis] = bounded
        before = Rotation.from_rotvec(self.found.aim[number])
        self.found.aim[number] = (Rotation.from_rotvec(turn) * before).as_rotvec()

    def _move_all(self, step: Floats) -> None:
        gain = self.found.gain
        offset, speed = self.found.range_offset, self.found.speed_of_sound
        for column, value in zip(self.shared, step.tolist(), strict=True):
            if column.name == "gain":
                gain[column.axis] += value
            elif column.name == "range_offset":
                offset += value
            elif column.name == "speed_of_sound":
                speed += value
            elif column.name == "layer":
                self.layer += value
            else:
                self.scale += value
        self.found = Calibration(gain, offset, speed, self.found.position, self.found.aim)

    def _bodies(self) -> dict[str, Body]:
        """Return the surface as it is, and changed as the unknowns of the surface do."""
        normals = np.array(self.mesh.vertex_normals)
        middle = self.mesh.centroid

        def changed(layer: float, scale: float) -> Body:
            places = (self.mesh.vertices - middle) * math.exp(scale) + middle + layer * normals
            return Body(trimesh.Trimesh(places, self.mesh.faces, process=False), self.optics)

        found = {"": changed(self.layer, self.scale)}
        for column in self.shared:
            if column.name == "layer":
                found["layer"] = changed(self.layer + column.step, self.scale)
            elif column.name == "scale":
                found["scale"] = changed(self.layer, self.scale + column.step)
        return found

    def _linear(self, bodies: dict[str, Body], number: int) -> tuple[Floats, Floats, Floats]:
        """Return residual (E, R, F) dB, derivatives (U, E, R, F) and active cells of a pose."""
        found = self.found
        position = self.echoes.positions[number] + found.position[number]
        turned = Rotation.from_rotvec(found.aim[number]).as_matrix()
        rotation = turned @ self.echoes.rotations[number]
        positions, rotations, stretch, late = [position], [rotation], [0.0], [0.0]
        for column in [*self.local, *self.shared]:
            if column.name in ("gain", "layer", "scale"):
                continue
            along = np.eye(3)[column.axis] * column.step
            moved = along if column.name == "position" else 0.0
            turn = along if column.name == "aim" else np.zeros(3)
            positions.append(position + moved)
            rotations.append(Rotation.from_rotvec(turn).as_matrix() @ rotation)
            stretch.append(-column.step if column.name == "speed_of_sound" else 0.0)
            late.append(2.0 * column.step if column.name == "range_offset" else 0.0)
        factors = np.exp(np.array(stretch) - found.speed_of_sound)
        lates = np.array(late) + 2.0 * found.range_offset
        rendered = bodies[""].render(np.stack(positions), np.stack(rotations), factors, lates)
        gain = np.exp(found.gain)[:, None, None]
        measured = self.echoes.magnitude(number).numpy().astype(np.float64)
        reference = max(float(measured.max()) * 10.0 ** (-FLOOR_DB / 20.0), 1e-30)

        def compressed(magnitude: Singles) -> Floats:
            return np.asarray(_DB * np.log1p(gain * magnitude / reference), dtype=np.float64)

        a, b = _DB * np.log1p(measured / reference), compressed(rendered[0])
        columns, after = [], iter(rendered[1:])
        one = (positions[:1], rotations[:1], factors[:1], lates[:1])
        for column in [*self.local, *self.shared]:
            if column.name == "gain":
                slope = -_DB * np.expm1(-b / _DB)
                slope[np.arange(len(slope)) != column.axis] = 0.0
            elif column.name in ("layer", "scale"):
                body = bodies[column.name].render(*(np.asarray(part) for part in one))[0]
                slope = (compressed(body) - b) / column.step
            else:
                slope = (compressed(next(after)) - b) / column.step
            columns.append(slope)
        active = (a >= ACTIVE_DB) | (b >= ACTIVE_DB)
        return a - b, np.stack(columns), active

    def result(self) -> Estimate:
        """Return what was found so far."""
        names = {"layer", "scale"}
        known = {name: value for name, value in self.deviation.items() if name not in names}
        return Estimate(self.found, known, list(self.error_db))
