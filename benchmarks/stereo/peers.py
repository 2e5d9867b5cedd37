"""Matchers in environments of their own; this file is the program that their Python runs, and needs NumPy alone.

    PYTHON peers.py pandora|elas            prints name and version of the distribution
    PYTHON peers.py pandora|elas FOLDER     matches FOLDER/pair.npz, writes FOLDER/found.npz

``pair.npz``: grey images ``left`` and ``right`` (row, col), uint8; ``range``: least disparity, left minus right, and
their number. ``found.npz``: ``disparity`` (row, col), NaN without a match; ``filled``: the same with the pixels that
the matcher fills itself; ``seconds``: of the clock and of the processor, of the second call in this process.

Both lose pixels along the border of an image, so they get images in a frame of repeated border pixels. Settings are the
best of a few on the chosen half of the pairs (``pairs.CHOSEN``).
"""

from __future__ import annotations

import logging
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float64]
Matcher = tuple[Callable[[], Any], Callable[[Any], tuple[Map, Map]]]
"""What is timed, and what makes the two maps of its result."""

PANDORA = {
    "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
    "optimization": {"optimization_method": "sgm"},
    "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
    "refinement": {"refinement_method": "vfit"},
    "filter.before": {"filter_method": "median"},
    "validation": {"validation_method": "cross_checking_accurate", "interpolated_disparity": "sgm"},
    "filter.after": {"filter_method": "median"},
}
PANDORA_FRAME, ELAS_FRAME = 2, 8
SMALL_GAP = 3
"""Pixels: a gap that ELAS closes before its result counts as matched, as its preset for robots does."""


def framed(image: NDArray[Any], width: int, by: int = 0) -> NDArray[Any]:
    """The image with ``width`` repeated pixels around it; its content moved ``by`` columns to the right."""
    rows, cols = (np.arange(-width, n + width) for n in image.shape)
    return image[np.ix_(rows.clip(0, image.shape[0] - 1), (cols - by).clip(0, image.shape[1] - 1))]


def inner(found: NDArray[Any], width: int) -> NDArray[Any]:
    """What was found without the frame."""
    return found[width:-width, width:-width]


def pandora(left: NDArray[Any], right: NDArray[Any], low: int, count: int) -> Matcher:
    """CNES's Pandora: census, semi-global matching, consistency of both directions, interpolation."""
    import pandora as library
    import rasterio
    from pandora.check_configuration import check_conf
    from pandora.constants import Criteria
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.state_machine import PandoraMachine

    logging.disable(logging.WARNING)
    library.import_plugin()
    high = low + count - 1
    with tempfile.TemporaryDirectory() as folder:
        inputs = {}
        for side, image, limits in (("left", left, [-high, -low]), ("right", right, [low, high])):
            path, grey = f"{folder}/{side}.tif", framed(image, PANDORA_FRAME).astype(np.float32)
            rows, cols = grey.shape
            with rasterio.open(path, "w", "GTiff", width=cols, height=rows, count=1, dtype="float32") as file:
                file.write(grey, 1)
            inputs[side] = {"img": path, "nodata": -9999, "disp": limits}
        machine = PandoraMachine()
        plan = check_conf({"input": inputs, "pipeline": PANDORA}, machine)
        images = [create_dataset_from_inputs(plan["input"][side]) for side in ("left", "right")]

    def read(raw: Any) -> tuple[Map, Map]:
        d, flags = (inner(raw[name].data, PANDORA_FRAME) for name in ("disparity_map", "validity_mask"))
        invalid, *filled = (
            (flags & int(getattr(Criteria, f"PANDORA_MSK_PIXEL_{name}"))) != 0
            for name in ("INVALID", "FILLED_OCCLUSION", "FILLED_MISMATCH")
        )
        dense = np.where(invalid, np.nan, -d)
        return np.where(filled[0] | filled[1], np.nan, dense), dense

    return lambda: library.run(machine, *images, plan)[0], read


def elas(left: NDArray[Any], right: NDArray[Any], low: int, count: int) -> Matcher:
    """Libelas with its preset for Middlebury, as pyelas has it.

    The preset fills everything. What counts as matched comes from a call that closes small gaps alone and sets no
    corners; the timed one is the preset's own.
    """
    import elas as library

    # It knows no negative disparities.
    images = [np.ascontiguousarray(framed(i, ELAS_FRAME, by)) for i, by in ((left, 0), (right, low))]

    def match(change: dict[str, Any]) -> Any:
        matcher = library.Elas()
        matcher.set_preset(library.PRESET_MIDDLEBURY)
        for name, value in ({"disp_min": 0, "disp_max": count - 1} | change).items():
            setattr(matcher, name, value)
        return matcher.process(*images)[0]

    def disparity(raw: Any) -> Map:
        return inner(np.where(raw >= 0, raw.astype(np.float64) + low, np.nan), ELAS_FRAME)

    matched = {"ipol_gap_width": SMALL_GAP, "add_corners": False}
    return lambda: match({}), lambda raw: (disparity(match(matched)), disparity(raw))


MATCHERS = {"pandora": (pandora, "pandora"), "elas": (elas, "pyelas")}
"""Function and name of the distribution."""


def main(name: str, folder: str | None = None) -> None:
    """Match the pair in the folder, or tell the version."""
    matcher, distribution = MATCHERS[name]
    if folder is None:
        print(f"{distribution} {version(distribution)}")
        return
    with np.load(f"{folder}/pair.npz") as pair:
        low, count = map(int, pair["range"])
        run, read = matcher(pair["left"], pair["right"], low, count)
    run()
    start, start_cpu = time.perf_counter(), time.process_time()
    raw = run()
    seconds = time.perf_counter() - start, time.process_time() - start_cpu
    disparity, filled = read(raw)
    np.savez(f"{folder}/found.npz", disparity=disparity, filled=filled, seconds=seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
