"""The map of the report: values of every cell as pictures that the page's script reads, and what lies on them.

A picture has three bytes a pixel, kept without loss, and each is a plane of whole numbers: the script reads them back
by a canvas. Heights take two bytes; standard deviations one, in steps of equal ratio, as their range is wide. Terrain
of more than ``MAX_CELLS`` cells is thinned: the value shown is then that of one cell, not a mean, so that the map and
the GeoTIFF never disagree.
"""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rille.pipeline.export import colour
from rille.pipeline.export.view import artifact
from rille.pipeline.report import canvas, gather, strips
from rille.pipeline.report.canvas import Block
from rille.pipeline.report.gather import Scene, WorldTerrain
from rille.pipeline.report.strips import StripLine
from rille.stages.core.arrays import Floats
from rille.stages.geometry.lattice import mosaic
from rille.stages.hazard.risk import REASONS, UNKNOWN
from rille.stages.terrain.shading import slope_deg

MAX_CELLS = 350_000
"""Cells of the map; three pictures of these and the ortho image are about 2 MB in the page."""


def block(scene: Scene) -> Block | None:
    """The layered map; without a script the page shows the hazards alone."""
    layers, risk = data(scene), scene.risk
    if risk is None and layers is None:
        return None
    lines = [] if scene.path is None else [StripLine(scene.path, canvas.MARK)]
    # Stands where no script runs.
    still = [] if risk is None else [strips.risk_picture(risk, lines, 800)]
    return Block(tuple(strips.panel(picture, "Risk map seen from above") for picture in still), data=layers)


def data(scene: Scene) -> dict[str, Any] | None:
    """Return the input of the map's script as plain JSON; None without merged terrain.

    ``planes``: pictures with the bytes (height high, height low, sigma), (class and models, reason high, reason low),
    (p_hazard, slope, 0). ``track`` (frame): number, x, y, z, sigma, error or null. All lengths are metres, world frame.
    """
    world, vehicle = scene.world, scene.view.config.vehicle
    if world is None or not np.isfinite(world.arrays["elevation"]).any():
        return None
    step = max(1, math.ceil(math.sqrt(world.arrays["elevation"].size / MAX_CELLS)))
    z = world.arrays["elevation"][::step, ::step]
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    # Two bytes a height; 0 is undefined.
    height = _steps(z, low, max(high - low, 1e-9), np.uint16)
    sigma, sigmas = _ratios(world.arrays["elevation_std"][::step, ::step])
    risk, reason, p_hazard = (_of_risk(scene.risk, world, name, missing)[::step, ::step] for name, missing in _RISK)
    # The class takes two bits of its byte: six are left for the number of models.
    count = np.minimum(np.nan_to_num(world.arrays["count"][::step, ::step]), 63).astype(np.uint8)
    slope = _steps(slope_deg(world.arrays["elevation"], world.lattice.cell)[::step, ::step], 0.0, 90.0, np.uint8)
    bits = np.asarray(reason, np.uint16)
    return {
        "planes": [
            _picture(height >> 8, height & 255, sigma),
            _picture(np.asarray(risk, np.uint8) | (count << 2), bits >> 8, bits & 255),
            _picture(_steps(p_hazard, 0.0, 1.0, np.uint8), slope, np.zeros_like(slope)),
        ],
        "ortho": _ortho(scene, world, step),
        "rows": z.shape[0],
        "cols": z.shape[1],
        "x0": world.lattice.x0,
        "y0": world.lattice.y0,
        "cell": world.lattice.cell * step,
        "thinned": step,
        "z": [low, max(high - low, 1e-9)],
        "shown": [float(v) for v in canvas.ground_limits(z)],
        "sigma": sigmas,
        "judged": scene.risk is not None,
        "reasons": {name: int(bit) for name, bit in REASONS.items()},
        "colors": list(canvas.RISK),
        "ramp": base64.b64encode(canvas.ramp().tobytes()).decode("ascii"),
        "track": _track(scene),
        "path": _path(scene),
        "limit": vehicle.max_slope_deg,
        "vehicle": [vehicle.wheel_base + vehicle.wheel_diameter, vehicle.track],
        **_drive(scene),
    }


_RISK = (("risk", UNKNOWN), ("reason", 0), ("p_hazard", np.nan))


def _of_risk(risk: WorldTerrain | None, world: WorldTerrain, name: str, missing: float) -> Floats:
    """An array of the risk map on the cells of the terrain."""
    judged = [] if risk is None else [(risk.lattice, risk.arrays[name])]
    return mosaic(judged, missing, world.lattice)


def _steps(values: NDArray[Any], low: float, span: float, kind: type[np.uint8 | np.uint16]) -> NDArray[Any]:
    """1 to the most that an integer of this kind holds, from ``low`` to ``low + span``; 0 undefined."""
    share = np.clip((np.nan_to_num(values, nan=low) - low) / span, 0, 1)
    whole = 1 + np.rint(share * (np.iinfo(kind).max - 1)).astype(kind)
    return np.where(np.isfinite(values), whole, kind(0))


def _ratios(values: Floats) -> tuple[NDArray[Any], list[float]]:
    """Steps of equal ratio of positive values, with the least value and the logarithm of the range."""
    there = values[np.isfinite(values) & (values > 0)]
    if not there.size:
        return np.zeros(values.shape, np.uint8), [1.0, 1.0]
    low, span = float(there.min()), max(math.log(float(there.max()) / float(there.min())), 1e-9)
    with np.errstate(invalid="ignore", divide="ignore"):
        return _steps(np.log(np.where(values > 0, values, np.nan) / low), 0.0, span, np.uint8), [low, span]


def _picture(*planes: NDArray[Any]) -> str:
    """Three planes (row, col) of bytes as a picture without loss."""
    # No alpha: a canvas multiplies colours by it, and the bytes read back would be others.
    picture = Image.fromarray(np.stack([np.asarray(p, np.uint8) for p in planes], axis=-1))
    return canvas.compressed(picture, "png", compress_level=6)


def _ortho(scene: Scene, world: WorldTerrain, step: int) -> str:
    """The ortho image, grey or coloured, as a picture with loss."""
    look = world.arrays["ortho"][::step, ::step]
    if colour.coloured(scene.view, world.arrays["source"]):
        rgb = colour.ortho(scene.view, world.lattice, world.arrays)[::step, ::step].astype(np.float64)
        look = np.where(rgb > 0, rgb, np.nan)
    low, high = canvas.limits(look, 0.5, 99.5)
    stretched = np.clip((np.nan_to_num(look, nan=low) - low) / (high - low) * 255, 0, 255)
    return canvas.compressed(Image.fromarray(stretched.astype(np.uint8)), "jpeg", quality=82)


def _track(scene: Scene) -> list[list[Any]]:
    track = scene.track
    error = np.full(len(track.left), np.nan) if track.error is None else track.error
    rows = np.column_stack([track.left, track.sigma, error])[track.in_world]
    frames = np.array(scene.view.frames)[track.in_world]
    return [
        [int(f), *(round(float(v), 5) if np.isfinite(v) else None for v in row)]
        for f, row in zip(frames, rows, strict=True)
    ]


def _path(scene: Scene) -> list[list[float | None]]:
    """Vertices of the path: x, y, z, m, and the inclination that the planner judged there, degrees, or None."""
    if scene.path is None:
        return []
    inclination = np.full(len(scene.path), np.nan)
    if scene.risk is not None:
        inclination = np.degrees(scene.risk.at("inclination", scene.path[:, :2]))
    return [
        [*(round(v, 4) for v in place), round(value, 2) if math.isfinite(value) else None]
        for place, value in zip(scene.path.tolist(), inclination.tolist(), strict=True)
    ]


def _drive(scene: Scene) -> dict[str, Any]:
    """What was driven from each stop of a drive (vertex, 2) m, by the frame that it stands at; x, y, m, of the goal."""
    legs, goal = {}, None
    for stop in gather.stops(scene.view):
        leg = artifact(scene.view, stop.leg)
        goal = [round(float(v), 4) for v in leg.meta["goal"][:2]]
        if len(leg["path"]):
            legs[str(stop.frame)] = np.round(np.asarray(leg["path"])[:, :2], 4).tolist()
    return {"legs": legs, "goal": goal}
