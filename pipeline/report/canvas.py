"""Parts of a figure of the page (panels, legend), ranges of what is drawn, and how a drawing becomes a panel.

One style serves by day and by night: the ground is clear, and where the reader's theme is dark the page turns the
lightness of drawings round (``.panels`` in ``template.html``), hues stay. Curves are SVG, sharp on any screen; what
holds a raster is WebP. Matplotlib lays out, and is imported when the first figure is drawn.
"""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor
from pydantic import TypeAdapter

from rille.pipeline.export.rasters import CLASSES
from rille.stages.core.declare import AnyArray
from rille.stages.numeric.robust import mad_sigma

WIDTH_INCHES = 4.6
PIXELS_PER_INCH = 200
"""Resolution of rasters: twice what a panel takes on the screen."""
RISK = SAFE, CAUTION, HAZARDOUS, UNKNOWN = tuple(CLASSES.values())
"""Colours of the classes 0, 1, 2 and 3."""
CLASS_NAMES = ("safe", "caution", "hazard", "unknown")
ESTIMATE, REFERENCE, OTHER, INK, MARK = "#0b4f8a", "#d1731a", "#2c8a5b", "#333333", "#111111"
"""Our estimate, the truth, another answer, what is predicted, and what is laid on a map."""
ON_MAP, TRUE_ON_MAP = "#124f90", "#d9781e"
"""Estimate and truth on a map."""


@dataclass(frozen=True)
class Panel:
    """One encoded image: ``uri`` is a ``data:`` address, ``width`` and ``height`` are CSS pixels.

    ``frame``: the stop that it shows, -1 for pictures of something else.
    """

    uri: str
    alt: str
    width: int
    height: int
    frame: int = -1


@dataclass(frozen=True)
class Block:
    """What is drawn of one figure; title, caption and tables are written by the page around it.

    ``legend``: pairs of ``(colour, words)``. ``data``: what the page's script draws in place of the panels, as plain
    JSON.
    """

    panels: tuple[Panel, ...]
    legend: tuple[tuple[str, str], ...] = ()
    data: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Figure:
    """Outcome of a figure: its block, none if the run has no such figure, and why it could not be drawn.

    ``title`` names it in the template and in the list of what is missing.
    """

    title: str
    block: Block | None = None
    why: str = ""


FIGURE = TypeAdapter(Figure)
"""Reads and writes a figure as JSON."""


@cache
def _style() -> None:
    """Set fonts and colours, once: matplotlib's settings belong to all threads."""
    import matplotlib

    matplotlib.rcParams.update(
        {
            "font.size": 9,
            "font.family": ["DejaVu Sans"],
            "svg.fonttype": "none",  # letters stay letters, in the reader's font where this one is not there
            # Without it matplotlib draws random ids, and equal figures would be unequal files.
            "svg.hashsalt": "rille",
            "figure.facecolor": "none",
            "axes.facecolor": "none",
            "axes.grid": True,
            "axes.axisbelow": True,
            "axes.edgecolor": "#777777",
            "grid.color": "#8884",
            "legend.fontsize": "small",
            "legend.facecolor": "none",
        }
    )


def sheet(rows: int = 1, *, height: float) -> tuple[Any, list[Any]]:
    """Figure with ``rows`` axes below each other, one x axis for all; ``height`` of each in widths of a panel."""
    # Not pyplot, which keeps every figure alive and looks for a display.
    from matplotlib.figure import Figure as Sheet

    _style()
    fig = Sheet(figsize=(WIDTH_INCHES, rows * height * WIDTH_INCHES), layout="constrained")
    return fig, list(fig.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])


def encode(fig: Any, alt: str, *, photo: bool = False) -> Panel:
    """Figure as a panel: SVG, or WebP where it holds a raster (``photo``)."""
    out = io.BytesIO()
    if photo:
        fig.savefig(out, format="webp", dpi=PIXELS_PER_INCH, pil_kwargs={"quality": 85})
        inches = [n / PIXELS_PER_INCH for n in Image.open(out).size]
    else:
        # No date and no version of matplotlib in it: equal figures make equal files.
        fig.savefig(out, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
        box = re.search(rb'viewBox="0 0 ([0-9.]+) ([0-9.]+)"', out.getvalue())
        assert box is not None
        inches = [float(points) / 72 for points in box.groups()]
    # CSS has 96 pixels an inch.
    width, height = (round(96 * n) for n in inches)
    return Panel(address(out.getvalue(), "webp" if photo else "svg+xml"), alt, width, height)


def address(content: bytes, kind: str) -> str:
    """``data:`` address of a picture of this kind."""
    return f"data:image/{kind};base64," + base64.b64encode(content).decode("ascii")


def compressed(picture: Any, kind: str, **options: Any) -> str:
    """``data:`` address of a picture of Pillow; ``options`` of its writer of that kind."""
    out = io.BytesIO()
    picture.save(out, kind, **options)
    return address(out.getvalue(), kind)


@cache
def ramp() -> NDArray[np.uint8]:
    """The 256 colours (256, 3) of values from low to high."""
    import matplotlib

    return np.asarray(np.rint(255 * matplotlib.colormaps["viridis"](np.arange(256))[:, :3]), dtype=np.uint8)


def paint(classes: NDArray[np.uint8], *colors: str) -> NDArray[np.uint8]:
    """Colours (row, col, 3) of classes 0, 1, 2 ..."""
    table = np.array([ImageColor.getrgb(c) for c in colors], dtype=np.uint8)
    return np.asarray(table[np.minimum(classes, len(colors) - 1)])


# -- ranges of values: robust, so that few outliers do not take all the contrast of a raster ------------------------


def sample(values: AnyArray) -> AnyArray:
    """Finite values, about fifty thousand of them, evenly spread: enough for a percentile."""
    step = max(1, math.isqrt(values.size // 50_000)) if values.ndim == 2 else 1
    part = values[::step, ::step] if step > 1 else values
    finite = part[np.isfinite(part)]
    # Where little is known the grid may miss most of it, and few values tell little of a median: all are looked at.
    return finite if finite.size >= 100 or step == 1 else values[np.isfinite(values)]


def limits(values: AnyArray, low: float = 2.0, high: float = 98.0) -> tuple[float, float]:
    """Robust range of the finite values: percentiles, never empty."""
    finite = sample(values)
    if finite.size == 0:
        return 0.0, 1.0
    a, b = (float(v) for v in np.percentile(finite, [low, high]))
    pad = 1e-6 * max(abs(a), abs(b), 1e-6)
    return (a, b) if b - a > pad else (a - 10 * pad, b + 10 * pad)


def ground_limits(elevation: AnyArray) -> tuple[float, float]:
    """Range of elevations that shows the ground where crowns and walls rise above it: five robust deviations."""
    finite = sample(elevation)
    low, high = limits(elevation)
    if finite.size == 0:
        return low, high
    middle = float(np.median(finite))
    # Where more than half of the cells are equal the deviation is 0, and the range must not be.
    reach = max(5 * mad_sigma(finite), 1e-3 * (high - low))
    return max(low, middle - reach), min(high, middle + reach)


def spread(values: Any) -> str:
    """``low to high`` of nearly all values, for alternative texts."""
    finite = sample(np.asarray(values))
    if not finite.size:
        return "nothing defined"
    low, high = np.percentile(finite, [1, 99])
    return f"{low:.3g} to {high:.3g}"
