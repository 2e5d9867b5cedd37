"""The drawings, one function each: plain arrays in, one encoded :class:`~rille.pipeline.report.canvas.Panel` out.

Maps have metres on both axes, row 0 at the greatest y; images have row 0 on top. What is undefined is clear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from rille.pipeline.report import canvas
from rille.pipeline.report.canvas import Panel
from rille.stages.core.arrays import Floats

Extent = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max, m."""

MAX_MARKERS = 80
"""Frames of a curve above which no frame has a marker of its own: they would touch."""


def metres_or_mm(values: Floats) -> tuple[float, str]:
    """Factor and unit that suit lengths in metres: mm where nearly all are below 0.2 m."""
    finite = np.abs(canvas.sample(values))
    return (1000.0, "mm") if finite.size and float(np.percentile(finite, 98)) < 0.2 else (1.0, "m")


@dataclass(frozen=True)
class Curve:
    """One line of a plot: its name in the legend, its colour, its values (x,), NaN gaps."""

    name: str
    color: str
    values: Floats


@dataclass(frozen=True)
class Plot:
    """Curves over one y axis; ``limit`` is drawn as a dotted line. ``metres``: the axis says m, or mm."""

    label: str
    curves: tuple[Curve, ...]
    limit: float | None = None
    metres: bool = False


def curves(x: Sequence[int], plots: Sequence[Plot], label: str, alt: str, *, marked: Sequence[int] = ()) -> Panel:
    """Plots below each other over the numbers ``x`` of frames; ``marked`` ones have a red line."""
    fig, axes = canvas.sheet(len(plots), height=0.36)
    for ax, plot in zip(axes, plots, strict=True):
        factor, unit = metres_or_mm(np.concatenate([c.values for c in plot.curves])) if plot.metres else (1.0, "")
        for curve in plot.curves:
            marker = "." if len(x) <= MAX_MARKERS else ""
            ax.plot(x, curve.values * factor, marker=marker, color=curve.color, linewidth=1.2, label=curve.name)
        if plot.limit is not None:
            ax.axhline(plot.limit * factor, color=canvas.HAZARDOUS, linewidth=1, linestyle=":")
        ax.vlines(marked, 0, 1, color=canvas.HAZARDOUS, linewidth=1, alpha=0.5, transform=ax.get_xaxis_transform())
        ax.set_ylabel(f"{plot.label}, {unit}" if unit else plot.label)
        ax.xaxis.get_major_locator().set_params(integer=True)
        if len(plot.curves) > 1:
            ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    axes[-1].set_xlabel(label)
    return canvas.encode(fig, alt)


def trajectory(tracks: Sequence[Curve], flagged: Floats, alt: str) -> Panel:
    """Positions (frame, 3), m, seen from above, one curve each; ``flagged`` (n, 3) ones have a ring."""
    fig, (ax,) = canvas.sheet(height=0.85)
    for track in tracks:
        marker = "." if len(track.values) <= MAX_MARKERS else ""
        ax.plot(*track.values.T[:2], marker=marker, color=track.color, linewidth=1.4, label=track.name)
    if len(flagged):
        ring = {"markerfacecolor": "none", "markeredgecolor": canvas.HAZARDOUS, "markersize": 8, "linewidth": 0}
        ax.plot(*flagged.T[:2], "o", label="flagged", **ring)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x, m", ylabel="y, m")
    ax.legend()
    return canvas.encode(fig, alt)


def raster(values: Floats, label: str, alt: str, *, extent: Extent | None = None, bound: float | None = None) -> Panel:
    """Values (row, col) in colours with their scale; NaN is clear.

    ``extent``: where it lies, m; None for an image. ``bound``: the scale is symmetric about zero and ends there.
    """
    fig, (ax,) = canvas.sheet(height=min(values.shape[0] / values.shape[1], 1.3) + 0.2)
    low, high = canvas.limits(values) if bound is None else (-bound, bound)
    colors = "viridis" if bound is None else "PuOr"
    drawn = ax.imshow(values, extent=extent, cmap=colors, vmin=low, vmax=high)
    ax.grid(visible=False)
    if extent is None:
        ax.set_axis_off()
    else:
        ax.set(xlabel="x, m", ylabel="y, m")
    fig.colorbar(drawn, ax=ax, location="bottom", label=label)
    return canvas.encode(fig, alt, photo=True)


def medians(points: Floats, values: Floats, size: tuple[int, int]) -> Floats:
    """Medians (row, col) of values (n,) at points (n, 2) column, row, in cells of an image of ``size`` (cols, rows)."""
    # Residuals are averaged in 24 cells along the longer side.
    cols, rows = (max(1, round(24 * n / max(size))) for n in size)
    col, row = (np.clip(points / size, 0, 1 - 1e-9) * (cols, rows)).astype(int).T
    cells, at = np.full(rows * cols, np.nan), row * cols + col
    if len(at):
        filled = np.unique(at)
        cells[filled] = scipy.ndimage.median(values, at, filled)
    return cells.reshape(rows, cols)
