"""Image pairs to measure on: given ones, Middlebury's, the simulator's, and larger or longer ones for timing."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .measures import Truth

Grey = NDArray[np.uint8]
CHOSEN = ("motorcycle", "Baby1", "Cloth1", "Lampshade1", "Midd1")
JUDGED = ("cones", "Bowling1", "Monopoly", "Rocks1", "Wood1")
"""Pairs that settings were chosen with, and pairs that had no part in it."""
STEP = 16
"""OpenCV's matchers search a multiple of 16 disparities."""


@dataclass(frozen=True)
class Pair:
    """Two grey images of one size, the truth where known, and the disparities that a search along rows needs.

    ``low, high``: least and greatest disparity, left minus right, pixels.
    """

    name: str
    left: Grey
    right: Grey
    truth: Truth | None
    low: int
    high: int

    @property
    def range(self) -> tuple[int, int]:
        """Least disparity and number of disparities, widened to OpenCV's steps."""
        return self.low, -(-(self.high - self.low + 1) // STEP) * STEP

    @property
    def parallel(self) -> bool:
        """Whether the truth is known and has no row disparities."""
        return self.truth is not None and not self.truth.v[self.truth.known].any()

    @property
    def size(self) -> str:
        """Width and height in words."""
        return f"{self.left.shape[1]} x {self.left.shape[0]}"

    def searching(self, count: int) -> Pair:
        """The same pair with the disparities 0 to ``count`` - 1 to search."""
        return replace(self, low=0, high=count - 1)


def measured(name: str, left: Grey, right: Grey, truth: Truth, high: int | None = None) -> Pair:
    """Pair with truth; the range is the truth's (the row matchers are told, HFVM is not)."""
    d = -truth.u[np.isfinite(truth.u)]
    if not d.size:
        raise SystemExit(f"{name}: the truth has no valid pixel")
    if left.shape != right.shape or truth.u.shape != left.shape:
        raise SystemExit(f"{name}: sizes differ: left {left.shape}, right {right.shape}, truth {truth.u.shape}")
    low = min(0, int(np.floor(d.min())) - 1)
    return Pair(name, left, right, truth, low, int(np.ceil(d.max())) + 1 if high is None else high - 1)


def read_image(path: Path) -> Grey:
    """Image file as 8-bit grey."""
    from rille.datasets.images.files import read_grey

    image = read_grey(path)
    return np.asarray(image if image.dtype == np.uint8 else np.rint(image / 257.0), np.uint8)


def read_truth(path: Path, scale: float | None = None) -> Truth:
    """Truth file: disparities left minus right, a parallel rig's; 0 or not finite where unknown.

    ``.npz`` (its only array, or ``disparity``), ``.npy``, PFM, 8- or 16-bit PNG. Stored values are divided by
    ``scale``; default 256 for 16-bit files, 1 otherwise. An ``.npz`` with ``column`` and ``row``, as ``rille export``
    writes it, has vectors right minus left.
    """
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            if {"column", "row"} <= set(arrays.files):
                return Truth(arrays["column"].astype(np.float64), arrays["row"].astype(np.float64))
            name = "disparity" if "disparity" in arrays.files else arrays.files[0]
            stored = arrays[name]
    else:
        stored = np.load(path) if path.suffix == ".npy" else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 2:
        raise SystemExit(f"{path}: not a disparity map (row, col) in a known form")
    d = stored.astype(np.float64) / (scale or (256.0 if stored.dtype == np.uint16 else 1.0))
    return parallel(np.where(np.isfinite(d) & (d > 0), d, np.nan))


def parallel(disparity: NDArray[np.float64]) -> Truth:
    """Truth of a rectified pair."""
    return Truth(-disparity, np.where(np.isfinite(disparity), 0.0, np.nan))


def with_truth() -> list[Pair]:
    """The default pairs: motorcycle and cones (where RILLE_DATA has them), the first pair of the mockup."""
    return [*_middlebury(), mockup()]


def halves() -> dict[str, list[Pair]]:
    """Middlebury's ten pairs: ``chosen`` and ``judged``."""
    found = {pair.name: pair for pair in _middlebury()}
    folder = _data("middlebury0506") or Path("-")
    for name in (*CHOSEN, *JUDGED):
        if (folder / name).is_dir():
            files = [folder / name / f"{part}.png" for part in ("view1", "view5", "disp1")]
            found[name] = measured(name, read_image(files[0]), read_image(files[1]), read_truth(files[2], 3.0))
    missing = [name for name in (*CHOSEN, *JUDGED) if name not in found]
    if missing:
        raise SystemExit(f"RILLE_DATA holds no {', '.join(missing)}")
    return {half: [found[n] for n in names] for half, names in (("chosen", CHOSEN), ("judged", JUDGED))}


def _middlebury() -> list[Pair]:
    found = []
    if (folder := _data("motorcycle")) is not None:
        files = [folder / f"motorcycle_{name}" for name in ("left.png", "right.png", "disp.npz")]
        found.append(measured("motorcycle", read_image(files[0]), read_image(files[1]), read_truth(files[2])))
    if (folder := _data("cones")) is not None:
        files = [folder / f"cones_{name}.png" for name in ("image_02", "image_06", "disp_02")]
        found.append(measured("cones", read_image(files[0]), read_image(files[1]), read_truth(files[2], 4.0)))
    return found


def mockup() -> Pair:
    """First pair of the built-in simulator, 570 x 520 as in the paper, and its exact truth."""
    from rille.datasets.registry import open_sequence
    from rille.pipeline.runs.options import cache_folder

    sequence, fetch = open_sequence("mockup"), fetcher(cache_folder(None))
    assert sequence.truth_disparity is not None
    left, right = (np.asarray(fetch(sequence.image(0, c))["image"]) for c in ("left", "right"))
    exact = fetch(sequence.truth_disparity(0))
    u, v = (np.asarray(exact[name], np.float64) for name in ("column_disparity", "row_disparity"))
    return measured("mockup", left, right, Truth(u, v))


def street() -> Pair | None:
    """First pair of the KITTI street, without truth."""
    if (folder := _data("kitti06_51")) is None:
        return None
    left, right = (read_image(folder / f"image_{side}" / "000000.png") for side in "lr")
    return Pair("street", left, right, None, 0, 127)


def enlarged(pair: Pair, pixels: float = 1.4e6) -> Pair:
    """Both images enlarged by bicubic interpolation to about ``pixels``; the truth is dropped."""
    factor = (pixels / pair.left.size) ** 0.5
    size = tuple(round(factor * s) for s in pair.left.shape[::-1])
    left, right = (cv2.resize(i, size, interpolation=cv2.INTER_CUBIC) for i in (pair.left, pair.right))
    return Pair(f"{pair.name} x {factor:.3f}", left, right, None, 0, int(np.ceil(factor * pair.high)))


def unrelated(pairs: list[Pair]) -> list[Pair]:
    """Pairs that have nothing in common: the first two pairs' left and right image, and noise of two seeds."""
    found = []
    if len(pairs) >= 2:
        rows, cols = np.minimum(pairs[0].left.shape, pairs[1].left.shape)
        cut = np.s_[:rows, :cols]
        name = f"left of {pairs[1].name}, right of {pairs[0].name}"
        found.append(Pair(name, pairs[1].left[cut].copy(), pairs[0].right[cut].copy(), None, 0, 127))
    shape = (375, 450)
    left, right = (np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8) for seed in (1, 2))
    return [*found, Pair("noise of two seeds", left, right, None, 0, 127)]


def _data(name: str) -> Path | None:
    folder = Path(os.environ.get("RILLE_DATA") or "-") / name
    return folder if folder.is_dir() else None


def fetcher(cache: Path) -> Callable[[Any], Any]:
    """Function that computes a source once and then reads it from the cache."""
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.engine.task import Spec, ensure

    def artifact(source: Any) -> Any:
        refs = {port: artifact(upstream) for port, upstream in source.inputs.items()}
        label = source.module.rsplit(".", 1)[-1]
        return ensure(cache, Spec(source.module, label, source.params, source.args, source.hints), refs).ref

    return lambda source: Store(cache).open(artifact(source))
