"""A run as a strip of columns of small pictures: every basic pair, or every stop of a drive.

The pictures are as large as ``BUDGET_CHARACTERS`` allows for all columns, so that the page stays small; where even the
smallest ones are too many, every second column, or third, is shown, and the page says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rille.pipeline.export.view import artifact
from rille.pipeline.flow.products import Stop
from rille.pipeline.report import canvas, gather
from rille.pipeline.report.canvas import Block, Panel
from rille.pipeline.report.gather import Scene, WorldTerrain
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle
from rille.stages.core.quantities import metres
from rille.stages.core.validity import matched
from rille.stages.geometry.epipolar import inverse_depth
from rille.stages.geometry.geometry import Rig
from rille.stages.imaging.features import grey_bytes

BUDGET_CHARACTERS = 900_000
"""All pictures of a strip together: the page has 5 MB at most."""
MAX_WIDTH_PIXELS, MIN_WIDTH_PIXELS = 400, 140
"""Widths of a column; 400 pixels are twice what it takes on the screen."""
LEGEND = tuple(zip(canvas.RISK, canvas.CLASS_NAMES, strict=True))


@dataclass(frozen=True)
class StripLine:
    """What is laid on a map: vertices (n, 2 or more), m, NaN gaps; colour; width in hundredths of the picture's."""

    points: Floats
    color: str
    width: float = 1.0


def pairs(scene: Scene) -> Block | None:
    """Every basic pair; None where no pair was matched."""
    view, disparity = scene.view, scene.view.products.disparity
    matched_pairs = [pair for pair, handle in disparity.items() if view.bundle(handle) is not None]
    if not matched_pairs:
        return None
    return Block(_fitting(matched_pairs, lambda pair, width: _pair(scene, pair, width)), LEGEND)


def drive(scene: Scene) -> Block | None:
    """Every stop of a drive; None where nothing was driven."""
    stops = gather.stops(scene.view)
    if not stops:
        return None
    legend = (*LEGEND, (canvas.ON_MAP, "estimated track"), (canvas.TRUE_ON_MAP, "true track"))
    return Block(_fitting(stops, lambda stop, width: _stop(scene, stop, width)), legend)


def risk_picture(risk: WorldTerrain, lines: Sequence[StripLine], width: int) -> Image.Image:
    """Classes of a risk map in their colours, and lines on them; ``width`` in pixels."""
    picture = Image.fromarray(canvas.paint(risk.arrays["risk"], *canvas.RISK)).convert("RGBA")
    return _with_lines(picture, risk, lines, width)


def panel(picture: Image.Image, alt: str, *, frame: int = -1, quality: int = 82) -> Panel:
    """A picture as a panel, with two pixels to a CSS pixel."""
    uri = canvas.compressed(picture, "webp", quality=quality, method=2)
    return Panel(uri, alt, picture.width // 2, picture.height // 2, frame)


def _fitting(items: Sequence[Any], draw: Callable[[Any, int], Panel]) -> tuple[Panel, ...]:
    """Columns that fit the budget: narrower ones first, then fewer."""
    # Columns like the middle one take three quarters: others may need more.
    planned = 0.75 * BUDGET_CHARACTERS
    cost = len(draw(items[len(items) // 2], MAX_WIDTH_PIXELS).uri) / MAX_WIDTH_PIXELS**2
    step = math.ceil(len(items) * cost * MIN_WIDTH_PIXELS**2 / planned)
    shown = items[::step]
    width = min(MAX_WIDTH_PIXELS, int(math.sqrt(planned / (len(shown) * cost))))
    panels = [draw(item, width) for item in shown]
    while len(panels) > 1 and sum(len(panel.uri) for panel in panels) > BUDGET_CHARACTERS:
        panels = panels[::2]
    return tuple(panels)


def _pair(scene: Scene, pair: int, width: int) -> Panel:
    view = scene.view
    bundle, image = artifact(view, view.products.disparity[pair]), view.bundle(view.products.images.get(pair))
    there = matched(np.asarray(bundle["validity"]))
    seen = np.full(there.shape, 96, np.uint8) if image is None else grey_bytes(np.asarray(image["image"]))
    photo = _photo(seen, width)
    pictures, words = [photo], [f"{there.mean():.0%} matched"]
    if seen.shape[:2] == there.shape:
        pictures.append(matches_picture(photo, bundle, view.sequence.rig))
    dem = gather.terrain(view.bundle(view.products.local_dem.get(pair)), "elevation")
    if dem is not None:
        pictures.append(_elevations(dem, (), width))
    risk = gather.terrain(view.bundle(view.products.local_risk.get(pair)), "risk")
    if risk is not None:
        path = gather.vertices(view.bundle(view.products.local_path.get(pair)))
        pictures.append(risk_picture(risk, [] if path is None else [StripLine(path, canvas.MARK)], width))
        words.append("no local path" if path is None else "with a local path")
    return _column(pictures, f"Pair of frame {pair}: {', '.join(words)}", pair)


def _stop(scene: Scene, stop: Stop, width: int) -> Panel:
    view, track = scene.view, scene.track
    leg, image = artifact(view, stop.leg), view.bundle(view.products.images.get(stop.frame))
    risk = gather.terrain(view.bundle(stop.risk), "risk")
    dem = gather.terrain(view.bundle(stop.risk if stop.far is None else stop.far), "elevation")
    assert risk is not None
    assert dem is not None
    upto = view.frames.index(stop.frame) + 1
    pictures = [] if image is None else [_photo(grey_bytes(np.asarray(image["image"])), width)]
    legs = [StripLine(np.asarray(leg["way"]), canvas.MARK, 0.5), StripLine(np.asarray(leg["path"]), canvas.MARK, 1.5)]
    pictures.append(risk_picture(risk, legs, width))
    # Truth first and wider: where both agree it shows as a rim.
    tracks = [] if track.truth is None else [StripLine(track.truth[:upto], canvas.TRUE_ON_MAP, 3)]
    pictures.append(_elevations(dem, [*tracks, StripLine(track.left[:upto], canvas.ON_MAP, 1)], width))
    words = f"{metres(leg.meta['left_m'])} from the goal: {leg.meta['verdict']}"
    return _column(pictures, f"Stop {stop.index} at frame {stop.frame}, {words}", stop.frame)


# -- pictures of a column


def _column(pictures: Sequence[Image.Image], alt: str, frame: int) -> Panel:
    gap, width = 4, max(p.width for p in pictures)
    whole, top = Image.new("RGBA", (width, sum(p.height + gap for p in pictures) - gap)), 0
    for picture in pictures:
        whole.paste(picture, ((width - picture.width) // 2, top))
        top += picture.height + gap
    return panel(whole, alt, frame=frame, quality=72)


def _photo(pixels: NDArray[np.uint8], width: int) -> Image.Image:
    return _scaled(Image.fromarray(pixels), width).convert("RGBA")


def _scaled(picture: Image.Image, width: int) -> Image.Image:
    """As wide as the column, or less wide where it would become too high."""
    # 1.2: bound of the shape of one picture of a column.
    factor = min(width / picture.width, 1.2 * width / picture.height)
    size = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
    return picture.resize(size, Image.Resampling.BOX if factor < 1 else Image.Resampling.NEAREST)


def matches_picture(photo: Image.Image, disparity: Bundle, rig: Rig) -> Image.Image:
    """Inverse depths of a pair in colour on its left image, blue far; pixels that were not matched stay grey.

    Disparities show depth by their change along the epipolar lines alone, which run as the cameras stand.
    """
    validity = np.asarray(disparity["validity"])
    # The pixel in the middle of each of the small picture's.
    rows_cols = (
        ((np.arange(n) + 0.5) * of / n).astype(int) for n, of in zip(photo.size[::-1], validity.shape, strict=True)
    )
    at = np.ix_(*rows_cols)
    there, pixels = matched(validity[at]), np.stack(np.meshgrid(*map(np.ravel, at[::-1])), -1).reshape(-1, 2)
    shift = np.stack([np.asarray(disparity[f"{name}_disparity"])[at].ravel() for name in ("column", "row")], -1)
    near = inverse_depth(rig, pixels.astype(np.float64), shift)[0].reshape(there.shape)
    low, high = canvas.limits(np.where(there, near, np.nan))
    colors, ground = _colors((near - low) / max(high - low, 1e-9)), np.asarray(photo.convert("RGB"))
    # Divided before multiplied: bytes would overflow the other way round.
    return Image.fromarray(np.where(there[..., None], colors // 3 * 2 + ground // 3, ground)).convert("RGBA")


def _elevations(dem: WorldTerrain, lines: Sequence[StripLine], width: int) -> Image.Image:
    elevation = dem.arrays["elevation"]
    low, high = canvas.ground_limits(elevation)
    alpha = np.where(np.isfinite(elevation), 255, 0).astype(np.uint8)
    colors = _colors((elevation - low) / max(high - low, 1e-9))
    return _with_lines(Image.fromarray(np.dstack([colors, alpha])), dem, lines, width)


def _colors(share: Floats) -> NDArray[np.uint8]:
    return np.asarray(canvas.ramp()[np.clip(np.nan_to_num(share) * 255, 0, 255).astype(np.uint8)])


def _with_lines(picture: Image.Image, ground: WorldTerrain, lines: Sequence[StripLine], width: int) -> Image.Image:
    """A picture of all cells, scaled to ``width``, with lines that have a white casing."""
    factor, picture = 1 / picture.width, _scaled(picture, width)
    factor *= picture.width
    pen = ImageDraw.Draw(picture)
    for line in lines:
        cols_rows = (ground.lattice.index(line.points[:, :2])[:, ::-1] + 0.5) * factor
        points = [(float(u), float(v)) for u, v in cols_rows if np.isfinite(u)]
        if len(points) > 1:
            thick = max(1, round(line.width * picture.width / 100))
            pen.line(points, fill="white", width=thick + 2)
            pen.line(points, fill=line.color, width=thick)
    return picture
