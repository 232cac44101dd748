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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from sononerf.array_types import Floats, Singles
from sononerf.echoes.echoes import Echoes
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.head.decibels import ACTIVE_DB
from sononerf.surface.refine.objective import FLOOR_DB, TRUST
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.recording_errors import Calibration, Estimate, Kind, changed_head
from sononerf.surface.refine.still_surface import StillSurface

STEP = 0.02
"""Length of a finite difference, shortest wavelengths: small against interference, large against
rounding."""
LEVEL_POSES = 50
"""Number of poses from which the first level of a recording is taken, and on which errors are
compared. Later steps improve the level."""
MOST_POSES = 60
"""Number of poses, at most, from which the errors that all poses share are found. More poses do not
help, because the surface is known less well than this number of poses determines the errors."""
GROUPS = 12
"""Number of groups of neighbouring poses that give the uncertainties: each hears the surface from
another side."""
FARTHER = 4
"""Number of times, at most, that a step of the shared errors is doubled while the error falls.
Interference makes the derivatives of fine cells steep but short, and steps too small."""
TURN = 0.01
"""Finite difference of an aim, rad: small against the beam's width."""
LARGEST_STEP = 0.5
"""Largest step of a length, range resolutions: beyond it the derivatives do not hold."""
LEAST_DB = 0.5
"""Difference below which all differences have the same weight, dB: physical optics is no more
accurate."""
_DB = 20.0 / math.log(10.0)


@dataclass(frozen=True, eq=False)
class _Column:
    """One unknown of a pose or of all, and how a rendering with it changed is made."""

    name: str
    step: float
    axis: int = 0


class Calibrator:
    """Gauss-Newton steps on the errors of a recording.

    Attributes:
        change: Length of the last step over one standard deviation, of the error that changed most;
            of poses the root mean square.
        stretch: Largest distance that the shared errors went, over the step that the derivatives
            gave, no unit, 1 or more. Uncertainties are multiplied by it.
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
        self._optics: dict[float, Optics] = {}
        unit_length = STEP * optics.wavelength
        reach = float(np.linalg.norm(echoes.positions - mesh.centroid, axis=1).mean())
        self.local = [
            *(_Column("position", unit_length, n) for n in range(3) if "position" in kinds),
            *(_Column("aim", TURN, n) for n in range(3) if "aim" in kinds),
        ]
        # The level of recordings is not known, and every other error would take it up.
        levels = "gain" in kinds or not echoes.calibrated
        self.shared = [_Column("gain", 0.0, n) for n in range(optics.ears) if levels]
        if "beam_radius" in kinds:
            self.shared.append(_Column("beam_radius", STEP * optics.head.ears.beam_radius))
        if "range_offset" in kinds:
            self.shared.append(_Column("range_offset", unit_length))
        if "speed_of_sound" in kinds:
            self.shared.append(_Column("speed_of_sound", unit_length / reach))
        if {"range_offset", "speed_of_sound"} & set(kinds):
            self.shared.append(_Column("layer", unit_length))
            self.shared.append(_Column("scale", unit_length / float(mesh.scale)))
        if not self.local:
            count = min(MOST_POSES, len(self.poses))
            chosen = np.linspace(0, len(self.poses) - 1, count).round().astype(int)
            self.poses = self.poses[chosen]
        # How far poses may be off, one standard deviation; learned from what is found.
        self.spread = {"position": optics.head.resolution / 2.0, "aim": 5.0 * TURN}
        self.weight = np.ones((optics.ears, 1, len(optics.frequencies)))
        self.error_db: list[float] = []
        self.deviation: dict[str, float] = {}
        self.change = math.inf
        self.stretch = 1.0

    def step(self, shown: Callable[[], None] = lambda: None) -> float:
        """Do one step; return the error before it, dB. ``shown`` is called once per pose."""
        bodies = self._bodies(self.shared)
        if not self.error_db and not self.echoes.calibrated:
            self.found.gain[:] = self._level(bodies[""])
        locals_, shareds = len(self.local), len(self.shared)
        size = locals_ + shareds
        total = np.zeros((shareds, shareds))
        towards = np.zeros(shareds)
        kept: list[tuple[int, Any, Floats, Floats]] = []
        errors, cost, cells = [], 0.0, 0.0
        sums = np.zeros((2, *self.weight.shape))
        for number in self.poses.tolist():
            residual, jacobian, active = self._linear(bodies, number)
            shown()
            if not active.any():
                kept.append((number, np.zeros((locals_, size)), np.zeros(locals_), 0.0 * towards))
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
            kept.append((number, normal[:locals_], right[:locals_], right[locals_:]))
        self.error_db.append(float(np.mean(errors)) if errors else math.inf)
        shared = self._solve(kept, total, towards, cost / max(cells, 1.0) * self.dependent)
        self._move_all(shared)
        if shareds:
            self._go_on(shared)
        usual = sums[0] / np.maximum(sums[1], 1.0)
        usual = np.where(sums[1] > 0.0, usual, usual.max())
        power = np.maximum(usual, 0.25 * np.median(usual)) ** -TRUST
        self.weight = power / power.mean()
        return self.error_db[-1]

    def _level(self, body: StillSurface) -> Floats:
        """Return how much louder the receivers are than the surface's echoes, (E,) logarithms."""
        energy = np.zeros((2, self.optics.ears))
        for number in self.poses[:: max(len(self.poses) // LEVEL_POSES, 1)].tolist():
            pose = slice(number, number + 1)
            at = self.echoes.positions[pose], self.echoes.rotations[pose]
            rendered = body.render(*at)[0]
            for row, magnitude in enumerate((self.echoes.magnitude(number).numpy(), rendered)):
                energy[row] += np.square(magnitude, dtype=np.float64).sum(axis=(1, 2))
        return np.asarray(np.log(np.maximum(energy[0], 1e-300) / np.maximum(energy[1], 1e-300)) / 2)

    def _solve(
        self,
        kept: list[tuple[int, Any, Floats, Floats]],
        total: Floats,
        towards: Floats,
        noise: float,
    ) -> Floats:
        """Solve the normal equations, move the poses, and learn spreads and uncertainties.

        Returns:
            shared (S,): Step of the shared errors.
        """
        locals_ = len(self.local)
        prior = np.diag([noise / self.spread[column.name] ** 2 for column in self.local])
        reduced, right = total.copy(), towards.copy()
        inverses: list[tuple[Floats, Floats, Floats]] = []
        self.deviation = {}
        for _, normal, own, _slope in kept:
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
        for (number, *_), (inverse, cross, now) in zip(kept, inverses, strict=True):
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
        spread = covariance @ self._scatter(kept, inverses) @ covariance
        for column, variance, grouped in zip(
            self.shared, np.diag(covariance), np.diag(spread), strict=True
        ):
            deviation = math.sqrt(max(noise * float(variance), float(grouped), 0.0))
            self.deviation[column.name] = max(self.deviation.get(column.name, 0.0), deviation)
        return shared

    def _scatter(
        self,
        kept: list[tuple[int, Any, Floats, Floats]],
        inverses: list[tuple[Floats, Floats, Floats]],
    ) -> Floats:
        """Return the covariance of the sums of slopes over groups of neighbouring poses, (S, S).

        What a surface does not explain is alike at poses that are neighbours, so that their cells
        are no independent measurements.
        """
        numbers = np.array([each[0] for each in kept])
        away = self.echoes.positions[numbers] - self.mesh.centroid
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        group = (away @ fibonacci_sphere(GROUPS).T).argmax(axis=1)
        sums = np.zeros((GROUPS, len(self.shared)))
        for index, ((_, _, _, slope), (inverse, cross, now)) in enumerate(
            zip(kept, inverses, strict=True)
        ):
            sums[group[index]] += slope - cross.T @ inverse @ now
        sums = sums[np.unique(group)]
        sums -= sums.mean(axis=0)
        return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))

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
        changed: dict[str, float] = {}
        most = LARGEST_STEP * self.optics.head.resolution
        for column, value in zip(self.shared, step.tolist(), strict=True):
            if column.name == "gain":
                self.found.gain[column.axis] += value
            elif column.name in ("layer", "scale"):
                setattr(self, column.name, getattr(self, column.name) + value)
            elif column.name == "speed_of_sound":
                changed[column.name] = self.found.speed_of_sound + value
            else:
                bound = most if column.name != "beam_radius" else 10.0 * column.step
                moved = min(max(value, -bound), bound)
                changed[column.name] = getattr(self.found, column.name) + moved
        for name, value in changed.items():
            self.found = replace(self.found, **{name: value})  # type: ignore[arg-type]

    def _go_on(self, step: Floats) -> None:
        """Repeat a step, each time doubled, as long as the error falls."""
        best, moved, doubled = self.error(), 1.0, 1.0
        for _ in range(FARTHER):
            self.stretch = max(self.stretch, moved)
            before = (self.found, self.found.gain.copy(), self.layer, self.scale)
            self._move_all(step)
            error = self.error()
            if error >= best:
                self.found, gain, self.layer, self.scale = before
                self.found.gain[:] = gain
                return
            moved += doubled
            best, step, doubled = error, 2.0 * step, 2.0 * doubled

    def error(self) -> float:
        """Return the absolute difference of some poses over active cells, dB per measured one."""
        body = self._bodies([])
        chosen = self.poses[:: max(len(self.poses) // LEVEL_POSES, 1)].tolist()
        total, count = 0.0, 0
        if not self.error_db and not self.echoes.calibrated:
            self.found.gain[:] = self._level(body[""])
        for number in chosen:
            residual, measured, active = self._linear(body, number, slopes=False)
            total += float(np.abs(residual[active]).sum())
            count += int((measured >= ACTIVE_DB).sum())
        return total / count if count else math.inf

    def _optics_of(self, beam_radius: float) -> Optics:
        """Return the optics of a head whose emitter is larger, m."""
        if beam_radius not in self._optics:
            head = changed_head(self.optics.head, beam_radius=beam_radius)
            self._optics[beam_radius] = Optics(head)
        return self._optics[beam_radius]

    def _bodies(self, unknowns: list[_Column]) -> dict[str, StillSurface]:
        """Return the surface as it is, and changed as unknowns of surface and head do."""
        normals = np.array(self.mesh.vertex_normals)
        middle, found = self.mesh.centroid, self.found
        self._optics = {0.0: self.optics}  # those of the step before go

        def changed(layer: float, scale: float, beam_radius: float) -> StillSurface:
            places = (self.mesh.vertices - middle) * math.exp(scale) + middle + layer * normals
            return StillSurface(
                trimesh.Trimesh(places, self.mesh.faces, process=False),
                self._optics_of(beam_radius),
            )

        at = {"layer": self.layer, "scale": self.scale, "beam_radius": found.beam_radius}
        bodies = {"": changed(**at)}
        for column in unknowns:
            if column.name in at:
                moved = {**at, column.name: at[column.name] + column.step}
                bodies[column.name] = changed(**moved)
        return bodies

    def _linear(
        self, bodies: dict[str, StillSurface], number: int, *, slopes: bool = True
    ) -> tuple[Floats, Floats, Floats]:
        """Return residual (E, R, F) dB, derivatives (U, E, R, F) and active cells of a pose.

        Without ``slopes`` what was measured (E, R, F) stands in their place.
        """
        unknowns = [*self.local, *self.shared] if slopes else []
        found = self.found
        position = self.echoes.positions[number] + found.position[number]
        turned = Rotation.from_rotvec(found.aim[number]).as_matrix()
        rotation = turned @ self.echoes.rotations[number]
        positions, rotations, stretch, late = [position], [rotation], [0.0], [0.0]
        for column in unknowns:
            if column.name in ("gain", "layer", "scale", "beam_radius"):
                continue
            along = np.eye(3)[column.axis] * column.step
            moved = along if column.name == "position" else np.zeros(3)
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
        for column in unknowns:
            if column.name == "gain":
                slope = -_DB * np.expm1(-b / _DB)
                slope[np.arange(len(slope)) != column.axis] = 0.0
            elif column.name in ("layer", "scale", "beam_radius"):
                body = bodies[column.name].render(*(np.asarray(part) for part in one))[0]
                slope = (compressed(body) - b) / column.step
            else:
                slope = (compressed(next(after)) - b) / column.step
            columns.append(slope)
        active = (a >= ACTIVE_DB) | (b >= ACTIVE_DB)
        return a - b, np.stack(columns) if slopes else a, active

    def result(self) -> Estimate:
        """Return what was found so far."""
        names = {"layer", "scale"}
        shared = {column.name for column in self.shared}
        known = {
            name: value * (self.stretch if name in shared else 1.0)
            for name, value in self.deviation.items()
            if name not in names
        }
        return Estimate(self.found, known, list(self.error_db))
