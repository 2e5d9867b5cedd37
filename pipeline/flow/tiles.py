"""Large pairs as tasks: which are matched in tiles, in tiles of which size, and the nodes of one pair.

The disparity of a pair is the same, bit for bit, whether it is matched whole or in tiles of any size: what reads it is
not computed again when these parameters change.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from rille.pipeline.engine.graph import Graph, Handle
from rille.stages.core.declare import Params
from rille.stages.hfvm import join_stage, tile_stage, tiled
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.plane import margin
from rille.stages.hfvm.images.views import pyramid_shapes
from rille.stages.hfvm.images.window import Shape, tiles
from rille.stages.imaging.pyramid import PyramidParams

WHOLE_BYTES, TILE_BYTES = 170, 300
"""Room for matching a pixel, bytes: of images that are matched whole, and of a tile, whose surroundings it includes.

A pair of 3.3 megapixels matched whole took 151 bytes a pixel, each further pixel 164. Tiles of 1792 pixels of 25
megapixels took 520 MB besides the program. What grows with the image: removal of isolated
patches (11 bytes a pixel), putting together (one array at a time, 12 bytes), and in images without texture, where
displacements are anything, the features of the other one (8 bytes); planes of textureless regions (6 bytes, and 18 more
where there are large ones).
"""

STEP, LEAST = 128, 256
"""Pixels: sides that are chosen are multiples of the one, and not below the other: surroundings would outweigh it."""


class Tiling(Params):
    """When a pair is matched in tiles; no result depends on it."""

    memory: int = Field(
        default=1000,
        ge=50,
        description="memory [MB] that one task of the matcher may take besides the program itself (about 300); "
        "larger pairs are matched in tiles",
    )
    tile: int | None = Field(
        default=None,
        ge=0,
        description="side of a tile [pixels] at every level; 0: pairs of any size are matched whole; not set: "
        "chosen by memory",
    )


def side(tiling: Tiling, params: HfvmParams, pyramid: PyramidParams, shapes: tuple[Shape, Shape]) -> int | None:
    """Side of the tiles of a pair of images, pixels; None: it is matched whole, as one task."""
    if tiled.is_whole(params) or tiling.tile == 0:
        return None
    # Tiles start from the maps of ``plane_level``, which both images must have: an aligned right image has as many
    # levels as the left one, and its maps would begin elsewhere than planned.
    if min(map(len, _levels(params, pyramid, shapes))) <= params.plane_level:
        return None
    chosen = tiling.tile
    if chosen is None:
        if max(s[0] * s[1] for s in shapes) * WHOLE_BYTES <= tiling.memory * 1e6:
            return None
        most = int((tiling.memory * 1e6 / TILE_BYTES) ** 0.5)
        chosen = max(most // STEP * STEP, LEAST)
    return chosen if chosen < max(*shapes[0], *shapes[1]) else None


def _levels(params: HfvmParams, pyramid: PyramidParams, shapes: tuple[Shape, Shape]) -> tuple[list[Shape], ...]:
    """Rows and columns of the levels at which the left and the right image are matched."""
    left, right = (pyramid_shapes(s, pyramid.levels, pyramid.min_side) for s in shapes)
    # Preset fast matches at half the resolution: the finest level is not read at all.
    if params.finest and min(len(left), len(right)) > params.finest:
        return left[1:], right[1:]
    return left, right


class Tiles:
    """The nodes of one pair. ``shapes``: rows and columns of the left and the right image."""

    def __init__(
        self,
        graph: Graph,
        params: HfvmParams,
        pyramid: PyramidParams,
        images: dict[str, Handle],
        shapes: tuple[Shape, Shape],
        side: int,
        label: str,
    ) -> None:
        self.graph, self.params, self.images, self.side, self.label = graph, params, images, side, label
        left, right = _levels(params, pyramid, shapes)
        self.left = left
        m = margin(left[0])
        self.right = [right, pyramid_shapes((left[0][0] + 2 * m, left[0][1] + 2 * m), len(left))]

    def build(self) -> Handle:
        """Add all of them; the last one has the disparities."""
        self.coarse = self._node("coarse", "coarse", {})
        maps: dict[str, list[Handle]] = {}
        inputs: dict[str, Handle | list[Handle]] = {"coarse": self.coarse}
        for level in range(self.params.plane_level - 1, -1, -1):
            maps = {
                way: self._tiles("level", f"{level}/{way}", {"level": level, "way": way}, **inputs)
                for way in ("left", "right")
            }
            inputs |= {f"{way}_map": maps[way] for way in maps}
            if level > 0:
                inputs["band"] = self._node("band", f"band/{level}", {"level": level}, **inputs)
        facts = {k: v for k, v in inputs.items() if k in ("coarse", "band")}
        fine = self._tiles("fine", "fine/left", {"way": "left"}, left_map=maps["left"], **facts)
        back = self._tiles("fine", "fine/right", {"way": "right"}, right_map=maps["right"], **facts)
        checked = self._tiles("check", "check", {}, fine=fine, back=back, **facts)
        refined = self._tiles("refine", "refine", {}, checked=checked, **facts)
        patches = self._node("patches", "patches", {}, left_map=maps["left"], refined=refined, **facts)
        final = self._tiles("final", "final", {}, fine=fine, checked=checked, refined=refined, patches=patches, **facts)
        args = {"side": self.side}
        given: dict[str, Handle | list[Handle]] = {**self.images, "coarse": self.coarse, "tiles": final}
        return self.graph.node(join_stage.STAGE, self.label, self.params, args, {}, given)

    def _tiles(self, step: str, label: str, args: dict[str, Any], **inputs: Handle | list[Handle]) -> list[Handle]:
        count = self._count(args.get("level", 0), args.get("way", "left"))
        return [self._node(step, f"{label}/{k}", {**args, "tile": k}, **inputs) for k in range(count)]

    def _count(self, level: int, way: str) -> int:
        """Tiles of a level; of the right image whether it will be aligned or not."""
        if way == "left":
            return len(tiles(self.left[level], self.side))
        return max(len(tiles(shapes[level], self.side)) for shapes in self.right if level < len(shapes))

    def _node(self, step: str, label: str, args: dict[str, object], **inputs: Handle | list[Handle]) -> Handle:
        args = {"step": step, "side": self.side, **args}
        return self.graph.node(
            tile_stage.STAGE, f"{self.label}/{label}", self.params, args, {}, {**self.images, **inputs}
        )
