# SPDX-License-Identifier: MIT
"""Curves of a fit: errors over steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sononerf.report.pictures.figure import PictureFormat, figure, picture_bytes


def curves_picture(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    *,
    floors: Mapping[str, float] | None = None,
    kind: PictureFormat = "png",
) -> bytes:
    """Draw errors over steps on a logarithmic axis."""
    with figure(6.4, 3.4, 130) as drawn:
        axes = drawn.subplots()
        for number, (name, (steps, errors)) in enumerate(curves.items()):
            axes.plot(steps, errors, "o-", markersize=2.5, color=f"C{number}", label=name)
        for number, (name, floor) in enumerate((floors or {}).items()):
            axes.axhline(floor, linestyle="--", linewidth=1, color=f"C{number}", label=name)
        axes.set_yscale("log")
        axes.set_xlabel("step")
        axes.set_ylabel("error on validation poses (dB)")
        axes.grid(which="both", linewidth=0.3, alpha=0.6)
        axes.legend(fontsize=8)
        return picture_bytes(drawn, kind)
