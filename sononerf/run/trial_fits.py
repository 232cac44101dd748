# SPDX-License-Identifier: MIT
"""Errors of a recording that bend the fitted surface, found by whole fits at trial values.

The radius of a turntable is one: for each radius there is a body with the same first echoes. A
surface that was fitted to a wrong radius explains the echoes nearly as well, and derivatives at
that surface do not show the error. Whole fits do: the best surface of the right radius has the
least error on the validation poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from sononerf.errors import InputError, NumericalError
from sononerf.progress import Progress
from sononerf.run.fit import fit
from sononerf.run.reconstruct import reconstruct
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import HEAD_SECTIONS, Settings
from sononerf.surface.refine.support_search import least

MOST = 9
"""Number of values, at most, that are tried: each costs a fit."""
OF_SOURCE = ("scene", "poses", "simulation", "data", "evaluation", *HEAD_SECTIONS)
"""Sections of a run's settings that do not belong to a fit of another store."""


def least_error(error_at: Callable[[int], float]) -> tuple[float, float]:
    """Return where the error is least, by a parabola through the least value and its neighbours.

    Args:
        error_at: Error at a whole number of steps from the stated value; infinite where there is no
            surface. It is evaluated at -1, 0 and 1 and then on the side that is better.
    """
    errors = {step: error_at(step) for step in (0, -1, 1)}
    while True:
        steps = sorted(errors)
        best = min(steps, key=lambda step: errors[step])
        if not math.isfinite(errors[best]):
            raise NumericalError("no surface at any of the values that were tried")
        if best not in (steps[0], steps[-1]) or len(steps) >= MOST:
            break
        further = best + (1 if best > 0 else -1)
        errors[further] = error_at(further)
    if best in (steps[0], steps[-1]):
        return float(best), math.inf
    at = best - 1 + least([errors[best + side] for side in (-1, 0, 1)])
    return at, 1.0 / math.sqrt(12.0)


def fitted_error(settings: Settings, store: Path, run: Path, progress: Progress) -> float:
    """Return the error of a store's refined surface on its validation poses, dB."""
    plain = {name: part for name, part in settings.plain().items() if name not in OF_SOURCE}
    plain["reconstruction"]["refine"] = True
    plain["data"] = {"store": str(store)}
    made = fit(validate_settings(plain, str(run)), run, progress=progress)
    try:
        if not made.is_done("surface"):
            reconstruct(made, progress=progress)
    except NumericalError as error:
        progress.say(f"{run}: {error}")
        return math.inf
    found = made.read_out["validation_error_db"]
    if found is None:
        raise InputError(f"{run}: its surface was not refined; see what the fit says")
    return float(found)
