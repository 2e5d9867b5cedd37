"""Matchers behind one interface: OpenCV's, Pandora's where installed, and HFVM in every preset."""

from __future__ import annotations

import importlib.util
import inspect
import json
import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from .measures import Found
from .pairs import Pair

BLOCK = 3
CAP = 31


@dataclass(frozen=True)
class Method:
    """A matcher; ``run`` is timed, ``read`` makes a :class:`Found` of what it gave."""

    name: str
    run: Callable[[Pair], Any]
    read: Callable[[Any, Pair], Found]

    def __call__(self, pair: Pair) -> Found:
        """Match a pair."""
        return self.read(self.run(pair), pair)


def set_threads(count: int) -> None:
    """Threads of OpenCV and numba; the process must have been started with at least as many for numba."""
    import numba

    cv2.setNumThreads(count)
    numba.set_num_threads(count)


def opencv() -> list[Method]:
    """Semi-global matching in three and eight directions, and block matching.

    Block 3, pre-filter 31, uniqueness 10 %, speckles of 100 pixels: of blocks 3, 5, 7, caps 31 and 63 and uniqueness
    5 and 10 % the best on motorcycle and cones together.
    """
    smooth = {"P1": 8 * BLOCK**2, "P2": 32 * BLOCK**2}
    clean = {"disp12MaxDiff": 1, "uniquenessRatio": 10, "speckleWindowSize": 100, "speckleRange": 2}

    def semiglobal(mode: int) -> Callable[[Pair], Any]:
        def run(pair: Pair) -> Any:
            low, count = pair.range
            matcher = cv2.StereoSGBM_create(low, count, BLOCK, preFilterCap=CAP, mode=mode, **smooth, **clean)
            return matcher.compute(*_padded(pair))

        return run

    def block(pair: Pair) -> Any:
        low, count = pair.range
        matcher = cv2.StereoBM_create(count, 15)
        matcher.setMinDisparity(low)
        matcher.setDisp12MaxDiff(clean["disp12MaxDiff"])
        matcher.setSpeckleWindowSize(clean["speckleWindowSize"])
        matcher.setSpeckleRange(clean["speckleRange"])
        return matcher.compute(*_padded(pair))

    return [
        Method("SGBM 3WAY", semiglobal(cv2.STEREO_SGBM_MODE_SGBM_3WAY), _read_opencv),
        Method("SGBM HH", semiglobal(cv2.STEREO_SGBM_MODE_HH), _read_opencv),
        Method("BM", block, _read_opencv),
    ]


def _margins(pair: Pair) -> tuple[int, int]:
    """Columns to add left and right so that every pixel has all its candidates."""
    low, count = pair.range
    return max(0, low + count), max(0, -low)


def _padded(pair: Pair) -> tuple[NDArray[Any], NDArray[Any]]:
    before, after = _margins(pair)
    left, right = (cv2.copyMakeBorder(i, 0, 0, before, after, cv2.BORDER_REPLICATE) for i in (pair.left, pair.right))
    return left, right


def _read_opencv(raw: Any, pair: Pair) -> Found:
    before, _ = _margins(pair)
    cut = raw[:, before : before + pair.left.shape[1]]
    d = cut.astype(np.float64) / 16.0
    good = d >= pair.range[0]
    return Found(np.where(good, -d, np.nan), np.where(good, 0.0, np.nan), good, rows=False)


def pandora() -> list[Method]:
    """Census and semi-global matching of CNES's Pandora, where it and its plugin libsgm are installed.

    Census 5 x 5, SGM with the default penalties, V-fit, median, accurate cross-check, median. Its own
    interpolation is left out, since all are filled alike.
    """
    missing = [n for n in ("pandora", "pandora_plugin_libsgm") if importlib.util.find_spec(n) is None]
    if missing:
        print(f"Pandora is left out: {' and '.join(missing)} not installed (pip install 'pandora[sgm]')")
        return []
    return [Method("Pandora", _run_pandora, _read_pandora)]


PANDORA = {
    "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
    "optimization": {"optimization_method": "sgm"},
    "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
    "refinement": {"refinement_method": "vfit"},
    "filter.before": {"filter_method": "median"},
    "validation": {"validation_method": "cross_checking_accurate"},
    "filter.after": {"filter_method": "median"},
}


def _run_pandora(pair: Pair) -> Any:
    import pandora
    from pandora.check_configuration import check_conf
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.state_machine import PandoraMachine

    logging.getLogger("transitions").setLevel(logging.ERROR)
    low, count = pair.range
    high = low + count - 1
    with tempfile.TemporaryDirectory() as folder:
        inputs = {}
        for side, image, limits in zip(("left", "right"), _padded(pair), ([-high, -low], [low, high]), strict=True):
            path = f"{folder}/{side}.tif"
            cv2.imwrite(path, image.astype(np.float32))
            inputs[side] = {"img": path, "nodata": -9999, "disp": limits}
        pandora.import_plugin()
        machine = PandoraMachine()
        configuration = check_conf({"input": inputs, "pipeline": PANDORA}, machine)
        images = [create_dataset_from_inputs(configuration["input"][side]) for side in ("left", "right")]
        return pandora.run(machine, *images, configuration)[0]


def _read_pandora(raw: Any, pair: Pair) -> Found:
    from pandora.constants import Criteria

    before, _ = _margins(pair)
    cut = np.s_[:, before : before + pair.left.shape[1]]
    u = raw["disparity_map"].data[cut].astype(np.float64)
    good = ((raw["validity_mask"].data[cut] & int(Criteria.PANDORA_MSK_PIXEL_INVALID)) == 0) & np.isfinite(u)
    return Found(np.where(good, u, np.nan), np.where(good, 0.0, np.nan), good, rows=False)


def hfvm(variants: list[str], threads: int) -> list[Method]:
    """Every preset of the matcher's parameters, and variants ``key=value key=value ...`` of them."""
    from rille.stages.hfvm.images.params import HfvmParams

    presets = [str(p) for p in get_args(HfvmParams.model_fields["preset"].annotation)]
    found = [_hfvm(f"HFVM {p}", {"preset": p}, threads) for p in presets]
    for text in variants:
        values = {}
        for word in text.replace(",", " ").split():
            key, _, value = word.partition("=")
            values[key] = _value(value)
        found.append(_hfvm(f"HFVM {text}", values, threads))
    return found


def _hfvm(name: str, values: dict[str, Any], threads: int) -> Method:
    from rille.stages.core.validity import matched
    from rille.stages.hfvm.images.params import HfvmParams
    from rille.stages.hfvm.stage import match

    params = HfvmParams(**values)
    extra: dict[str, Any] = {"threads": threads} if "threads" in inspect.signature(match).parameters else {}

    def read(raw: Any, pair: Pair) -> Found:
        good = matched(raw.validity)
        u, v = (np.where(good, m, np.nan).astype(np.float64) for m in (raw.column_disparity, raw.row_disparity))
        std, *dense = (np.asarray(m, np.float64) for m in (raw.disparity_std, raw.column_disparity, raw.row_disparity))
        return Found(u, v, good, rows=True, std=std, dense=(dense[0], dense[1]))

    return Method(name, lambda pair: match(pair.left, pair.right, params, **extra), read)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
