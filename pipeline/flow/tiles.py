"""Tiles of large pairs: which pairs are matched in tiles, how large these are, and the tasks of one pair."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

from rille.pipeline.engine import memory
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.runtime.environment import cores
from rille.stages.core.declare import Params
from rille.stages.hfvm import coarse, matcher
from rille.stages.hfvm.image import Shape, tiles
from rille.stages.hfvm.matcher import MatchOptions, Tell, silent
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.tiles.join_stage import hfvm_join_stage
from rille.stages.hfvm.tiles.tile_stage import hfvm_tile_stage
from rille.stages.imaging.pyramid import PyramidParams, levels_of

WHOLE_BYTES, TILE_BYTES = 170, 300
"""Memory for matching, bytes a pixel: of images that are matched whole, and of a tile, its surroundings included.

A pair of 3.3 megapixels matched whole took 151 bytes a pixel, each further pixel 164. Tiles of 1792 pixels of 25
megapixels took 520 MB besides the program. These grow with the image: removal of isolated patches (11 bytes a pixel),
putting together (one array at a time, 12 bytes), the features of the other image where displacements reach all over it,
as without texture (8 bytes), and planes of textureless regions (6 bytes, 18 more if these are large).
"""


class Tiling(Params):
    """When a pair is matched in tiles; 99.9 % of the pixels are within .01 px of the untiled result.

    Attributes
    ----------
    memory : memory [MB] that one task of the matcher may take besides the program itself (about 300); larger pairs are
        matched in tiles.
    tile : side of a tile [pixels] at every level, at least 64; 0: pairs of any size are matched whole; not set: chosen
        by memory.
    """

    memory: int = Field(1000, ge=50)
    tile: int | None = Field(None, ge=0)

    @field_validator("tile")
    @classmethod
    def _no_mere_surroundings(cls, side: int | None) -> int | None:
        # Each tile is matched with surroundings of some hundred pixels.
        if side is not None and 0 < side < 64:
            raise ValueError("0, or at least 64")
        return side


def side(tiling: Tiling, params: HfvmParams, pyramid: PyramidParams, shapes: tuple[Shape, Shape]) -> int | None:
    """Side of the tiles of a pair of images, pixels; None: it is matched whole, as one task."""
    if not matcher.local(params) or tiling.tile == 0:
        return None
    # Tiles start from the maps of level 1, which the decisions on brightness and alignment precede.
    if min(levels_of(shape, pyramid) - _half(params) for shape in shapes) <= coarse.COARSE_LEVEL:
        return None
    chosen = tiling.tile
    if chosen is None:
        if max(s[0] * s[1] for s in shapes) * WHOLE_BYTES <= tiling.memory * 1e6:
            return None
        most = int((tiling.memory * 1e6 / TILE_BYTES) ** 0.5)
        # Below 256 pixels surroundings outweigh the tile.
        chosen = max(most // 128 * 128, 256)
    return chosen if chosen < max(*shapes[0], *shapes[1]) else None


def match_options(
    tiling: Tiling, params: HfvmParams, pyramid: PyramidParams, shapes: tuple[Shape, Shape], tell: Tell = silent
) -> MatchOptions:
    """Options of a match by this process alone: on all of its cores, as far as memory permits."""
    size = side(tiling, params, pyramid, shapes)
    # Both directions side by side, or as many tiles as fit.
    most = 2 if size is None else int(memory.free() / (tiling.memory * 1e6))
    return MatchOptions(tell, size, max(1, min(cores(), most)))


def _half(params: HfvmParams) -> int:
    """Levels that are left out at the fine end."""
    return int(matcher.RECIPES[params.preset].half)


def build(graph: Graph, params: HfvmParams, images: dict[str, Handle], shape: Shape, side: int, label: str) -> Handle:
    """Add the nodes of one pair; the last one has the disparities. ``shape``: rows and columns of the left image."""
    rows, cols = ((n + 1) // 2 if _half(params) else n for n in shape)
    count = len(tiles((rows, cols), side))

    def node(step: str, name: str, **given: Any) -> Handle:
        return graph.call(hfvm_tile_stage, f"{label}/{name}", params, step=step, side=side, **images, **given)

    def every_tile(step: str, **inputs: Handle | list[Handle]) -> list[Handle]:
        return [node(step, f"{step}/{k}", tile=k, **inputs) for k in range(count)]

    coarse = node("coarse", "coarse")
    fine = every_tile("fine", coarse=coarse)
    ending = node("ending", "ending", coarse=coarse, fine=fine)
    final = every_tile("final", coarse=coarse, fine=fine, ending=ending)
    return graph.call(hfvm_join_stage, label, params, side=side, **images, coarse=coarse, tiles=final)
