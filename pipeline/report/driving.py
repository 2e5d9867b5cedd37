"""The drive as a strip of pictures: a stop per column, with what was seen, what was thought and what was known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export import ranges
from rille.pipeline.report import canvas, figures, gather, stops
from rille.pipeline.report.canvas import Block, Extent, Panel, Table
from rille.pipeline.report.gather import Scene
from rille.pipeline.report.words import metres
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice

if TYPE_CHECKING:
    from rille.pipeline.flow.products import Driven, Stop

Floats = NDArray[Any]

WIDTH = 2.2
"""Inches of a column."""
AROUND = 0.35
"""Share of the map's larger side that the local risk map shows to either side of the vehicle."""
VERDICTS = {
    "goal": "The goal was reached",
    "no path": "No path leads to the goal",
    "safety stop": "Safety stop",
    "stops": "Given up after too many stops",
}


def strip(scene: Scene) -> Block | None:
    """The figure of a drive; None where nothing was driven."""
    view = scene.view
    drive = view.products.drive
    if drive is None:
        return None
    panels, rows = [], []
    estimate, truth = tracks(scene)
    for stop in drive.stops:
        leg, risk = view.bundle(stop.leg), view.bundle(stop.risk)
        whole = risk if stop.far is None else view.bundle(stop.far)
        image = view.bundle(view.products.images.get(stop.frame))
        if leg is None or risk is None or whole is None or image is None:
            continue
        upto = view.frames.index(stop.frame) + 1
        meta = leg.meta
        so_far = (estimate[:upto], None if truth is None else truth[:upto])
        panels.append(column(stop, np.asarray(image["image"]), leg, risk, np.asarray(whole["elevation"]), so_far))
        off = None if truth is None else float(np.hypot(*(estimate[upto - 1] - truth[upto - 1])))
        rows.append(
            (
                str(stop.index),
                str(stop.frame),
                metres(meta["left_m"]),
                meta["verdict"],
                metres(meta["length_m"]),
                metres(off),
                stop.event,
            )
        )
    if not panels:
        return None
    head = ("Stop", "Frame", "From the goal", "Decision", "Leg", "Position error", "What happened")
    caption = (
        f"{outcome(drive)}. Each column is a stop. First: the left "
        "image. Second: the hazards around the vehicle (disk), as far as known from near enough to drive there, with "
        "the leg that is driven next (black) "
        "and the planned path beyond it (thin); the star is the goal. Third: the merged elevations of all stops so "
        "far with the vehicle's track, estimated (blue) and true (orange)."
    )
    caption += _fixed(scene)
    every, panels = len(panels), stops.within(panels)
    if len(panels) < every:
        caption += f" {len(panels)} of {every} stops are shown, so that the page stays below 5 MB."
    legend = (
        *zip(canvas.RISK, ("safe", "caution", "hazardous", "unknown"), strict=True),
        (canvas.ON_MAP, "estimated track"),
        (canvas.TRUE_ON_MAP, "true track"),
    )
    table = Table(head, tuple(rows), (0, 1, 2, 4, 5))
    return Block("Drive", "The drive, stop by stop", caption, tuple(panels), legend, table, strip=True)


def outcome(drive: Driven) -> str:
    """How a drive ended, and why."""
    words = VERDICTS.get(drive.verdict, "The drive did not end")
    return f"{words}: {drive.reason}" if drive.reason else words


def _fixed(scene: Scene) -> str:
    """Where the start is in the global map, in words; empty without one."""
    drive = scene.view.products.drive
    fix = None if drive is None else scene.view.bundle(drive.fix)
    if fix is None:
        return ""
    x, y = fix.meta["T_global_local"][3], fix.meta["T_global_local"][7]
    place = f" In the global map the first camera is at ({x:.3f}, {y:.3f}) m, {fix.meta['source']}"
    if "std" not in fix.meta:
        return place + "."
    sx, sy, heading, _ = fix.meta["std"]
    other = fix.meta["other"]
    next_best = "" if other is None else f"; the next best place has a chi2 larger by {other['chi2']:.0f}"
    turn = f"{np.degrees(heading):.2f}°"
    return f"{place} (standard deviations {metres(sx)}, {metres(sy)}, {turn}){next_best}."


def tracks(scene: Scene) -> tuple[Floats, Floats | None]:
    """Track (frame, 2) m of the centre of the wheels in the world, estimated and true, made equal at the first of both.

    NaN where a frame has no pose.
    """
    view = scene.view
    simulation, trajectory = view.sequence.simulation, view.bundle(view.products.trajectory)
    assert simulation is not None
    T_left_vehicle = simulation.T_vehicle_left.inverse()
    found = np.full((len(view.frames), 2), np.nan)
    if trajectory is None:
        return found, None
    poses = np.asarray(trajectory["poses"])
    found[: len(poses)] = (poses @ np.append(T_left_vehicle.translation, 1.0))[:, :2]  # NaN of a lost frame
    posed = {
        frame: RigidTransform.from_matrix(pose)
        for frame, pose in zip(view.frames, poses, strict=False)
        if np.isfinite(pose).all()
    }
    true = gather.truth_in_world(view, posed)
    if true is None:
        return found, None
    gap = np.full(2, np.nan)
    return found, np.array([gap if T is None else (T @ T_left_vehicle).translation[:2] for T in true])


def column(
    stop: Stop, image: Floats, leg: Bundle, risk: Bundle, elevation: Floats, so_far: tuple[Floats, Floats | None]
) -> Panel:
    """One stop as a column of three pictures: ``image``, hazards with the leg, and all elevations so far.

    ``so_far``: the vehicle's tracks up to the stop (n, 2), m, estimated and true.
    """
    meta, path, way = leg.meta, np.asarray(leg["path"]), np.asarray(leg["way"])
    at, goal = meta["start"][:2], meta["goal"][:2]
    rows, cols = image.shape[:2]
    whole = Lattice.from_dict(risk.meta["lattice"]).bounds
    near = _near(at, AROUND * max(whole[1] - whole[0], whole[3] - whole[2]) / 1.5)
    heights = [WIDTH * rows / cols, WIDTH, WIDTH * (whole[3] - whole[2]) / (whole[1] - whole[0])]
    gap, top = 0.06, 0.24
    total = top + sum(heights) + 2 * gap
    fig = canvas.figure(WIDTH, total)
    edge, axes = total - top, []
    for height in heights:
        edge -= height
        ax = fig.add_axes((0.0, edge / total, 1.0, height / total))
        ax.set_axis_off()
        axes.append(ax)
        edge -= gap
    color = canvas.HAZARDOUS if stop.event and meta["verdict"] != "goal" else canvas.INK
    title = f"stop {stop.index}: {meta['verdict']}"
    fig.text(0.5, 1 - 0.6 * top / total, title, ha="center", va="center", fontsize=9, color=color)
    axes[0].imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
    _map(axes[1], figures.paint(np.asarray(risk["risk"]), *canvas.RISK), whole, near)
    axes[1].plot(way[:, 0], way[:, 1], color=canvas.MARK, linewidth=0.7)
    if len(path) > 1:
        axes[1].plot(path[:, 0], path[:, 1], color="white", linewidth=4)
        axes[1].plot(path[:, 0], path[:, 1], color=canvas.MARK, linewidth=2)
    low, high = ranges.ground_limits(elevation)
    _map(axes[2], elevation, whole, whole, cmap=canvas.color_map("gray"), vmin=low, vmax=high)
    estimate, truth = so_far
    # Truth first and wider: where both agree it shows as a rim.
    for track, shade, width in ((truth, canvas.TRUE_ON_MAP, 4.0), (estimate, canvas.ON_MAP, 1.6)):
        if track is not None:
            axes[2].plot(track[:, 0], track[:, 1], color=shade, linewidth=width)
    for ax in axes[1:]:
        ax.plot(*at, "o", markersize=5, markerfacecolor=canvas.MARK, markeredgecolor="white")
        ax.plot(*goal, "*", markersize=9, markerfacecolor="#ffd34d", markeredgecolor=canvas.MARK)
    alt = f"Stop {stop.index} at frame {stop.frame}, {metres(meta['left_m'])} from the goal: {meta['verdict']}"
    return replace(canvas.encode(fig, alt, photo=True), frame=stop.frame)


def _near(at: Sequence[float], reach: float) -> Extent:
    return at[0] - reach, at[0] + reach, at[1] - 0.4 * reach, at[1] + 1.6 * reach


def _map(ax: Any, values: Floats, extent: Extent, shown: Extent, **style: Any) -> None:
    ax.imshow(values, extent=extent, aspect="auto", interpolation="none", **style)
    ax.set_xlim(shown[0], shown[1])
    ax.set_ylim(shown[2], shown[3])
