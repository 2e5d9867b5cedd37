"""Matchers behind one interface: OpenCV's, those in environments of their own, and HFVM in every preset."""

from __future__ import annotations

import inspect
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from .measures import Found
from .pairs import Pair

BLOCK = 3
CAP = 31
BM_BLOCK = 15

PEERS = {"pandora": "Pandora", "elas": "ELAS"}
PROGRAM = Path(__file__).with_name("peers.py")


@dataclass(frozen=True)
class Method:
    """A matcher; ``run`` is timed, ``read`` makes a :class:`Found` of what it gave.

    ``told``: wall and processor seconds that a program elsewhere tells with its result.
    """

    name: str
    run: Callable[[Pair], Any]
    read: Callable[[Any, Pair], Found]
    told: Callable[[Any], tuple[float, float]] | None = None

    def __call__(self, pair: Pair) -> Found:
        """Match a pair."""
        return self.read(self.run(pair), pair)

    def seconds(self, pair: Pair) -> tuple[float, float]:
        """Wall and processor seconds of a run."""
        start, start_cpu = time.perf_counter(), time.process_time()
        raw = self.run(pair)
        if self.told is not None:
            return self.told(raw)
        return time.perf_counter() - start, time.process_time() - start_cpu


def set_threads(count: int) -> None:
    """Threads of OpenCV and numba; the process must have been started with at least as many for numba."""
    import numba

    cv2.setNumThreads(count)
    numba.set_num_threads(count)


def opencv() -> list[Method]:
    """Semi-global matching in three and eight directions, and block matching.

    Block 3, pre-filter 31, uniqueness 10 %, speckles of 100 pixels: of blocks 3, 5, 7, caps 31 and 63 and uniqueness
    5 and 10 % the best on motorcycle and cones together. Block matching of 15 x 15 pixels loses half a block of rows at
    top and bottom, so its images get as many more.
    """
    smooth = {"P1": 8 * BLOCK**2, "P2": 32 * BLOCK**2}
    clean = {"disp12MaxDiff": 1, "uniquenessRatio": 10, "speckleWindowSize": 100, "speckleRange": 2}

    def semiglobal(mode: int) -> Callable[[Pair], Any]:
        def run(pair: Pair) -> Any:
            low, count = pair.range
            matcher = cv2.StereoSGBM.create(low, count, BLOCK, preFilterCap=CAP, mode=mode, **smooth, **clean)
            return matcher.compute(*_padded(pair))

        return run

    def block(pair: Pair) -> Any:
        low, count = pair.range
        matcher = cv2.StereoBM.create(count, BM_BLOCK)
        matcher.setMinDisparity(low)
        matcher.setDisp12MaxDiff(clean["disp12MaxDiff"])
        matcher.setSpeckleWindowSize(clean["speckleWindowSize"])
        matcher.setSpeckleRange(clean["speckleRange"])
        rows = BM_BLOCK // 2
        return matcher.compute(*_padded(pair, rows))[rows:-rows]

    return [
        Method("SGBM 3WAY", semiglobal(cv2.STEREO_SGBM_MODE_SGBM_3WAY), _read_opencv),
        Method("SGBM HH", semiglobal(cv2.STEREO_SGBM_MODE_HH), _read_opencv),
        Method("BM", block, _read_opencv),
    ]


def _margins(pair: Pair) -> tuple[int, int]:
    """Columns to add left and right so that every pixel has all its candidates."""
    low, count = pair.range
    return max(0, low + count), max(0, -low)


def _padded(pair: Pair, rows: int = 0) -> list[NDArray[Any]]:
    borders = rows, rows, *_margins(pair)
    return [cv2.copyMakeBorder(i, *borders, cv2.BORDER_REPLICATE) for i in (pair.left, pair.right)]


def _read_opencv(raw: Any, pair: Pair) -> Found:
    before, _ = _margins(pair)
    cut = raw[:, before : before + pair.left.shape[1]]
    d = cut.astype(np.float64) / 16.0
    good = d >= pair.range[0]
    return Found(np.where(good, -d, np.nan), np.where(good, 0.0, np.nan), good, rows=False)


def elsewhere(name: str, python: Path) -> tuple[Method, str]:
    """Matcher of ``peers.py`` that this Python has in its environment, one process a call; and its distribution."""

    def run(pair: Pair) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            np.savez(f"{folder}/pair.npz", left=pair.left, right=pair.right, range=pair.range)
            _ask(python, name, folder)
            with np.load(f"{folder}/found.npz") as found:
                return dict(found)

    def read(raw: Any, pair: Pair) -> Found:
        good, level = np.isfinite(raw["disparity"]), np.zeros(pair.left.shape)
        return Found(-raw["disparity"], level, good, rows=False, dense=(-raw["filled"], level))

    method = Method(PEERS[name], run, read, lambda raw: (float(raw["seconds"][0]), float(raw["seconds"][1])))
    return method, _ask(python, name).strip()


def _ask(python: Path, *words: str) -> str:
    done = subprocess.run([python, PROGRAM, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        raise SystemExit(f"{PEERS[words[0]]}, run by {python}: {said[-1]}")
    return done.stdout


def hfvm(variants: list[str], threads: int) -> list[Method]:
    """Every preset of the matcher's parameters, and variants ``key=value key=value ...`` of them."""
    from rille.stages.hfvm.params import HfvmParams

    presets = [str(p) for p in get_args(HfvmParams.model_fields["preset"].annotation)]
    found = [_hfvm(f"HFVM {p}", {"preset": p}, threads) for p in presets]
    for text in variants:
        values = {}
        for word in text.replace(",", " ").split():
            key, _, value = word.partition("=")
            values[key] = value.split("+") if key == "without" else _value(value)
        found.append(_hfvm(f"HFVM {text}", values, threads))
    return found


def _hfvm(name: str, values: dict[str, Any], threads: int) -> Method:
    from rille.stages.core.validity import matched
    from rille.stages.hfvm.params import HfvmParams
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
