# SPDX-License-Identifier: MIT
"""How far the simulator is from solutions of the wave equation, and what it puts before an echo."""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

BANDS = ((10e3, 25e3), (25e3, 41e3), (41e3, 80e3))
WITHIN = 20.0  # dB below the loudest cell of a pose
LOUD = 15.0  # dB below it, where an echo counts as loud
EARLY = (0.012, 0.070)  # m before the first loud range
NEAR = 0.010  # m before the nearest point of the scene

Magnitude = NDArray[np.float64]


def exact(arguments: argparse.Namespace) -> str:
    """Compare the simulator with frozen solutions of the wave equation, by band."""
    from sononerf.run.simulate import simulator_of
    from sononerf.settings.loading import validate_settings
    from tests.simulation import judges

    lines = ["| body | engine | 10 to 25 kHz, dB (bias) | 25 to 41 | 41 to 80 | before, dB |"]
    lines.append("|---|---|---|---|---|---|")
    for name in arguments.bodies:
        small = name != "three_spheres"
        spectrogram = judges.SMALL if small else {"frequency_max": 80e3}
        case = judges.Case.load(name)
        for engine in arguments.engines:
            plain = {"scene": {"name": "sphere"}, "spectrogram": spectrogram}
            plain["simulation"] = {"engine": engine, "rays": arguments.rays}
            settings = validate_settings(plain, "benchmark exact")
            simulator = simulator_of(judges.scene_of(name), settings)
            head = simulator.head
            truth = case.spectrograms(head)
            found = judges.heard(simulator, case, band=judges.banded if small else None)
            nearest = np.stack(
                [
                    simulator.arrival.shortest(emitter[None], ears[None])[0] / 2.0
                    for emitter, ears in (
                        simulator.hearing.places(*pose)
                        for pose in zip(case.position, case.rotation, strict=True)
                    )
                ]
            )
            early = "" if small else f"{before(found, truth, head.range, nearest):.2f}"
            parts = [
                f"{mean:.2f} ({bias:+.2f})" for mean, bias in errors(found, truth, head.frequency)
            ]
            parts += [""] * (len(BANDS) - len(parts))
            lines.append(f"| {name} | {engine} | {' | '.join(parts)} | {early} |")
    return "\n".join(lines)


def before(
    magnitude: Magnitude, truth: Magnitude, distance: Magnitude, nearest: Magnitude
) -> float:
    """Return the highest level above m0 before the first loud echo, or the nearest point, dB.

    Args:
        magnitude (P, E, R, F): Linear.
        truth: True magnitude, likewise; its greatest is 60 dB above m0.
        distance ((R,), m): Range axis.
        nearest ((P, E), m): Half of the shortest way over the scene.
    """
    from sononerf.head.front_end import compress

    worst, reference = 0.0, 1e-3 * float(truth.max())
    for level, ends in zip(compress(magnitude, reference), nearest, strict=True):
        decibels = 20.0 * np.log10(np.expm1(level * np.log(10.0) / 20.0) + 1e-12)
        first = distance[(decibels > decibels.max() - LOUD).any(axis=(0, 2)).argmax()]
        early = (distance > first - EARLY[1]) & (distance < first - EARLY[0])
        worst = max(worst, float(level[:, early].max(initial=0.0)))
        for ear, end in zip(level, ends, strict=True):
            worst = max(worst, float(ear[distance < end - NEAR].max(initial=0.0)))
    return worst


def errors(found: Magnitude, truth: Magnitude, frequency: Magnitude) -> list[tuple[float, float]]:
    """Return mean error and bias, dB, of the cells near each pose's loudest, by band."""
    from sononerf.head.front_end import compress

    reference = 1e-3 * float(truth.max())
    error = compress(found, reference) - compress(truth, reference)
    near = truth > truth.max(axis=(1, 2, 3), keepdims=True) * 10 ** (-WITHIN / 20.0)
    step = frequency[1] - frequency[0]
    rows = []
    for low, high in BANDS:
        cells = near & (frequency >= low - step / 2) & (frequency < high)
        if cells.any():
            rows.append((float(np.abs(error[cells]).mean()), float(error[cells].mean())))
    return rows
