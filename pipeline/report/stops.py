"""Every basic pair as a column of small pictures: image, matches, elevations, hazards with the local path.

The pictures are as large as ``BUDGET`` allows for all pairs, so that the page stays small; where even the smallest ones
are too many, every second pair, or third, is shown, and the caption says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export import artifacts, ranges
from rille.pipeline.report import canvas, gather
from rille.pipeline.report.canvas import Block, Panel
from rille.pipeline.report.figures import paint
from rille.pipeline.report.gather import Scene, Terrain
from rille.stages.core.validity import matched
from rille.stages.evaluation.crosscheck import grey_bytes
from rille.stages.geometry.geometry import Rig

Bytes = NDArray[np.uint8]

BUDGET = 900_000
"""Characters of the pictures of all pairs, and of all stops of a drive: the page has 5 MB at most."""
WIDEST, NARROWEST = 400, 140
"""Pixels of a column; 400 are twice what it takes on the screen."""
TALLEST = 1.2
"""Height of a map over its width, at most."""
RESERVE = 0.75
"""Share of the budget that is planned for: one pair is not like the others."""


def strip(scene: Scene) -> Block | None:
    """The figure; None where no pair was matched."""
    view, disparity = scene.view, scene.view.products.disparity
    pairs = [p for p, handle in disparity.items() if view.bundle(handle) is not None]
    if not pairs:
        return None
    cost = column(scene, pairs[len(pairs) // 2], WIDEST).size / WIDEST**2
    step = math.ceil(len(pairs) * cost * NARROWEST**2 / (RESERVE * BUDGET))
    shown = pairs[::step]
    width = min(WIDEST, int(math.sqrt(RESERVE * BUDGET / (len(shown) * cost))))
    panels = within([column(scene, pair, width) for pair in shown])
    judged = any(view.bundle(handle) is not None for handle in view.products.local_risk.values())
    some = "" if len(panels) == len(pairs) else f" {len(panels)} of {len(pairs)} pairs are shown."
    caption = (
        "Each column is a basic pair, from the top: left image; its matches, coloured by "
        f"{depth_band(view.sequence.rig)[0].replace('_', ' ')} (blue: far); "
        f"elevations of its own model{'; its hazards with the local path (black)' if judged else ''}. Pictures are "
        f"{width} pixels wide, so that the page stays below 5 MB.{some}"
    )
    names = ("safe", "caution", "hazard", "unknown")
    legend = tuple(zip(canvas.RISK, names, strict=True)) if judged else ()
    return Block("Stops", "Every pair", caption, tuple(panels), legend, strip=True)


def depth_band(rig: Rig) -> tuple[str, int]:
    """Component of the disparity along the baseline, and the sign by which it is the smaller the nearer a point is."""
    right, below, _ = rig.T_right_left.inverse().translation
    # Right minus left: a camera to the right (or below) sees what is near farther to the left (or above).
    band, along = ("column_disparity", right) if abs(right) >= abs(below) else ("row_disparity", below)
    return band, 1 if along >= 0 else -1


def within(panels: Sequence[Panel]) -> list[Panel]:
    """All panels, or every second, third ... so that they fit the budget."""
    step = 1
    while len(panels[::step]) > 1 and sum(p.size for p in panels[::step]) > BUDGET:
        step += 1
    return list(panels[::step])


def column(scene: Scene, pair: int, width: int) -> Panel:
    """One pair, ``width`` pixels wide."""
    from PIL import Image

    view, pictures, words = scene.view, [], []
    image = artifacts.image(view, pair)
    seen = None if image is None else grey_bytes(np.asarray(image["image"]))
    found = view.bundle(view.products.disparity[pair])
    assert found is not None
    band, sign = depth_band(view.sequence.rig)
    there, values = matched(np.asarray(found["validity"])), sign * np.asarray(found[band])
    if seen is not None:
        pictures += [_scaled(Image.fromarray(seen).convert("RGBA"), width)]
    pictures += [_scaled(_matches(seen, values, there), width)]
    words.append(f"{there.mean():.0%} matched")
    dem = gather.terrain(view.bundle(view.products.local_dem.get(pair)), "elevation")
    if dem is not None:
        pictures.append(_scaled(_colored(dem.arrays["elevation"]), width))
    risk = gather.terrain(view.bundle(view.products.local_risk.get(pair)), "risk")
    if risk is not None:
        path = gather.vertices(view.bundle(view.products.local_path.get(pair)))
        pictures.append(_hazards(risk, path, width))
        words.append("no local path" if path is None else "with a local path")
    sheet, top = Image.new("RGBA", (width, sum(p.height for p in pictures) + 4 * (len(pictures) - 1))), 0
    for picture in pictures:
        sheet.paste(picture, ((width - picture.width) // 2, top))
        top += picture.height + 4
    alt = f"Pair of frame {pair}: {', '.join(words)}"
    return Panel(canvas.webp(sheet, photo=True, quality=72), alt, sheet.width // 2, sheet.height // 2, pair)


def _scaled(picture: Any, width: int) -> Any:
    """As wide as the column, or lower than ``TALLEST`` allows."""
    from PIL import Image

    factor = min(width / picture.width, TALLEST * width / picture.height)
    size = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
    return picture.resize(size, Image.Resampling.BOX if factor < 1 else Image.Resampling.NEAREST)


def _matches(seen: Bytes | None, disparity: NDArray[Any], there: NDArray[np.bool_]) -> Any:
    """Disparities in colour on the image; pixels that were not matched stay grey."""
    from PIL import Image

    low, high = ranges.limits(np.where(there, disparity, np.nan))
    # The smaller the nearer a point is: turned round, so that blue is far.
    colors = _ramp((high - disparity) / max(high - low, 1e-9))
    ground = np.full(there.shape, 96, np.uint8) if seen is None or seen.shape != there.shape else seen
    grounds = np.repeat(ground[..., None], 3, axis=-1)
    # Divided before multiplied: bytes would overflow the other way round.
    return Image.fromarray(np.where(there[..., None], colors // 3 * 2 + grounds // 3, grounds)).convert("RGBA")


def _colored(elevation: NDArray[Any]) -> Any:
    from PIL import Image

    low, high = ranges.ground_limits(elevation)
    known = np.isfinite(elevation)
    alpha = np.where(known, 255, 0).astype(np.uint8)
    return Image.fromarray(np.dstack([_ramp((elevation - low) / max(high - low, 1e-9)), alpha]))


def _ramp(share: NDArray[Any]) -> Bytes:
    index = np.clip(np.nan_to_num(share) * 255, 0, 255).astype(np.uint8)
    return np.asarray(canvas.ramp("viridis")[index])


def _hazards(risk: Terrain, path: NDArray[Any] | None, width: int) -> Any:
    from PIL import Image, ImageDraw

    colors = np.rint(255 * paint(risk.arrays["risk"], *canvas.RISK)).astype(np.uint8)
    picture = _scaled(Image.fromarray(colors).convert("RGBA"), width)
    if path is not None and len(path) > 1:
        lattice, factor = risk.lattice, picture.width / colors.shape[1]
        cols, rows = (path[:, 0] - lattice.x0) / lattice.cell, (lattice.y0 - path[:, 1]) / lattice.cell
        points = [(float(c), float(r)) for c, r in zip((cols + 0.5) * factor, (rows + 0.5) * factor, strict=True)]
        pen, wide = ImageDraw.Draw(picture), max(2, width // 100)
        pen.line(points, fill="white", width=wide + 2)
        pen.line(points, fill=canvas.MARK, width=wide)
    return picture
