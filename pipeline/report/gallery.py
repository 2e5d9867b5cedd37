"""List of a report's figures: the paper's Figures 3 and 6-9 redrawn from the run, and figures of its quality."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rille.pipeline.export import artifacts
from rille.pipeline.export.output import Output, stage
from rille.pipeline.report import canvas, checks, driving, figures, gather, seams, stops, terrain_map
from rille.pipeline.report.canvas import FIGURE, Block, Figure
from rille.pipeline.report.delivery import start_words
from rille.pipeline.report.gather import Scene
from rille.pipeline.report.words import length, number, spread
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import RilleError

Maker = Callable[[Scene], Block | None]
Condition = Callable[[Scene], bool]


def _drawn(title: str, maker: Maker, expected: Condition, scene: Scene) -> Figure:
    try:
        block = maker(scene)
    except (OSError, MemoryError, RilleError):  # not the figure's own fault: another try may draw it
        raise
    except Exception as error:  # a figure must not cost the run its report; the failure is shown in it
        return Figure(title, why=f"drawing failed, {type(error).__name__}: {error}", failed=True)
    return Figure(title, block, "what it shows was not computed" if block is None and expected(scene) else "")


def _output(title: str, maker: Maker, expected: Condition, reads: str, knows: str) -> Output:
    """Record of a figure: a part of the page, kept as JSON."""

    def write(path: Path, view: Any) -> None:
        drawn = _drawn(title, maker, expected, Scene(view))
        path.write_bytes(FIGURE.dump_json(drawn))

    return Output(title, "", "", write, (), tuple(reads.split()), ("frames", *knows.split()))


def _disparities(scene: Scene) -> Block | None:
    view = scene.view
    pair = next((p for p, h in view.products.disparity.items() if view.bundle(h) is not None), None)
    if pair is None:
        return None
    bundle, image = view.bundle(view.products.disparity[pair]), artifacts.image(view, pair)
    assert bundle is not None
    row, column = np.asarray(bundle["row_disparity"]), np.asarray(bundle["column_disparity"])
    name = f"frame {pair}"
    panels = [
        figures.disparity(row, "row disparity, px", f"Map of row disparities of {name}, {spread(row)} px"),
        figures.disparity(column, "column disparity, px", f"Map of column disparities of {name}, {spread(column)} px"),
    ]
    if image is not None:
        panels.insert(0, figures.photo(np.asarray(image["image"]), f"Left camera image of {name}"))
    classes = figures.validity_classes(np.asarray(bundle["validity"]))
    shares = [float((classes == k).mean()) for k in range(3)]
    words = f"{shares[0]:.0%} measured, {shares[1]:.0%} interpolated, {shares[2]:.0%} undefined"
    panels.append(figures.validity(classes, f"How the disparity of each pixel of {name} came about: {words}"))
    caption = (
        f"Left image of the first basic pair ({name}); row and column disparities of its pixels, right minus left, in "
        "pixels, blank where undefined; and which of them were measured (in both directions, or on the plane of a "
        "textureless region), which interpolated. "
        "Nothing was rectified, so rows may differ too."
    )
    colors = (canvas.MEASURED, canvas.INTERPOLATED, canvas.UNDEFINED)
    names = ("measured", "interpolated", "undefined")
    legend = tuple((c, f"{n} {share:.0%}") for c, n, share in zip(colors, names, shares, strict=True))
    return Block("Figure 6", "Figure 6. Disparities of the first stereo pair", caption, tuple(panels), legend)


def _terrain(scene: Scene) -> Block | None:
    world = scene.world
    if world is None:
        return None
    pairs = sum(scene.view.bundle(handle) is not None for handle in scene.view.products.world_dem.values())
    ortho, elevation = world.get("ortho"), world.get("elevation")
    risk = None if scene.risk is None or scene.risk.lattice != world.lattice else scene.risk.arrays["risk"]
    panels = []
    if ortho is not None:
        panels.append(
            figures.ortho(ortho, world.extent, f"Ortho image merged from {pairs} stereo pairs, seen from above")
        )
    if elevation is not None:
        alt = f"Elevation as grey values, {spread(elevation)} m, with the path over it"
        panels.append(figures.elevation_with_path(elevation, risk, scene.path, world.extent, alt))
    path = (
        f"; the path is the orange line (ring: start, disk: target){start_words(scene.view)}"
        if scene.path is not None
        else ""
    )
    caption = (
        f"First: ortho image merged from {pairs} basic pairs, cells of {length(world.lattice.cell)}; undefined and "
        "occluded cells are blank. Second: elevation, bright is high; unknown "
        f"{'' if risk is None else 'and hazardous '}cells are black{path}. World frame: x right and y ahead of the "
        "first left camera, which is at (0, 0)."
    )
    return Block(
        "Figure 7", "Figure 7. Merged ortho image, and the path on the elevation model", caption, tuple(panels)
    )


CLASSES = ("safe", "caution", "hazard", "unknown")


def _map(scene: Scene) -> Block | None:
    """The layered map; its still picture is the risk map, or the elevations where nothing was judged."""
    found, world, risk = terrain_map.data(scene), scene.world, scene.risk
    if risk is None and (world is None or found is None):
        return None
    words, shares, caption, how = "not judged", [], "", ""
    if risk is not None:
        classes, vehicle = risk.arrays["risk"], scene.view.config.vehicle
        shares = [float((classes == k).mean()) for k in range(4)]
        words = ", ".join(f"{number(100 * part, 2)}% {name}" for part, name in zip(shares, CLASSES, strict=True))
        panel = figures.risk_map(classes, scene.path, risk.extent, f"Risk map seen from above: {words}")
        path, path_how = _path_words(scene)
        caption = f"{words} of all cells. {path}"
        how = (
            f"Unknown cells may lie out of view. Limits of {vehicle.name}: slope and tilt {vehicle.max_slope_deg:g}°, "
            f"step {length(vehicle.max_step)}, "
            f"roughness {length(vehicle.max_roughness)}, clearance {length(vehicle.clearance)}. Hazard: a limit is "
            f"exceeded once {scene.view.config.risk.sigmas:g} standard deviations of the measure are added to it; "
            f"caution: it comes near one. {path_how} "
        )
    else:
        assert world is not None
        panel = figures.elevation_with_path(world.arrays["elevation"], None, scene.path, world.extent, "Elevation")
    if found is not None:
        how += (
            "σ: standard deviation of the elevation as predicted from the disparity's error, the rig's geometry, how "
            "well both images agree and the poses' covariances; models: how many basic pairs saw a cell."
        )
    if found is not None and found["thinned"] > 1:
        how += f" The map shows one of {found['thinned']} cells along each axis; the GeoTIFFs have all."
    return Block("Map", "Map", caption, (panel,), _legend(shares) if shares else (), data=found, how=how)


def _path_words(scene: Scene) -> tuple[str, str]:
    """What came of the path, and how to read it."""
    drive = scene.view.products.drive
    if drive is not None:
        return f"{driving.outcome(drive)}.", (
            "No path is planned over the whole map, what was driven is shown stop by stop. Of a round patch at the "
            "start no camera saw anything: where the map has one, it is taken for flat ground, since the rover stands "
            "on it."
        )
    path, vehicle = scene.view.bundle(scene.view.products.world_path), scene.view.config.vehicle
    if path is None:
        return "The path was not computed.", ""
    if scene.path is None:
        return f"There is no path: {path.meta.get('reason')}.", ""
    before, beyond = path.meta.get("left_out_m") or (0.0, 0.0)
    start = start_words(scene.view, "It ")
    x, y = scene.path[-1, :2]
    aim = scene.view.config.path.target
    chosen = "the target" if aim else "no path.target is set, so that is the free place nearest to the far row's middle"
    rest = (
        f"{start}{'. ' if start else ''}It ends at {chosen}. Of all paths there it is the one that climbs and falls "
        "least, with caution ground and detours charged; not the shortest."
    )
    if max(before, beyond) > vehicle.wheel_base + vehicle.wheel_diameter:
        rest += (
            f" It crosses the connected ground over most rows: {length(before)} of nearer and {length(beyond)} of "
            "farther rows are left out, which the vehicle cannot reach from there."
        )
    known = {
        "outline": "no unknown ground comes under its outline",
        "wheels": "its wheels stay on known ground, its belly does not everywhere",
        "middle": "its middle stays on known ground, its wheels do not everywhere",
    }.get(path.meta.get("ground", ""), "unknown ground is not entered")
    return f"The path (black line) ends at x {x:.2f} m, y {y:.2f} m.", (
        "The vehicle stands at the start of the path, a disk at its end; the line is that of the vehicle's middle; "
        f"its wheels keep {length(vehicle.margin)} from hazards; {known}. {rest}"
    )


def _legend(shares: list[float]) -> tuple[tuple[str, str], ...]:
    return tuple((c, f"{name} {share:.0%}") for c, name, share in zip(canvas.RISK, CLASSES, shares, strict=True))


def _local(scene: Scene) -> Block | None:
    """The stop whose local path is found and whose far row has most to choose from."""
    view = scene.view
    stops = []
    for pair, handle in view.products.local_path.items():
        path = view.bundle(handle)
        if path is not None and view.bundle(view.products.local_risk.get(pair)) is not None:
            stops.append((bool(path.meta.get("found")), int(np.sum(path["reachable"])), -pair, path))
    if not stops:
        return None
    found, targets, minus_pair, path = max(stops, key=lambda s: s[:3])
    pair = -minus_pair
    risk = gather.terrain(view.bundle(view.products.local_risk[pair]), "risk")
    assert risk is not None
    points, cost = gather.vertices(path), np.asarray(path["cost_to_go"])
    far = _far_row(path)
    name = f"the stop at frame {pair}"
    panels = [
        figures.risk_map(risk.arrays["risk"], points, risk.extent, f"Local risk map of {name} with its path", far=far)
    ]
    if cost.shape == risk.lattice.shape:
        panels.append(figures.cost_to_go(cost, points, risk.extent, f"Cost of the best path to each cell from {name}"))
    outcome = (
        f"{targets} cells of the far row can be reached (blue dots); the path to the middle one is drawn"
        if found and path.meta.get("planner") != "grid8"
        else f"as no path crosses all rows, one in any direction is drawn, which ends at {path.meta.get('ended_by')}"
        if found
        else f"no path: {path.meta.get('reason') or 'the far row cannot be reached'}"
    )
    caption = (
        f"Heading-aligned local map of {name}: each cell of a row leads to three cells of the next, so one sweep finds "
        f"the best path to every cell; {outcome}. Second: height differences, and tolls for caution ground, summed "
        "along the best path from the start to each cell; grey cells cannot be reached."
    )
    title = f"Figure 3. Local risk map and reachable targets, frame {pair}"
    legend = _legend([float((risk.arrays["risk"] == k).mean()) for k in range(4)])
    return Block("Figure 3", title, caption, tuple(panels), legend)


def _far_row(path: Bundle) -> Any:
    """Cells (n, 3) of the target row: x, y, and whether a path leads there."""
    grid, row = path.meta.get("grid"), path.meta.get("target_row")
    reachable = np.asarray(path["reachable"])
    if not grid or row is None or not path.meta.get("found"):
        return None
    right, ahead = (grid["i0"] + np.arange(len(reachable))) * grid["cell"], (grid["j0"] - row) * grid["cell"]
    dx, dy = grid["ahead"]
    far = np.column_stack([right * dy + ahead * dx, ahead * dy - right * dx, reachable])
    return far[reachable > 0]


def _tracks(scene: Scene) -> Block | None:
    view = scene.view
    frames = gather.consecutive(view)
    trails = gather.trails(view, frames)
    if not trails:
        return None
    panels = []
    for frame in frames:
        bundle = artifacts.image(view, frame)
        assert bundle is not None
        lines, good = trails.get(frame, ([], []))
        alt = f"Frame {frame} with {len(lines)} landmarks and the trails they left"
        panels.append(figures.tracks(np.asarray(bundle["image"]), lines, good, alt))
    counts = ", ".join(str(len(trails.get(f, ([], []))[0])) for f in frames)
    caption = (
        f"Frames {frames[0]} to {frames[-1]} with {counts} landmarks and the trails they left since their segment "
        "began. Yellow: agrees with the pose of the frame; orange: removed as inconsistent."
    )
    return Block("Figure 8", "Figure 8. Four successive frames and the landmarks' tracks", caption, tuple(panels))


def _trajectory(scene: Scene) -> Block | None:
    track, other = scene.track, scene.comparison
    n = int(track.in_world.sum())
    if n < 2:
        return None
    known = track.truth is not None
    versus = " against the truth (orange)" if known else ""
    theirs = None if other is None or not other.registered.any() else other.poses[:, :, 3]
    flagged = None if other is None else track.left[other.flagged]
    alt = f"Top view of {n} camera positions{versus}"
    panels = [figures.trajectory(track.left, track.right, track.truth, alt, other=theirs, flagged=flagged)]
    step = np.diff(track.left, axis=0)
    truth = None if track.truth is None else np.diff(track.truth, axis=0)
    alt = f"x, y and z components of the displacement between successive frames{versus}"
    panels.append(figures.displacements(step, truth, scene.view.frames[1:], alt))
    gaps = 0 if track.truth is None else int(np.isnan(track.truth).any(axis=1).sum())
    source = (
        f" Truth: {scene.view.sequence.truth_source}; aligned by the first frame that has it alone"
        + (f"; {gaps} of {len(track.truth)} frames have none." if gaps else ".")
        if track.truth is not None
        else " No truth."
        if scene.view.sequence.truth_positions is None
        else " Truth is positions alone: compared in the table, not drawn."
    )
    caption = (
        f"First: positions of the left camera in {n} frames, and of the right camera at the basic pairs, seen from "
        f"above{'; the positions by COLMAP are laid on ours without a change of scale' if theirs is not None else ''}. "
        f"Second, from the top: x, y and z components of the displacement between successive positions{versus}.{source}"
    )
    legend = [(canvas.ESTIMATE, "left camera (dots: frames)"), (canvas.RIGHT, "right camera (triangles: basic pairs)")]
    legend += [(canvas.REFERENCE, "left camera, truth")] if known else []
    legend += [(canvas.OTHER, "left camera by COLMAP")] if theirs is not None else []
    legend += [(canvas.HAZARDOUS, "flagged frames (rings)")] if flagged is not None and len(flagged) else []
    return Block("Figure 9", "Figure 9. Trajectory and displacements", caption, tuple(panels), tuple(legend))


def _dem_error(scene: Scene) -> Block | None:
    error = gather.terrain(scene.view.bundle(scene.view.products.dem_accuracy), "error")
    if error is None or error.get("error") is None:
        return None
    values = error.arrays["error"]
    panel = figures.error_map(values, error.extent, f"Elevation minus truth of the merged terrain, {spread(values)} m")
    caption = (
        "Merged elevation minus the exact one, by cell. The world frame is that of the first pair, so errors of the "
        "trajectory show here as well."
    )
    return Block("Elevation error", "Elevation error against truth", caption, (panel,))


def _several(scene: Scene) -> bool:
    return len(scene.view.frames) > 1


def _always(scene: Scene) -> bool:
    return True


def _planned(scene: Scene) -> bool:
    return scene.view.products.drive is None


_COMPARED = "trajectory agreement accuracy crosscheck_accuracy"
_TRUTH = "sequence.truth sequence.truth_positions sequence.truth_source"
_FIGURES: tuple[tuple[str, Maker, Condition, str, str], ...] = (
    (
        "Map",
        _map,
        _always,
        "world_tiles world_risk world_path drive trajectory disparity rigs images undistorted screening",
        "config.vehicle config.risk.sigmas config.path.target sequence.rig sequence.truth",
    ),
    (
        "Drive",
        driving.strip,
        lambda scene: scene.view.products.drive is not None,
        "drive images trajectory",
        "sequence.truth sequence.simulation.T_vehicle_left",
    ),
    ("Figure 6. Disparities", _disparities, _always, "disparity images undistorted", ""),
    (
        "Stops",
        stops.strip,
        _planned,
        "disparity images undistorted local_dem local_risk local_path drive",
        "sequence.rig",
    ),
    (
        "Rig",
        checks.rig,
        lambda scene: bool(scene.view.products.rigs),
        "rigs orientations accuracy",
        "sequence.rig config.rig.significance",
    ),
    (
        "Figure 7. Ortho image and path",
        _terrain,
        _always,
        "world_tiles world_dem world_risk world_path",
        "config.vehicle",
    ),
    ("Figure 3. Local risk map", _local, _planned, "local_path local_risk drive", ""),
    ("Figure 8. Tracks", _tracks, _several, "images undistorted tracks resections", ""),
    (
        "Figure 9. Trajectory",
        _trajectory,
        _several,
        f"disparity rigs {_COMPARED}",
        f"{_TRUTH} sequence.rig",
    ),
    (
        "Crosscheck",
        checks.crosscheck,
        lambda scene: scene.view.products.agreement is not None,
        f"rigs orientations {_COMPARED}",
        "sequence.rig",
    ),
    (
        "Basic pairs",
        checks.basic_pairs,
        lambda scene: _several(scene) and scene.view.products.keyframes is not None,
        "keyframes screening",
        "config.keyframes.rule config.keyframes.overlap",
    ),
    ("Overlap", checks.overlaps, lambda scene: len(scene.view.products.world_dem) > 1, "world_tiles world_dem", ""),
    ("Seams", seams.worst, lambda scene: bool(scene.view.products.seams), "overlap_audit seams", ""),
    ("Seam audit", seams.models, lambda scene: bool(scene.view.products.seams), "overlap_audit seams", ""),
    # Never missed: a sequence without true elevations lacks nothing.
    ("Elevation error", _dem_error, lambda scene: False, "dem_accuracy", ""),
)
"""Title, how it is drawn, whether a run lacks something without it, the artifacts that it reads, and facts."""

OUTPUTS = tuple(_output(*row) for row in _FIGURES)
STAGE = stage("output.figures", "Figures of the report", OUTPUTS)
