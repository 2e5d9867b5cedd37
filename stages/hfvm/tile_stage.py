"""One step of matching a large pair, for one tile: what :mod:`rille.stages.hfvm.tiled` composes, as tasks.

``args``: ``step``, ``side`` (pixels of a tile), ``tile`` (its number in reading order) and, where there is a choice,
``level`` and ``way`` (``left``: of the left image onto the right one, or ``right``). Tiles of all levels have the same
side. The right image may have been aligned, and so have more or fewer tiles than planned: those beyond are empty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rille.stages.core.declare import AnyArray, Array, Bundle, Inputs, Stage
from rille.stages.core.errors import InputError
from rille.stages.hfvm import tiled
from rille.stages.hfvm.coarse_to_fine import hierarchy
from rille.stages.hfvm.coarse_to_fine.hierarchy import Band, Map, Prepared, State
from rille.stages.hfvm.finish import textureless
from rille.stages.hfvm.finish.finish import Finish
from rille.stages.hfvm.images import brightness
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import Aligned, Plain, View
from rille.stages.hfvm.images.window import Mosaic, Results, Shape, Window, tiles
from rille.stages.hfvm.stage import OUTPUTS

MAP = ("u", "v", "undefined")


def views(inputs: Inputs, params: HfvmParams) -> tuple[View, View, bool]:
    """Both images, at the resolution at which they are matched, and whether that is half of theirs."""
    opened = []
    for port in ("left", "right"):
        bundle: Bundle = inputs[port]
        names = range(int(bundle.meta["levels"]))
        opened.append(
            Plain.open(
                [bundle.raster(f"level_{n}") for n in names],
                [bundle.raster(f"valid_{n}") for n in names],
                float(bundle.meta.get("noise", 0.0)),
            )
        )
    if not tiled.halves(opened[0], opened[1], params):
        return opened[0].quiet(params), opened[1].quiet(params), False
    return opened[0].halved().quiet(params), opened[1].halved().quiet(params), True


@dataclass(frozen=True)
class Agreeing:
    """Which left pixels of a level are consistent, as a raster: found out for each window that is asked for."""

    pair: Prepared
    level: int
    a: Map
    b: Map

    @property
    def shape(self) -> Shape:
        """Rows and columns."""
        return self.pair.shapes(self.level)[0]

    def __getitem__(self, at: tuple[slice, slice]) -> AnyArray:
        """Values of two slices without steps."""
        rows, cols = at
        window = Window(rows.start, rows.stop, cols.start, cols.stop)
        return hierarchy.consistent(self.pair, self.level, self.a, self.b, window)


@dataclass(frozen=True)
class TileInputs:
    """The inputs of one task, opened; the right image in the left one's brightness, as far as that is known."""

    params: HfvmParams
    args: Mapping[str, Any]
    inputs: Inputs
    left: View
    right: View
    half: bool

    @staticmethod
    def of(params: HfvmParams, args: Mapping[str, Any], inputs: Inputs) -> TileInputs:
        """Open what a task has been given."""
        left, right, half = views(inputs, params)
        ratio = inputs["coarse"].meta["ratio"] if "coarse" in inputs else None
        right = brightness.levelled(right, None if ratio is None else np.array(ratio))
        return TileInputs(tiled.halved_params(params) if half else params, args, inputs, left, right, half)

    @property
    def facts(self) -> Mapping[str, Any]:
        """Facts of step ``coarse``: alignment, contrast, brightness ratio, band."""
        meta: Mapping[str, Any] = self.inputs["coarse"].meta
        return meta

    @property
    def alignment(self) -> AnyArray | None:
        """Homography of the right image, or None."""
        h = self.facts["alignment"]
        return None if h is None else np.array(h)

    def pair(self) -> Prepared:
        """The matcher of the left image and the right one, aligned if it is."""
        right: View = self.right
        h = self.alignment
        if h is not None:
            right = Aligned.again(self.right, h, self.left, self.facts["blank"])
        return tiled.prepare(self.left, right, self.params, self.args["side"])

    def mosaic(self, port: str, name: str, shape: Shape) -> Mosaic:
        """An array of tiles that other tasks have made."""
        return mosaic(self.inputs[port], name, shape, self.args["side"])

    def rasters(self, port: str, names: Sequence[str], shape: Shape) -> dict[str, Mosaic]:
        """Several arrays of tiles, by name."""
        return {name: self.mosaic(port, name, shape) for name in names}

    def map(self, port: str, shape: Shape) -> Map:
        """An integer map of tiles."""
        return Map(*(self.mosaic(port, f"map_{name}", shape) for name in MAP))

    def state(self, pair: Prepared, level: int) -> State:
        """Return both displacement maps of a level, their consistent pixels, the epipolar band and the sign of depth.

        All of the finest level that step ``coarse`` matched is read from its result. Of a finer level the maps are read
        from the tiles, band and sign from step ``band``; without that input there is no band, and the sign is that of
        step ``coarse``.
        """
        coarse: Bundle = self.inputs["coarse"]
        if level == coarse.meta["level"]:
            maps = [Map(*(coarse.raster(f"{way}_{name}") for name in MAP)) for way in ("left", "right")]
            oks = [coarse.raster(f"{way}_ok") for way in ("left", "right")]
            return State(level, maps[0], maps[1], oks[0], oks[1], band(coarse.meta), coarse.meta["near_sign"])
        a, b = (self.map(f"{way}_map", shape) for way, shape in zip(("left", "right"), pair.shapes(level), strict=True))
        ok = Agreeing(pair, level, a, b), Agreeing(pair.reverse(), level, b, a)
        meta = self.inputs["band"].meta if "band" in self.inputs else {**coarse.meta, "f": None}
        return State(level, a, b, ok[0], ok[1], band(meta), meta["near_sign"])

    def finish(self) -> Finish:
        """Steps of the finest level."""
        facts = self.inputs["band"].meta if "band" in self.inputs else self.facts
        known = self.alignment, facts["near_sign"], self.facts["contrast"]
        return Finish(self.pair(), self.right, self.params, *known)

    def window(self, shape: Shape) -> Window | None:
        """The task's tile of an image of ``shape``; None: beyond the last one."""
        windows = tiles(shape, self.args["side"])
        return windows[self.args["tile"]] if self.args["tile"] < len(windows) else None


def mosaic(parts: Sequence[Bundle], name: str, shape: Shape, side: int) -> Mosaic:
    """An array of tiles that other tasks have made.

    Raises
    ------
    InputError
        There are fewer than the image asks for.
    """
    windows = tiles(shape, side)
    if len(parts) < len(windows):
        raise InputError(
            "RIL-351",
            f"image of {shape[1]} x {shape[0]} pixels does not have the size that its camera states",
            remedy="correct the camera's width and height",
        )
    return Mosaic(shape, windows, [part.raster(name) for part in parts[: len(windows)]])


def band(meta: Mapping[str, Any]) -> Band:
    """Return the soft epipolar band that metadata describe."""
    return hierarchy.FREE if meta["f"] is None else Band(np.array(meta["f"]), meta["mu"])


def told(state: State) -> dict[str, Any]:
    """Band and sign as metadata."""
    return {
        "f": None if state.band is hierarchy.FREE else state.band.f.tolist(),
        "mu": float(state.band.mu),
        "near_sign": float(state.near_sign),
    }


def _coarse(task: TileInputs) -> Bundle:
    found = tiled.coarse(task.left, task.right, task.params, task.args["side"])
    s = found.state
    arrays: Results = {}
    for way, m, ok in (("left", s.left, s.left_ok), ("right", s.right, s.right_ok)):
        arrays |= {f"{way}_u": m.u, f"{way}_v": m.v, f"{way}_undefined": m.undefined.view(np.uint8)}
        arrays[f"{way}_ok"] = np.asarray(ok).view(np.uint8)
    meta = {
        "level": s.level,
        "alignment": None if found.alignment is None else found.alignment.tolist(),
        "aligned": found.alignment is not None,
        "blank": found.aligned.blank if found.aligned else 0.0,
        "contrast": float(found.contrast),
        "ratio": None if found.ratio is None else found.ratio.tolist(),
    }
    return Bundle(arrays, meta | told(s))


def _level(task: TileInputs) -> Bundle:
    pair, level = task.pair(), task.args["level"]
    above = task.state(pair, level + 1)
    if task.args["way"] == "right":
        pair, above = pair.reverse(), above.reverse()
    window = task.window(pair.shapes(level)[0])
    if window is None:
        nothing = np.zeros((0, 0), np.int16)
        return Bundle({"map_u": nothing, "map_v": nothing, "map_undefined": nothing.astype(np.uint8)}, {})
    found = hierarchy.level_tile(pair, level, window, above)
    found["undefined"] = found["undefined"].astype(np.uint8)
    return Bundle({f"map_{name}": np.ascontiguousarray(a) for name, a in found.items()}, {})


def _band(task: TileInputs) -> Bundle:
    pair = task.pair()
    # Where no band can be fitted there is to be none, as in memory, and not the one of the level above.
    state = replace(task.state(pair, task.args["level"]), band=hierarchy.FREE)
    return Bundle({}, told(hierarchy.with_band(pair, state)))


def _fine(task: TileInputs) -> Bundle:
    steps = task.finish()
    shapes = steps.pair.shapes(0)
    if task.args["way"] == "left":
        window = task.window(shapes[0])
        assert window is not None
        return Bundle(steps.fine(window, task.map("left_map", shapes[0])), {})
    window = task.window(shapes[1])
    if window is None:
        nothing = np.zeros((0, 0), np.float32)
        return Bundle({"u": nothing, "v": nothing}, {})
    return Bundle(steps.back(window, task.map("right_map", shapes[1])), {})


def _check(task: TileInputs) -> Bundle:
    steps = task.finish()
    shapes, window = steps.pair.shapes(0), task.window(steps.shape)
    assert window is not None
    fine = task.rasters("fine", ("u", "v", "distance"), shapes[0])
    return Bundle(steps.check(window, fine, task.rasters("back", ("u", "v"), shapes[1])), {})


def _refine(task: TileInputs) -> Bundle:
    steps = task.finish()
    window = task.window(steps.shape)
    assert window is not None
    return Bundle(steps.refine(window, task.rasters("checked", ("u", "v", "validity"), steps.shape)), {})


def _patches(task: TileInputs) -> Bundle:
    steps = task.finish()
    refined = task.rasters("refined", ("u", "v", "validity"), steps.shape)
    gone = steps.patches(task.map("left_map", steps.shape), refined)
    planes = steps.planes(refined, gone)
    if planes is None:
        return Bundle({"gone": gone}, {"planes": None})
    meta = {"planes": {"terms": planes.terms, "f": planes.f.tolist()}}
    return Bundle({"gone": gone, "region": np.asarray(planes.region)}, meta)


def _planes(patches: Bundle) -> textureless.Planes | None:
    """What step ``patches`` found."""
    facts = patches.meta["planes"]
    if facts is None:
        return None
    return textureless.Planes(patches.raster("region"), facts["terms"], np.array(facts["f"]))


def _final(task: TileInputs) -> Bundle:
    steps = task.finish()
    shape, window = steps.shape, task.window(steps.shape)
    assert window is not None
    found = steps.final(
        window,
        task.rasters("fine", ("distance",), shape),
        task.rasters("checked", ("error",), shape),
        task.rasters("refined", ("u", "v", "validity", "noise"), shape),
        task.inputs["patches"].raster("gone"),
        _planes(task.inputs["patches"]),
    )
    if task.half:
        left, right = (task.inputs[port].raster("level_0").shape for port in ("left", "right"))
        mask = task.inputs["left"].raster("valid_0")
        found = tiled.enlarged(found, task.alignment, mask, window.child(left), right)
    return Bundle(found, {})


STEPS: Mapping[str, Callable[[TileInputs], Bundle]] = {
    "coarse": _coarse,
    "level": _level,
    "band": _band,
    "fine": _fine,
    "check": _check,
    "refine": _refine,
    "patches": _patches,
    "final": _final,
}


def _run(params: HfvmParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    return STEPS[args["step"]](TileInputs.of(params, args, inputs))


_GRID = ("row", "col")
_PARTS = (
    *(
        Array(f"{way}{name}", _GRID, kind, unit, about, optional=True)
        for way in ("left_", "right_")
        for name, kind, unit, about in (
            ("u", "int16", "px", "columns of displacement at a level"),
            ("v", "int16", "px", "rows of displacement at a level"),
            ("undefined", "uint8", "1", "1 = nothing was matchable"),
            ("ok", "uint8", "1", "1 = consistent"),
        )
    ),
    Array("u", _GRID, "float32", "px", "columns of displacement", optional=True),
    Array("v", _GRID, "float32", "px", "rows of displacement", optional=True),
    Array("map_u", _GRID, "int16", "px", "columns of displacement at a level", optional=True),
    Array("map_v", _GRID, "int16", "px", "rows of displacement at a level", optional=True),
    Array("map_undefined", _GRID, "uint8", "1", "1 = nothing was matchable", optional=True),
    Array("distance", _GRID, "float32", "1", "least feature distance", optional=True),
    Array("validity", _GRID, "uint8", "1", "bits that speak against a pixel", optional=True),
    Array("error", _GRID, "float32", "px", "error of matching there and back", optional=True),
    Array("noise", _GRID, "float32", "px", "variance by noise, squared pixels", optional=True),
    Array("gone", _GRID, "uint8", "1", "1 = in an isolated patch", optional=True),
    Array("region", _GRID, "int8", "1", "number of the textureless region, at half the resolution", optional=True),
)
_OPTIONAL = tuple(replace(a, optional=True) for a in OUTPUTS if a.name not in ("distance", "validity"))
STAGE = Stage(
    name="hfvm_tile",
    version=1,
    summary="one step of matching a large stereo pair, for one tile",
    params=HfvmParams,
    inputs=(
        *("left", "right", "coarse?", "band?", "left_map*?", "right_map*?", "fine*?", "back*?", "checked*?"),
        *("refined*?", "patches?"),
    ),
    outputs=(*_PARTS, *_OPTIONAL),
    run=_run,
)
