"""The figures, one function each: plain arrays in, one encoded :class:`~rille.pipeline.report.canvas.Panel` out.

Maps have metres on both axes, row 0 at the greatest y; images have row 0 on top. What is undefined is clear: a
light grey by day, a dark one by night. Large arrays are averaged before drawing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export import ranges
from rille.pipeline.report import canvas
from rille.pipeline.report.canvas import Extent, Panel
from rille.stages.core.validity import defined, matched
from rille.stages.evaluation.crosscheck import grey_bytes
from rille.stages.hazard.risk import HAZARDOUS

Floats = NDArray[Any]
Bytes = NDArray[np.uint8]

CELLS = 24
"""Cells along the longer side of the image in which residuals are averaged."""


def photo(image: Floats, alt: str) -> Panel:
    """A camera image; ``image`` (row, col) grey or (row, col, 3), of 8 or 16 bits or float 0..255."""
    return canvas.panel(canvas.fitted(grey_bytes(image)), alt, photo=True)


def disparity(values: Floats, label: str, alt: str) -> Panel:
    """One component of the disparity (row, col), pixels, NaN undefined, with its colour bar (Figure 6)."""
    fig, ax, cax = canvas.image_axes(values.shape)
    low, high = ranges.limits(values)
    style = {"cmap": canvas.color_map("viridis"), "vmin": low, "vmax": high, "interpolation": "none"}
    drawn = ax.imshow(canvas.shrink(values), aspect="auto", **style)
    canvas.color_bar(drawn, cax, label)
    return canvas.encode(fig, alt, photo=True)


def validity_classes(bits: Bytes) -> Bytes:
    """Classify validity bits (row, col): 0 measured, 1 interpolated, 2 undefined."""
    return np.where(matched(bits), 0, np.where(defined(bits), 1, 2)).astype(np.uint8)


def validity(classes: Bytes, alt: str) -> Panel:
    """Draw which disparities were measured; ``classes`` (row, col) of :func:`validity_classes`."""
    colors = paint(classes, canvas.MEASURED, canvas.INTERPOLATED, canvas.UNDEFINED)
    return canvas.panel(canvas.fitted((255 * colors).round().astype(np.uint8)), alt)


def ortho(grey: Floats, extent: Extent, alt: str) -> Panel:
    """Ortho image (row, col), grey 0..255, NaN clear (Figure 7, left)."""
    fig, ax, _ = canvas.map_axes(extent)
    low, high = ranges.limits(grey, 0.5, 99.5)
    _show(ax, grey, extent, cmap=canvas.color_map("gray"), vmin=low, vmax=high)
    canvas.scale_bar(ax, extent)
    return canvas.encode(fig, alt, photo=True)


def elevation_with_path(elevation: Floats, risk: Bytes | None, path: Floats | None, extent: Extent, alt: str) -> Panel:
    """Elevation (row, col) m, bright is high; unknown and hazardous black; the path on it (Figure 7, right)."""
    blocked = ~np.isfinite(elevation) if risk is None else risk >= HAZARDOUS
    factor, unit = canvas.metres_or_mm(elevation)
    # The grey scale starts well above black, so that black means "not to be driven" only.
    shown = np.where(blocked, np.nan, elevation * factor)
    fig, ax = _scaled_map(shown, extent, _greys(), ranges.ground_limits(shown), f"elevation, {unit}")
    if path is not None:
        canvas.polyline(ax, path, color=canvas.HAZARDOUS)
    canvas.scale_bar(ax, extent)
    return canvas.encode(fig, alt, photo=True)


def risk_map(risk: Bytes, path: Floats | None, extent: Extent, alt: str, *, far: Floats | None = None) -> Panel:
    """Safe, caution, hazardous and unknown cells, the path, and which targets of the far row can be reached.

    ``far`` (n, 3): x, y of a cell of the far row, m, and 1 where a path leads there.
    """
    fig, ax, _ = canvas.map_axes(extent)
    _show(ax, paint(risk, *canvas.RISK), extent)
    if path is not None:
        canvas.polyline(ax, path)
    if far is not None and len(far):
        size = max(2.0, min(12.0, 500.0 / len(far)))
        yes, no = far[far[:, 2] > 0], far[far[:, 2] <= 0]
        ax.scatter(no[:, 0], no[:, 1], s=size, marker="s", color="#3b3b3b", linewidths=0, zorder=5)
        ax.scatter(yes[:, 0], yes[:, 1], s=size, marker="s", color=canvas.ON_MAP, linewidths=0, zorder=5)
    canvas.scale_bar(ax, extent)
    return canvas.encode(fig, alt)


def cost_to_go(cost: Floats, path: Floats | None, extent: Extent, alt: str) -> Panel:
    """Cost (row, col), m, of the best path to each cell; not reachable is grey (Figure 3)."""
    finite = np.where(np.isfinite(cost), cost, np.nan)
    factor, unit = canvas.metres_or_mm(finite)
    bounds = 0, ranges.limits(finite)[1] * factor
    fig, ax = _scaled_map(finite * factor, extent, canvas.color_map("cividis"), bounds, f"cost of the path, {unit}")
    if path is not None:
        canvas.polyline(ax, path)
    return canvas.encode(fig, alt, photo=True)


def tracks(image: Floats, trails: Sequence[Floats], inlier: Sequence[bool], alt: str) -> Panel:
    """One frame with the trails of its landmarks: each (n, 2) column, row, ending in this frame (Figure 8)."""
    from PIL import Image as Pillow
    from PIL import ImageDraw

    fine = 2  # drawn twice as large and averaged, for smooth lines
    ground = canvas.fitted(grey_bytes(image), scale=fine)
    picture = Pillow.fromarray(ground).convert("RGB")
    pen, factor = ImageDraw.Draw(picture), ground.shape[1] / image.shape[1]
    for trail, good in zip(trails, inlier, strict=True):
        color = "#ffd34d" if good else "#ff6a3d"
        # Pixel centres are whole numbers, but scaling keeps the image's corner, half a pixel before the first of them.
        points = [(float(c), float(r)) for c, r in (trail + 0.5) * factor - 0.5]
        pen.line(points, fill=color, width=2 * fine)
        x, y = points[-1]
        size = 2.6 * fine
        pen.ellipse((x - size, y - size, x + size, y + size), fill=color, outline="#222222", width=fine // 2)
    return canvas.panel(np.asarray(picture.reduce(fine)), alt, photo=True)


def trajectory(
    left: Floats,
    right: Floats,
    truth: Floats | None,
    alt: str,
    *,
    other: Floats | None = None,
    flagged: Floats | None = None,
) -> Panel:
    """Top view of left camera positions (n, 3) m, right ones at basic pairs (m, 3), truth (n, 3) (Figure 9, left).

    ``other`` (n, 3): another program's; ``flagged`` (k, 3): positions that are marked.
    """
    everything = np.concatenate([p[:, :2] for p in (left, right, truth, other) if p is not None and len(p)])
    everything = everything[np.isfinite(everything).all(axis=1)]
    centre, span = 0.5 * (everything.min(axis=0) + everything.max(axis=0)), np.ptp(everything, axis=0)
    half = np.maximum(0.5 * span, 0.18 * max(float(span.max()), 1e-3)) * 1.12
    extent = (centre[0] - half[0], centre[0] + half[0], centre[1] - half[1], centre[1] + half[1])
    fig, ax, _ = canvas.map_axes(extent, max_height=5.0)
    if truth is not None:
        ax.plot(truth[:, 0], truth[:, 1], color=canvas.REFERENCE, linewidth=2.6, alpha=0.75)
    if other is not None:
        ax.plot(other[:, 0], other[:, 1], color=canvas.OTHER, linewidth=1.4)
    ax.plot(left[:, 0], left[:, 1], "o-", color=canvas.ESTIMATE, markersize=3, linewidth=0.8)
    if len(right):
        ax.plot(right[:, 0], right[:, 1], "^", color=canvas.RIGHT, markersize=4)
    if flagged is not None and len(flagged):
        ring = {"markerfacecolor": "none", "markeredgecolor": canvas.HAZARDOUS, "markersize": 8, "linewidth": 0}
        ax.plot(flagged[:, 0], flagged[:, 1], "o", **ring)
    ax.grid(color="#dddddd", linewidth=0.5)
    ax.set_axisbelow(True)
    return canvas.encode(fig, alt)


def displacements(estimate: Floats, truth: Floats | None, names: Sequence[int], alt: str) -> Panel:
    """x, y, z components (n - 1, 3), m, of the displacement between successive positions (Figure 9, right)."""
    factor, unit = canvas.metres_or_mm(estimate)
    fig = canvas.figure(canvas.WIDTH, 4.9)
    for i, axis in enumerate("xyz"):
        ax = fig.add_axes((0.15, 0.70 - 0.295 * i, 0.82, 0.27))
        if truth is not None:
            ax.plot(names, truth[:, i] * factor, color=canvas.REFERENCE, linewidth=2.2, alpha=0.75, label="truth")
        ax.plot(
            names, estimate[:, i] * factor, "o-", color=canvas.ESTIMATE, markersize=3, linewidth=0.8, label="estimate"
        )
        ax.set_ylabel(f"{axis}, {unit}", labelpad=2)
        ax.grid(color="#dddddd", linewidth=0.5)
        ax.tick_params(labelbottom=i == 2)
        ax.xaxis.get_major_locator().set_params(integer=True)
        _not_narrower(ax, 0.02 * factor * float(np.nanmax(np.abs(estimate), initial=1e-6)))
        if i == 0:
            ax.legend(fontsize=7.5, loc="upper right", framealpha=0.9, ncols=2)
    ax.set_xlabel("frame reached")
    return canvas.encode(fig, alt)


def scalar_map(values: Floats, extent: Extent, label: str, alt: str) -> Panel:
    """A measured length (row, col), m, shown in mm where that fits; the unit is added."""
    factor, unit = canvas.metres_or_mm(values)
    low, high = (v * factor for v in ranges.limits(values))
    colors = canvas.color_map("viridis")
    fig, _ = _scaled_map(values * factor, extent, colors, (min(low, 0.0), high), f"{label}, {unit}")
    return canvas.encode(fig, alt, photo=True)


def error_map(
    error: Floats, extent: Extent, alt: str, *, label: str = "elevation minus truth", bound: float | None = None
) -> Panel:
    """Difference of elevations (row, col), m, symmetric about zero; colours end at ``bound``, m, or where 3 % lie."""
    factor, unit = canvas.metres_or_mm(error)
    bound = factor * (ranges.limits(np.abs(error), 0, 97)[1] if bound is None else bound)
    fig, _ = _scaled_map(error * factor, extent, canvas.color_map("PuOr"), (-bound, bound), f"{label}, {unit}")
    return canvas.encode(fig, alt, photo=True)


def _scaled_map(
    values: Floats, extent: Extent, colors: Any, bounds: tuple[float, float], label: str
) -> tuple[Any, Any]:
    """Figure and axes of a map in colours between two bounds, with the colour bar below it."""
    fig, ax, cax = canvas.map_axes(extent, bar=True)
    drawn = _show(ax, values, extent, cmap=colors, vmin=bounds[0], vmax=bounds[1])
    canvas.color_bar(drawn, cax, label)
    return fig, ax


def _show(ax: Any, values: Floats, extent: Extent, **style: Any) -> Any:
    ax.set_facecolor(canvas.UNDEFINED)
    return ax.imshow(canvas.shrink(values), extent=extent, aspect="auto", zorder=1, interpolation="none", **style)


def _greys() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("greys", ["#5a5a5a", "#ffffff"]).with_extremes(bad="black")


def paint(classes: Bytes, *colors: str) -> Floats:
    """Colours (row, col, 3) in 0..1 of classes 0, 1, 2 ..."""
    from matplotlib.colors import to_rgb

    table = np.array([to_rgb(c) for c in colors], dtype=np.float32)
    return table[np.minimum(classes, len(colors) - 1)]


def _not_narrower(ax: Any, span: float) -> None:
    """Widen the y range so that numerical noise does not fill a panel."""
    low, high = ax.get_ylim()
    if high - low < span:
        middle = 0.5 * (low + high)
        ax.set_ylim(middle - 0.5 * span, middle + 0.5 * span)


# -- a quantity over frames or pairs, and residuals over the image


def stack(heights: Sequence[float]) -> tuple[Any, list[Any]]:
    """Figure with axes of the given heights (inches) below each other, one x axis for all."""
    top, gap, foot, left = 0.1, 0.14, 0.42, 0.7
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
        ax.yaxis.set_label_coords(-0.52 / (canvas.WIDTH - left - 0.12), 0.5)
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
    fig, ax, cax = canvas.image_axes((size[1], size[0]))
    colors = canvas.color_map("PuOr")
    drawn = ax.imshow(
        grid.reshape(rows, cols), cmap=colors, vmin=-bound, vmax=bound, aspect="auto", interpolation="none"
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
        full = ax.get_xaxis_transform()
        ax.vlines(flagged, 0, 1, color=canvas.HAZARDOUS, linewidth=1.0, alpha=0.55, zorder=0, transform=full)
        # One patch for each run of frames: a figure of thousands takes minutes to draw.
        runs = np.split(np.array(unknown), np.flatnonzero(np.diff(unknown) > 1) + 1) if unknown else []
        ax.broken_barh(
            [(run[0] - 0.5, len(run)) for run in runs], (0, 1), color=canvas.UNDEFINED, linewidth=0, zorder=0,
            transform=full,
        )  # fmt: skip
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
    full = low.get_xaxis_transform()  # x by the frames, y from the bottom to the top of the axes
    low.vlines(pairs, 0, 1, color=canvas.ESTIMATE, linewidth=0.7, alpha=0.5, zorder=0, transform=full)
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
