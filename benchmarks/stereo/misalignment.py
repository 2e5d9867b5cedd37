"""A right camera that was knocked: the image warped by cubic splines, the truth carried along, and the curve of both.

The true counterpart of each left pixel moves with the right image: column and row of the warped one. Matchers along
rows are judged on the column alone, HFVM on the whole vector.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.images.misalign import MisalignParams, warp
from rille.stages.geometry.geometry import Camera, rotation_exp
from rille.stages.geometry.lens import Lens

from .measures import Truth, judge
from .methods import Method
from .pairs import Pair, measured

SHIFTS = (0.0, 1.0, 2.0, 3.0, 4.0)
ROLLS = (0.0, 0.5, 1.0, 2.0)


def conditions() -> list[MisalignParams]:
    """Vertical shifts in pixels, then rolls in degrees; the aligned case once."""
    return [*(MisalignParams(rows=s) for s in SHIFTS), *(MisalignParams(roll_deg=r) for r in ROLLS[1:])]


def label(params: MisalignParams) -> str:
    """Column heading of a condition."""
    if params.none:
        return "aligned"
    return f"roll {params.roll_deg:g} deg" if params.roll_deg else f"shift {params.rows:g} px"


def camera_of(pair: Pair) -> Camera:
    """A camera with its centre in the image's; the focal length does not matter to shift and roll."""
    rows, cols = pair.right.shape
    return Camera(float(cols), float(cols), 0.5 * (cols - 1), 0.5 * (rows - 1), cols, rows)


def knocked(pair: Pair, params: MisalignParams) -> Pair:
    """The pair as the knocked camera would have taken it, and its truth."""
    if params.none or pair.truth is None:
        return pair
    camera = camera_of(pair)
    right, _ = warp(pair.right, np.ones(pair.right.shape, np.uint8), Lens(camera), params)
    y, x = np.mgrid[: pair.left.shape[0], : pair.left.shape[1]].astype(np.float64)
    turn = rotation_exp(np.deg2rad([params.pitch_deg, params.yaw_deg, params.roll_deg]))
    pixels = np.stack([x + pair.truth.u, y + pair.truth.v], axis=-1).reshape(-1, 2)
    known = np.isfinite(pixels).all(axis=1)
    moved = np.full(pixels.shape, np.nan)
    moved[known] = camera.project(camera.rays(pixels[known]) @ turn.T)
    moved[known, 1] += params.rows
    truth = Truth(moved[:, 0].reshape(x.shape) - x, moved[:, 1].reshape(x.shape) - y)
    return measured(f"{pair.name}, {label(params)}", pair.left, np.asarray(right), truth)


def curve(pairs: Iterable[Pair], methods: Iterable[Method], say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Figures of every pair, condition and method."""
    found = []
    for pair in pairs:
        for params in conditions():
            case = knocked(pair, params)
            assert case.truth is not None
            say(case.name)
            for method in methods:
                figures = judge(method(case), case.truth)
                found.append(
                    {"pair": pair.name, "condition": label(params), "rows": params.rows, "roll_deg": params.roll_deg}
                    | {"method": method.name, **figures}
                )
    return found


COLOURS = ("#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")


def picture(found: list[dict[str, Any]], path: Path) -> None:
    """Draw the share of bad pixels over shift and over roll, a row of axes for each pair."""
    from matplotlib import pyplot as plt

    pairs = list(dict.fromkeys(f["pair"] for f in found))
    names = list(dict.fromkeys(f["method"] for f in found))
    figure, axes = plt.subplots(
        len(pairs),
        2,
        figsize=(7.6, 2.5 * len(pairs) + 0.5),
        sharex="col",
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    for axis_row, pair in zip(axes, pairs, strict=True):
        for axis, key, other, words in zip(
            axis_row,
            ("rows", "roll_deg"),
            ("roll_deg", "rows"),
            ("vertical shift of the right image, px", "roll of the right image, degrees"),
            strict=True,
        ):
            for i, name in enumerate(names):
                points = [f for f in found if (f["pair"], f["method"], f[other]) == (pair, name, 0.0)]
                classical = not name.startswith("HFVM")
                axis.plot(
                    [f[key] for f in points],
                    [100.0 * f["bad2"] for f in points],
                    marker="s" if classical else "o",
                    markersize=4,
                    linestyle="--" if classical else "-",
                    color="#d55e00" if classical else COLOURS[i % len(COLOURS)],
                    label=name,
                )
            axis.set_title(pair, fontsize=9)
            axis.grid(alpha=0.3)
            axis.set_ylim(bottom=0)
            if pair == pairs[-1]:
                axis.set_xlabel(words)
        axis_row[0].set_ylabel("off by more than 2 px, %")
    axes[0][0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90, pil_kwargs={"optimize": True})
    plt.close(figure)
