# SPDX-License-Identifier: MIT
"""Calls by name: the keys of the section ``call`` that a preset fills, and where they come from.

Each number has a publication, or is called typical beside it. Bats change their calls with every
task, so a preset is one call out of a repertoire.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class CallPreset:
    """A call."""

    keys: dict[str, Any]  # Keys of the section ``call``, with their values
    about: str  # One line: whose call, and when it is emitted
    source: str  # Publications, and which numbers are typical values only


CALL_PRESETS = {
    "eptesicus_fuscus": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 2.3e-3,
            "frequency_start": 75e3,
            "frequency_end": 33e3,
            "harmonics": (1.0, 0.5),
        },
        "big brown bat, leaving the roost: two harmonics, the fundamental from 75 to 33 kHz",
        "A. Rodriguez and E. C. Mora, Caribbean Journal of Science 42(1):121-128, 2006: duration, "
        "frequencies, two harmonics. Hyperbolic: R. A. Altes and E. L. Titlebaum, Journal of the "
        "Acoustical Society of America 48:1014-1020, 1970. The second harmonic's amplitude is "
        "typical.",
    ),
    "phyllops_falcatus": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 2e-3,
            "frequency_start": 73e3,
            "frequency_end": 23e3,
            "harmonics": (1.0, 1.0, 0.5),
        },
        "Cuban fig-eating bat, near bushes: three harmonics, the fundamental from 73 to 23 kHz",
        "S. Macias, E. C. Mora, C. Koch and O. von Helversen, Acta Chiropterologica 7(2):275-283, "
        "2005: duration (1 ms or less close to a fruit, 4.5 ms in free flight), frequencies, "
        "harmonics. Hyperbolic, and the harmonics' amplitudes, are typical.",
    ),
    "rhinolophus_fm": CallPreset(
        {"kind": "linear", "duration": 0.87e-3, "frequency_start": 83e3, "frequency_end": 63e3},
        "greater horseshoe bat, the sweep that ends the call; its constant tone tells no range",
        "M. M. Andrews et al., Acta Chiropterologica 8(1):197-212, 2006: 83 kHz. B. Vogler and "
        "G. Neuweiler, Journal of Comparative Physiology A 152:421-432, 1983: 12 to 20 kHz wide. "
        "B. Tian and H.-U. Schnitzler, Journal of the Acoustical Society of America 101:2347-2364, "
        "1997: so short that it does not overlap its echo from 15 cm on, which is 0.87 ms. The "
        "straight sweep is typical.",
    ),
    "sonotracelab": CallPreset(
        {
            "kind": "hyperbolic",
            "duration": 0.4e-3,
            "frequency_start": 150e3,
            "frequency_end": 40e3,
            "taper": 0.1,
        },
        "the sweep in the examples of the simulator SonoTraceLab: from 150 to 40 kHz in 0.4 ms",
        "W. Jansen and J. Steckel, SonoTraceLab, IEEE Access 12, 2024.",
    ),
    "airsas": CallPreset(
        {"kind": "linear", "duration": 1e-3, "frequency_start": 30e3, "frequency_end": 10e3},
        "an in-air synthetic aperture sonar: a straight sweep from 30 to 10 kHz in a millisecond",
        "A. Reed et al., Neural Volumetric Reconstruction for Coherent Synthetic Aperture Sonar, "
        "ACM Transactions on Graphics 42(4), 2023; direction and duration as in the waveform that "
        "its authors publish.",
    ),
}
"""By the name that ``call.preset`` takes."""


def window_of(analysis: dict[str, Any]) -> int:
    """Return the power of two, in samples, that is nearest to 6.4 periods of the highest frequency.

    It gives 64 at 1 MHz for up to 100 kHz.
    """
    if not {"sampling_rate", "frequency_max"} <= analysis.keys():  # another check reports it
        return 64
    periods = 6.4 * analysis["sampling_rate"] / analysis["frequency_max"]
    return int(2 ** max(round(math.log2(periods)), 3))


def hop_of(analysis: dict[str, Any]) -> int:
    """Return a sixteenth of the window that suits the band, in samples."""
    return max(window_of(analysis) // 16, 1)


def fft_of(analysis: dict[str, Any]) -> int:
    """Return eight times the window that suits the band, and more if a longer one is set."""
    longest = max(8 * window_of(analysis), analysis.get("window", 8))
    return int(2 ** math.ceil(math.log2(longest)))
