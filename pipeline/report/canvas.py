"""Parts of a figure (panels, legend, table), and how a panel is drawn: axes, colours, units, limits, encoding.

Matplotlib is imported when the first figure is drawn. Axes have a known size, so no layout pass is needed. Every panel
is one image, so panels stand beside each other on a wide screen and below each other on a phone. Drawings are SVG,
sharp on any screen; their background is transparent, and their colours follow the reader's theme (``DARK``).
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
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from rille.pipeline.export import ranges
from rille.pipeline.export.rasters import CLASSES

Image = NDArray[Any]
Extent = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max."""

DPI = 240
WIDTH = 4.6
"""Inches; 1104 pixels, twice what a panel takes on the screen."""
MOST_MARKERS = 400
"""Markers or bars of a figure: 4.6 inches have no room for more."""
MAX_PIXELS = 700
"""Longest side of an array that is drawn; larger ones are averaged first."""
UNDEFINED = "#e9e9ec"
RISK = SAFE, CAUTION, HAZARDOUS, UNKNOWN = tuple(CLASSES.values())
"""Colours of the classes 0, 1, 2 and 3."""
MEASURED, INTERPOLATED = "#2f6f9f", "#f0b84a"
ESTIMATE, REFERENCE, MARK = "#0b4f8a", "#d1731a", "#111111"
OTHER, RIGHT = "#2c8a5b", "#333333"
"""Another program's answer, the right camera."""
INK, PAPER = "#1d1f24", "#fffffe"
ON_MAP, TRUE_ON_MAP = "#124f90", "#d9781e"
"""Estimate and truth on a map: maps have the same colours by day and by night."""
DARK = {
    INK: "#e6e4df",
    PAPER: "#1d2026",
    "#333333": "#d8d6d1",
    "#444444": "#b9bcc3",
    "#555555": "#8b9099",
    "#dddddd": "#383c45",
    UNDEFINED: "#2b2f37",
    ESTIMATE: "#7db7ea",
    REFERENCE: "#f0a050",
    OTHER: "#6cc79b",
}
"""What a dark theme puts in the place of a colour of a drawing and its legend."""


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

    @property
    def size(self) -> int:
        """Characters it takes in the page."""
        return len(self.uri)


@dataclass(frozen=True)
class Table:
    """Rows of words under ``head``; columns whose index is in ``numbers`` are set flush right."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: tuple[int, ...] = ()


@dataclass(frozen=True)
class Block:
    """One figure: panels side by side under a title, what one sees, a legend of ``(colour, words)`` and a table.

    ``strip``: the panels are narrow columns. ``data``: what the page's script draws in their place, as plain JSON.
    ``how``: how to read it, folded below a caption that is short.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    legend: tuple[tuple[str, str], ...] = ()
    table: Table | None = None
    strip: bool = False
    data: Mapping[str, Any] | None = None
    how: str = ""

    @property
    def anchor(self) -> str:
        """Anchor of the block in the page."""
        return self.name.lower().replace(" ", "-")


@dataclass(frozen=True)
class Figure:
    """Outcome of a figure: its block, or the reason why there is none; neither if the run has no such figure.

    ``failed``: drawing it raised an error, so that the run lacks what it could have shown.
    """

    title: str
    block: Block | None = None
    why: str = ""
    failed: bool = False


FIGURE = TypeAdapter(Figure)
"""Reads and writes a figure as JSON."""


@cache
def _style() -> None:
    """Set fonts and colours, once."""
    import matplotlib

    matplotlib.rcParams.update(
        {
            "font.size": 9,
            "font.family": ["DejaVu Sans"],
            "svg.fonttype": "none",  # letters stay letters, in the reader's font where this one is not there
            # Without it matplotlib draws random ids, and equal figures would be unequal files.
            "svg.hashsalt": "rille",
            "text.color": INK,
            "legend.facecolor": PAPER,
            "axes.facecolor": "none",
            "axes.edgecolor": "#555555",
            "axes.linewidth": 0.7,
            "axes.labelcolor": "#333333",
            "xtick.color": "#444444",
            "ytick.color": "#444444",
        }
    )


def figure(width: float, height: float) -> Any:
    """Empty figure, inches."""
    # Not pyplot, which keeps every figure alive and looks for a display.
    from matplotlib.figure import Figure

    _style()
    return Figure(figsize=(width, height), dpi=DPI, facecolor="none")


def map_axes(extent: Extent, *, bar: bool = False, max_height: float = 6.0) -> tuple[Any, Any, Any]:
    """Figure, axes of equal scale (metres), and axes for a colour bar below them (None without ``bar``).

    Maps of one extent are equally large with and without a bar, so that they compare side by side.
    """
    left, right, top, foot = 0.62, 0.15, 0.12, 0.5 + (0.62 if bar else 0.0)
    dx, dy = max(extent[1] - extent[0], 1e-9), max(extent[3] - extent[2], 1e-9)
    width = WIDTH - left - right
    height = width * dy / dx
    if height > max_height:
        width, height = max_height * dx / dy, max_height
    width, height = max(width, 2.0), max(height, 0.9)
    fig_w, fig_h = left + width + right, foot + height + top
    fig = figure(fig_w, fig_h)
    ax = fig.add_axes((left / fig_w, foot / fig_h, width / fig_w, height / fig_h))
    scale = max(dx / width, dy / height)  # metres an inch, the same along both axes
    x, y = 0.5 * (extent[0] + extent[1]), 0.5 * (extent[2] + extent[3])
    ax.set_xlim(x - 0.5 * scale * width, x + 0.5 * scale * width)
    ax.set_ylim(y - 0.5 * scale * height, y + 0.5 * scale * height)
    ax.set_autoscale_on(False)  # what is drawn on it must not move its limits
    ax.locator_params(nbins=6)
    ax.set_xlabel("x, m", labelpad=1)
    ax.set_ylabel("y, m")
    ax.yaxis.set_label_coords(-0.5 / width, 0.5)
    cax = fig.add_axes((left / fig_w, 0.43 / fig_h, width / fig_w, 0.12 / fig_h)) if bar else None
    return fig, ax, cax


def image_axes(shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Figure filled by an image of ``shape`` (rows, cols), axes in pixels, and axes for a colour bar below it."""
    height, foot = WIDTH * shape[0] / shape[1], 0.6
    fig = figure(WIDTH, height + foot)
    total = height + foot
    ax = fig.add_axes((0.0, foot / total, 1.0, height / total))
    ax.set_axis_off()
    return fig, ax, fig.add_axes((0.04, 0.41 / total, 0.92, 0.12 / total))


def color_bar(drawn: Any, cax: Any, label: str) -> None:
    """Colour bar with its unit: a strip of the map's colours, which draws faster than matplotlib's own."""
    from matplotlib.ticker import MaxNLocator

    low, high = drawn.get_clim()
    strip = np.linspace(low, high, 256)[None]
    cax.imshow(
        strip, cmap=drawn.cmap, vmin=low, vmax=high, extent=(low, high, 0, 1), aspect="auto", interpolation="none"
    )
    cax.set_yticks([])
    cax.xaxis.set_major_locator(MaxNLocator(nbins=6))
    cax.set_xlabel(label, labelpad=1)


def color_map(name: str) -> Any:
    """Colour map of matplotlib; what is undefined is clear."""
    import matplotlib

    return matplotlib.colormaps[name].with_extremes(bad="none")


def ramp(name: str) -> NDArray[np.uint8]:
    """The 256 colours (256, 3) of a colour map of matplotlib."""
    import matplotlib

    colors = matplotlib.colormaps[name](np.arange(256))[:, :3]
    return np.asarray(np.rint(255 * colors), dtype=np.uint8)


def scale_bar(ax: Any, extent: Extent) -> None:
    """Bar of a round length near a quarter of the width, at the lower left."""
    length = round_length(0.25 * (extent[1] - extent[0]))
    x = extent[0] + 0.05 * (extent[1] - extent[0])
    y = extent[2] + 0.04 * (extent[3] - extent[2])
    ax.plot([x, x + length], [y, y], color="white", linewidth=5, solid_capstyle="butt", zorder=9)
    ax.plot([x, x + length], [y, y], color=MARK, linewidth=2.5, solid_capstyle="butt", zorder=10)
    words = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    ax.annotate(words, (x, y), (0, 5), textcoords="offset points", fontsize=8, color=MARK, zorder=10, bbox=box)


def round_length(value: float) -> float:
    """Greatest of 1, 2, 5 times a power of ten that is not above ``value``."""
    power: float = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9))


def polyline(ax: Any, points: Image, color: str = MARK) -> None:
    """Line with a white casing, seen on any ground; a ring at its start and a disk at its end."""
    x, y = points[:, 0], points[:, 1]
    ax.plot(x, y, color="white", linewidth=3.6, zorder=6, solid_joinstyle="round")
    ax.plot(x, y, color=color, linewidth=1.8, zorder=7, solid_joinstyle="round")
    ax.plot(x[:1], y[:1], "o", markersize=6, markerfacecolor="white", markeredgecolor=color, zorder=8)
    ax.plot(x[-1:], y[-1:], "o", markersize=6, markerfacecolor=color, markeredgecolor="white", zorder=8)


def shrink(array: Image, limit: int = MAX_PIXELS) -> Image:
    """Average blocks so that no side is above ``limit``; undefined values do not count in an average.

    The array is trimmed to whole blocks (less than one drawn pixel).
    """
    step = max(1, math.ceil(max(array.shape[:2]) / limit))
    if step == 1:
        return np.asarray(array)
    rows, cols = (n // step * step for n in array.shape[:2])
    blocks = np.asarray(array[:rows, :cols], dtype=np.float32)
    blocks = blocks.reshape(rows // step, step, cols // step, step, *array.shape[2:])
    count = np.isfinite(blocks).sum(axis=(1, 3))
    total = np.nansum(blocks, axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def metres_or_mm(values: Image) -> tuple[float, str]:
    """Factor and unit that suit lengths in metres: mm where nearly all are below 0.2 m."""
    finite = np.abs(ranges.sample(values))
    return (1000.0, "mm") if finite.size and float(np.percentile(finite, 98)) < 0.2 else (1.0, "m")


def encode(fig: Any, alt: str, *, photo: bool = False) -> Panel:
    """Figure to a :class:`Panel`: SVG, its pictures with loss where ``photo``."""
    _without_crowds(fig)
    out = io.StringIO()
    # No date, and no version of matplotlib, in it: equal figures make equal files.
    fig.savefig(out, format="svg", dpi=DPI, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = re.sub(r'"data:image/png;base64,([^"]+)"', lambda m: f'"{_smaller(m[1], photo)}"', out.getvalue())
    # Its own rules: a drawing that is shown as an image does not see those of the page.
    text = text[text.index("<svg") :].replace("<defs>", f"<defs><style>{theme()}</style>", 1)
    width, height = (round(96 * inches) for inches in fig.get_size_inches())
    # Escapes, not base64, which takes a third more; a bare "#" would begin a fragment.
    return Panel("data:image/svg+xml," + quote(themed(text), safe=" !$&'()*+,-./:;=?@[]{}|"), alt, width, height)


def _without_crowds(fig: Any) -> None:
    """Draw no more than :data:`MOST_MARKERS` markers or bars one by one: each takes 70 bytes or more of the page."""
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    for bars in fig.findobj(LineCollection):
        bars.set_rasterized(len(bars.get_segments()) > MOST_MARKERS)
    for curve in fig.findobj(Line2D):
        if len(curve.get_xdata()) <= MOST_MARKERS:
            continue
        if curve.get_linestyle() == "None":
            curve.set_rasterized(True)
        else:  # so close together, the line shows where they are
            curve.set_marker("None")


def _smaller(png: str, photo: bool) -> str:
    from PIL import Image as Pillow

    return webp(Pillow.open(io.BytesIO(base64.b64decode(png))), photo)


def webp(picture: Any, photo: bool, quality: int = 82) -> str:
    """Picture as the ``data:`` address of a WebP, with loss where ``photo``."""
    # Without loss, WebP's quality is how hard it tries.
    return address(picture, "webp", lossless=not photo, quality=quality if photo else 60, method=2)


def address(picture: Any, kind: str, **options: Any) -> str:
    """Picture as a ``data:`` address; ``options`` of Pillow's writer of that kind."""
    out = io.BytesIO()
    picture.save(out, kind, **options)
    return f"data:image/{kind};base64," + base64.b64encode(out.getvalue()).decode("ascii")


def themed(text: str) -> str:
    """Text of SVG or CSS with the colours of ``DARK`` by name, so that they follow the theme."""
    for color in DARK:
        text = text.replace(color, f"var(--c{color[1:]})")
    return text


def theme() -> str:
    """Rules of CSS that say the names of :func:`themed` for either theme."""
    light, dark = (
        ":root{" + "".join(f"--c{c[1:]}:{_rgb(shown)};" for c, shown in pairs) + "}"
        for pairs in (((c, c) for c in DARK), DARK.items())
    )
    return f"{light}@media(prefers-color-scheme:dark){{{dark}}}"


def _rgb(color: str) -> str:
    # Not #rrggbb: themed() would replace the colour within its own definition.
    return "rgb({},{},{})".format(*(int(color[k : k + 2], 16) for k in (1, 3, 5)))


def panel(rgb: Image, alt: str, *, photo: bool = False) -> Panel:
    """Picture (row, col, 3) or (row, col) uint8 to a :class:`Panel`, pixel by pixel."""
    from PIL import Image as Pillow

    height, width = rgb.shape[:2]
    return Panel(webp(Pillow.fromarray(rgb), photo), alt, round(width * 96 / DPI), round(height * 96 / DPI))


def fitted(pixels: Image, *, scale: int = 1) -> Image:
    """Picture (row, col) or (row, col, 3) uint8 as wide as a panel (times ``scale``), without axes around it."""
    from PIL import Image as Pillow

    width = scale * round(WIDTH * DPI)
    size = (width, max(1, round(width * pixels.shape[0] / pixels.shape[1])))
    how = Pillow.Resampling.BOX if pixels.shape[1] > width else Pillow.Resampling.BICUBIC
    return np.asarray(Pillow.fromarray(np.ascontiguousarray(pixels)).resize(size, how))
