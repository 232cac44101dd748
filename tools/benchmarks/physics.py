# SPDX-License-Identifier: MIT
"""How far engines and analysis are from what is known exactly, by the tests' own yardsticks."""

from __future__ import annotations

import argparse
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray


def physics(_: argparse.Namespace) -> dict[str, Any]:
    """Compare the engines with a sphere's partial waves, and with each other."""
    from sononerf.geometry.poses import look_at
    from sononerf.scene.material import RIGID
    from sononerf.scene.scene import Scene
    from sononerf.simulation.reference.kirchhoff import Kirchhoff
    from tests.simulation.exact import rigid_sphere
    from tests.simulation.listening import ball, delay, echoes, hearing, level_db, rays, spectrum
    from tests.simulation.listening import wall as wall_at

    def heard(engine: Any, distance: float, band: NDArray[np.float64], until: float) -> Any:
        position = np.array([distance, 0.0, 0.0])
        (echo,) = echoes(engine, position, look_at(position, np.zeros(3)))
        return spectrum(echo, band, until=until)

    found: dict[str, Any] = {"kirchhoff_against_partial_waves": [], "rays_against_kirchhoff": []}
    everywhere = hearing()
    band = np.linspace(10e3, 100e3, 181)
    for radius, distance in itertools.product((0.015, 0.0286), (0.3, 0.45)):
        scene = Scene(ball(radius), RIGID)
        engine = Kirchhoff(scene, everywhere, frequency_max=110e3)
        exact = rigid_sphere(band, radius, distance, distance)
        error = level_db(heard(engine, distance, band, np.inf)) - level_db(exact)
        row: dict[str, Any] = {"radius_m": radius, "distance_m": distance}
        ka = 2.0 * np.pi * band * radius / 343.0
        for name, low, high in (("ka_5_to_12", 5, 12), ("ka_12_to_50", 12, 50)):
            part = error[(ka >= low) & (ka < high)]
            row[f"{name}_rms_db"] = float(np.sqrt(np.mean(part**2)))
            row[f"{name}_worst_db"] = float(np.abs(part).max())
        found["kirchhoff_against_partial_waves"].append(row)
    band = np.linspace(20e3, 100e3, 161)
    shapes = [("sphere", ball(radius), radius) for radius in (0.015, 0.0286)]
    shapes.append(("plate", wall_at(0.0, (-0.21, -0.2), (0.19, 0.22)), 0.0))
    for (name, mesh, radius), distance in itertools.product(shapes, (0.3, 0.45)):
        nearest = distance - radius
        # The specular echo alone: what comes from the rims, or creeps round, is later.
        until = nearest + (0.006 if radius == 0.0 else 0.012)
        levels, delays = [], []
        scene = Scene(mesh, RIGID)
        for engine in (
            rays(mesh, RIGID, everywhere, rays=100_000),
            Kirchhoff(scene, everywhere, frequency_max=110e3),
        ):
            pressure = heard(engine, distance, band, until)
            levels.append(level_db(pressure))
            turned = pressure * np.exp(4j * np.pi * band / 343.0 * nearest)
            delays.append(float(delay(turned, band)))
        found["rays_against_kirchhoff"].append(
            {
                "shape": name,
                "radius_m": radius,
                "distance_m": distance,
                "worst_db": float(np.abs(levels[0] - levels[1]).max()),
                "delay_error_mm": 1e3 * delays[0],
                "kirchhoff_delay_error_mm": 1e3 * delays[1],
            }
        )
    return found


def dechirp(_: argparse.Namespace) -> dict[str, Any]:
    """Measure a point echo's rows under sweeps of several lengths, as the tests do."""
    from sononerf.head.reception import best_window, row_duration
    from sononerf.settings.schema import CallSettings
    from tests.head.test_reception import ANALYSIS, HOP, analysis, measured

    rows = []
    for kind, length in itertools.product(("linear", "hyperbolic"), (0.2e-3, 1e-3, 3e-3)):
        call = CallSettings(kind=kind, duration=length)
        for window in (64, best_window(call, ANALYSIS)):
            offset, duration, frequency = measured(call, window)
            allowed = row_duration(call, analysis(window=window), frequency)
            rows.append(
                {
                    "kind": kind,
                    "duration_s": length,
                    "window": window,
                    "best": window != 64,
                    "worst_offset_hops": float(np.abs(offset).max() / HOP),
                    "worst_ratio_of_duration": float((duration / allowed).max()),
                }
            )
    return {"hop_s": HOP, "sweeps": rows}
