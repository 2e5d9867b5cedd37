"""Figures with a quantity over frames or pairs, and residuals over the image: plain arrays in, one panel out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rille.pipeline.export.artifacts import Floats
from rille.pipeline.report import canvas
from rille.pipeline.report.canvas import Panel

CELLS = 24
"""Cells along the longer side of the image in which residuals are averaged."""


def stack(heights: Sequence[float], *, foot: float = 0.42, left: float = 0.62) -> tuple[Any, list[Any]]:
    """Figure with axes of the given heights (inches) below each other, one x axis for all."""
    top, gap = 0.1, 0.14
    total = top + sum(heights) + gap * (len(heights) - 1) + foot
    fig, axes, y = canvas.figure(canvas.WIDTH, total), [], total - top
    for i, height in enumerate(heights):
        y -= height
        ax = fig.add_axes((left / canvas.WIDTH, y / total, (canvas.WIDTH - left - 0.12) / canvas.WIDTH, height / total))
        ax.grid(color="#dddddd", linewidth=0.5)
        ax.set_axisbelow(True)
        ax.tick_params(labelbottom=i == len(heights) - 1)
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.yaxis.get_major_locator().set_params(nbins=5)
        ax.yaxis.set_label_coords(-0.5 / (canvas.WIDTH - left - 0.12), 0.5)
        axes.append(ax)
        y -= gap
    return fig, axes


def residual_map(points: Floats, values: Floats, size: tuple[int, int], bound: float, label: str, alt: str) -> Panel:
    """Medians of signed residuals (n,) px in cells of the image; ``size`` (columns, rows), symmetric about zero."""
    cell = max(size) / CELLS
    cols, rows = (max(1, round(n / cell)) for n in size)
    index = np.clip((points[:, 1] * rows / size[1]).astype(int), 0, rows - 1) * cols
    index = index + np.clip((points[:, 0] * cols / size[0]).astype(int), 0, cols - 1)
    order = np.argsort(index, kind="stable")
    found, first = np.unique(index[order], return_index=True)
    grid = np.full(rows * cols, np.nan)
    for at, part in zip(found, np.split(values[order], first[1:]), strict=True):
        grid[at] = np.median(part)
    fig, ax, cax = canvas.image_axes((size[1], size[0]), bar=True)
    colors = canvas.color_map("PuOr")
    drawn = ax.imshow(
        grid.reshape(rows, cols), cmap=colors, vmin=-bound, vmax=bound, aspect="auto", interpolation="nearest"
    )
    canvas.color_bar(drawn, cax, label)
    return canvas.encode(fig, alt)


def histogram(parts: Sequence[tuple[str, str, Floats]], bound: float, label: str, alt: str) -> Panel:
    """Shares of values in narrow classes, those within ``bound`` of zero; ``parts``: name, colour, values (n,)."""
    fig, (ax,) = stack([2.0])
    edges = np.linspace(-bound, bound, 61)
    for name, color, values in parts:
        share = np.histogram(values, edges)[0] / max(len(values), 1)
        ax.stairs(100 * share, edges, color=color, linewidth=1.4, label=name)
    ax.axvline(0, color="#555555", linewidth=0.6)
    ax.set_xlim(-bound, bound)
    ax.set_ylim(bottom=0)
    ax.set_xlabel(label)
    ax.set_ylabel("matches, %")
    ax.legend(fontsize=7.5, framealpha=0.9)
    return canvas.encode(fig, alt)


def drift(
    pairs: Sequence[int],
    values: Mapping[str, Floats],
    sigmas: Mapping[str, Floats],
    used: Mapping[str, float],
    alt: str,
) -> Panel:
    """Corrections (pair,) of each pair's own adjustment with their sigmas, degrees, and what was used for all."""
    fig, axes = stack([1.1] * len(values))
    for ax, (name, value) in zip(axes, values.items(), strict=True):
        ax.vlines(pairs, value - sigmas[name], value + sigmas[name], color=canvas.ESTIMATE, linewidth=0.8)
        ax.plot(pairs, value, "o", color=canvas.ESTIMATE, markersize=3)
        ax.axhline(0, color="#555555", linewidth=0.6)
        if used.get(name):
            ax.axhline(used[name], color=canvas.REFERENCE, linewidth=1.6)
        ax.set_ylabel(name.rsplit("_", 1)[-1] + ", °")
        half = 1.15 * float(np.nanmax(np.abs([*(np.abs(value) + sigmas[name]), used.get(name, 0.0), 0.01])))
        ax.set_ylim(-half, half)
    axes[-1].set_xlabel("basic pair")
    return canvas.encode(fig, alt)


def disagreement(
    frames: Sequence[int],
    curves: Sequence[tuple[str, Sequence[tuple[str, str, Floats]], float | None]],
    flagged: Sequence[int],
    unknown: Sequence[int],
    alt: str,
) -> Panel:
    """Curves over frames below each other.

    ``curves``: label of the axis; name, colour and values (frame,) of each line; limit above which a frame is flagged.
    Flagged frames have a red line, those that the other program has not posed a grey ground.
    """
    fig, axes = stack([1.35] * len(curves))
    for ax, (label, lines, limit) in zip(axes, curves, strict=True):
        for name, color, values in lines:
            ax.plot(frames, values, "-", color=color, linewidth=1.3, label=name, marker="o", markersize=2)
        if limit is not None:
            ax.axhline(limit, color=canvas.HAZARDOUS, linewidth=0.9, linestyle=":")
        for frame in flagged:
            ax.axvline(frame, color=canvas.HAZARDOUS, linewidth=1.0, alpha=0.55, zorder=0)
        for frame in unknown:
            ax.axvspan(frame - 0.5, frame + 0.5, color=canvas.UNDEFINED, linewidth=0, zorder=0)
        ax.set_ylabel(label)
        ax.set_xlim(frames[0] - 0.5, frames[-1] + 0.5)
        ax.set_ylim(bottom=0)
        if len(lines) > 1:
            ax.legend(fontsize=7, framealpha=0.9, loc="upper left")
    axes[-1].set_xlabel("frame")
    return canvas.encode(fig, alt)


def basic_pairs(
    pairs: Sequence[int], overlap: Floats, wanted: float | None, frames: Sequence[int], moved: Floats, alt: str
) -> Panel:
    """Overlap (pair,) of each basic pair with the one before, and the coarse displacement (frame,) between frames."""
    fig, (top, low) = stack([1.35, 1.35])
    top.vlines(pairs, 0, 100 * np.nan_to_num(overlap), color=canvas.ESTIMATE, linewidth=1.0)
    top.plot(pairs, 100 * overlap, "o", color=canvas.ESTIMATE, markersize=4)
    if wanted is not None:
        top.axhline(100 * wanted, color=canvas.REFERENCE, linewidth=1.4)
    top.set_ylim(0, 105)
    top.set_ylabel("overlap, %")
    low.plot(frames, moved, "o-", color="#333333", markersize=2.5, linewidth=0.9)
    for pair in pairs:
        low.axvline(pair, color=canvas.ESTIMATE, linewidth=0.7, alpha=0.5, zorder=0)
    low.set_ylim(bottom=0)
    low.set_ylabel("displacement, px")
    low.set_xlabel("frame")
    for ax in (top, low):
        ax.set_xlim(frames[0] - 1.5, frames[-1] + 0.5)
    return canvas.encode(fig, alt)


def differences(pairs: Sequence[int], median: Floats, deviation: Floats, predicted: Floats, alt: str) -> Panel:
    """Elevation of each model minus that of the one before where both have one: median, deviation, what is expected."""
    factor, unit = canvas.metres_or_mm(np.concatenate([np.abs(median), deviation]))
    fig, (ax,) = stack([2.1])
    ax.fill_between(pairs, 0, deviation * factor, color=canvas.INTERPOLATED, alpha=0.35, linewidth=0)
    ax.plot(pairs, deviation * factor, "o-", color=canvas.INTERPOLATED, markersize=3, linewidth=1.0, label="deviation")
    ax.plot(pairs, median * factor, "o-", color=canvas.ESTIMATE, markersize=3, linewidth=1.0, label="median")
    ax.plot(pairs, predicted * factor, "--", color="#333333", linewidth=1.0, label="deviation expected from their σ")
    ax.axhline(0, color="#555555", linewidth=0.6)
    ax.set_ylabel(f"difference, {unit}")
    ax.set_xlabel("basic pair")
    ax.legend(fontsize=7, framealpha=0.9)
    return canvas.encode(fig, alt)
