# SPDX-License-Identifier: MIT
"""Figures and pixels as PNG files; the same picture gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

STYLE = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so pictures look alike everywhere
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "axes.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "image.interpolation": "nearest",
    "image.origin": "lower",
    "svg.hashsalt": "sononerf",  # the same names of parts each time
}
PictureFormat = Literal["png", "svg", "pdf"]
_UNDATED: dict[PictureFormat, dict[str, None]] = {
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}


def png_from_pixels(pixels: NDArray[np.uint8]) -> bytes:
    """Return pixels (H, W, 3) as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


@contextmanager
def figure(
    width: float,
    height: float,
    dpi: int,
    *,
    layout: Literal["constrained", "compressed"] | None = "constrained",
) -> Iterator[Any]:
    """Open a figure of this size (inches) in our style; draw in the block, then take its pixels.

    Computing a layout takes twice as long as drawing.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(width, height), dpi=dpi, layout=layout, facecolor="white")
        FigureCanvasAgg(drawn)
        yield drawn


def picture_bytes(drawn: Any, kind: PictureFormat = "png") -> bytes:
    """Return a figure as a file: pixels, or lines and letters for a paper (SVG, PDF)."""
    if kind == "png":
        return png_from_pixels(pixels_from_figure(drawn))
    buffer = io.BytesIO()
    drawn.savefig(buffer, format=kind, metadata=_UNDATED[kind])
    return buffer.getvalue()


def pixels_from_figure(drawn: Any) -> NDArray[np.uint8]:
    """Return a figure's pixels, (H, W, 3)."""
    drawn.canvas.draw()
    return np.array(drawn.canvas.buffer_rgba(), dtype=np.uint8)[..., :3]


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
