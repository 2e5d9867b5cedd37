"""What the matcher's vector kernels are worth: plain loops in their place give the same bits, and take longer.

``python benchmarks/kernels.py [--image LEFT RIGHT]``: the street's first pair of RILLE_DATA by default. For each kernel
of ``rille.stages.hfvm`` that is written as vector code the matcher runs once more, in a process of its own, with the
function below instead. Printed are processor times, the least of several; it fails if any result differs. A vector
kernel whose plain form costs less than 15 % of the matcher's time should go. The functions below are also what the
kernels compute, to be read first.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from rille.stages.hfvm.coarse_to_fine import path_simd
from rille.stages.hfvm.level import epipolar, simd, strip_simd
from rille.stages.hfvm.level.features import distance

KERNELS = {
    "four": ((strip_simd, "four"),),
    "settle": ((simd, "settle"), (simd, "settle_dense")),
    "sums": ((simd, "sums"),),
    "step": ((path_simd, "step"),),
}
"""Name of the plain form, and what it stands for."""
PRESETS = {"default": 7, "accurate": 3}
"""Presets, and how often each is run."""
ROUNDS = 4
RANKS = strip_simd.LANES + 1


@njit(nogil=True, inline="always")
def band(line, u, v):  # type: ignore[no-untyped-def]
    """What displacement (u, v) costs off the epipolar line, whole byte steps."""
    off = abs((line[0] * np.float32(u) + line[1] * np.float32(v)) + line[2])
    return np.int64(min(off, np.float32(simd.FARTHEST_OFF)))


@njit(nogil=True, inline="always")
def pack(u, v):  # type: ignore[no-untyped-def]
    return np.int32((v << 16) | (u & 0xFFFF))


@njit(nogil=True, inline="always")
def column(packed):  # type: ignore[no-untyped-def]
    return np.int64(np.int16(packed))


@njit(nogil=True, inline="always")
def row(packed):  # type: ignore[no-untyped-def]
    return np.int64(packed) >> 16


@njit(nogil=True)
def four(images, line, at, sizes, strip, out):  # type: ignore[no-untyped-def]
    """Best candidate of a strip for each of two by two pixels; the centre first, a row less and more last."""
    (left, right), (here, there), (cols, rcols), (best, least) = images, at, sizes, out
    u, count, centre, v, cross = strip
    w0, w1, w2, w3 = left[here], left[here + 1], left[here + cols], left[here + cols + 1]
    # cost << 4 | rank: the least number is the least cost and, of equal ones, the least rank
    k0, k1, k2, k3 = np.int64(least[0]) << 4, np.int64(least[1]) << 4, np.int64(least[2]) << 4, np.int64(least[3]) << 4
    own = centre - u
    for k in range(count + (2 if cross else 0)):
        if k < count:
            p, key = there + k, (band(line, u + k, v) << 4) | (0 if k == own else k + 1)
        else:
            aside = 2 * (k - count) - 1
            p, key = there + own + aside * rcols, (band(line, centre, v + aside) << 4) | (RANKS + k - count)
        k0 = min(k0, (distance(w0, right[p]) << 4) + key)
        k1 = min(k1, (distance(w1, right[p + 1]) << 4) + key)
        k2 = min(k2, (distance(w2, right[p + rcols]) << 4) + key)
        k3 = min(k3, (distance(w3, right[p + rcols + 1]) << 4) + key)
    for n in range(4):
        key = k0 if n == 0 else k1 if n == 1 else k2 if n == 2 else k3
        cost, rank = key >> 4, key & 15
        if cost < least[n]:
            du = centre if rank == 0 or rank >= RANKS else u + rank - 1
            best[n], least[n] = pack(du, v + (0 if rank < RANKS else 2 * (rank - RANKS) - 1)), cost


@njit(nogil=True, inline="always")
def rough(tried, near):  # type: ignore[no-untyped-def]
    """Sum over the neighbours of min(|du| + |dv|, 2)."""
    total = np.int64(0)
    for n in near:
        total += min(abs(column(tried) - column(n)) + abs(row(tried) - row(n)), np.int64(simd.TRUNCATION))
    return total


@njit(nogil=True)
def settle(maps, line, todo, place, level, out):  # type: ignore[no-untyped-def]
    """Best displacement of eight pixels among their own, those beside it, and those of the four neighbours."""
    (left, right, packed, data), (at, here, above, below, y), (new, cost) = maps, place, out
    rows, cols, left_cols, ahead, begin, beside, smooth = level
    last = left_cols - 1
    for lane in range(simd.LANES):
        x = np.int64(todo[at + lane])
        # beyond the border the pixel on the other side stands in
        west, east = x - 1 if x > 0 else min(1, last), x + 1 if x < last else max(last - 1, 0)
        own = packed[here + x]
        near = packed[above + x], packed[here + west], packed[here + east], packed[below + x]
        abc = epipolar.line(line[:7], np.float32(x + begin), line[7])
        best, found = own, np.int64(data[here + x])
        least = found + smooth * rough(own, near)
        for k in range(8):
            if k < 4:
                if beside < 1 or (k >= 2 and beside < 2):
                    continue
                u, v = column(own) + (2 * k - 1 if k < 2 else 0), row(own) + (2 * k - 5 if k >= 2 else 0)
                tried = pack(u, v)
            else:
                tried = near[k - 4]
                u, v = column(tried), row(tried)
                if v == row(own) and abs(u - column(own)) <= 1:
                    continue  # has been tried, or is left out
                if k > 4 and (tried == near[0] or (k > 5 and tried == near[1]) or (k > 6 and tried == near[2])):
                    continue
            xr, yr = x + ahead + u, y + v
            if 0 <= xr < cols and 0 <= yr < rows:
                mine = distance(left[here + x], right[yr * cols + xr]) + band(abc, u, v)
                total = mine + smooth * rough(tried, near)
                if total < least:
                    best, found, least = tried, mine, total
        new[at + lane], cost[at + lane] = best, found


@njit(nogil=True, inline="always")
def five(left, right, p, q, lc, rc):  # type: ignore[no-untyped-def]
    """Distances summed over a column of five pixels: undisplaced, west, east, north (16 bits each), and south."""
    packed, south = np.uint64(0), np.uint64(0)
    for j in range(-2, 3):
        word, at = left[p + j * lc], q + j * rc
        packed += np.uint64(distance(word, right[at])) | (np.uint64(distance(word, right[at - 1])) << np.uint64(16))
        packed += np.uint64(distance(word, right[at + 1])) << np.uint64(32)
        packed += np.uint64(distance(word, right[at - rc])) << np.uint64(48)
        south += np.uint64(distance(word, right[at + rc]))
    return packed, south


@njit(nogil=True)
def sums(images, at, sizes, count, out, index):  # type: ignore[no-untyped-def]
    """Sums over 5 x 5 pixels of ``count`` pixels side by side, by columns."""
    (left, right), (p, q), (lc, rc), (packed, south) = images, at, sizes, out
    a0, s0 = five(left, right, p - 2, q - 2, lc, rc)
    a1, s1 = five(left, right, p - 1, q - 1, lc, rc)
    a2, s2 = five(left, right, p, q, lc, rc)
    a3, s3 = five(left, right, p + 1, q + 1, lc, rc)
    for k in range(count):
        a4, s4 = five(left, right, p + k + 2, q + k + 2, lc, rc)
        packed[index + k], south[index + k] = a0 + a1 + a2 + a3 + a4, s0 + s1 + s2 + s3 + s4
        a0, a1, a2, a3, s0, s1, s2, s3 = a1, a2, a3, a4, s1, s2, s3, s4


@njit(nogil=True)
def step(candidates, places, path, out, total, penalty):  # type: ignore[no-untyped-def]
    """cost[k] + min over m (path[m] + min(small |difference of k and m|, far)) - min over m path[m]."""
    (cu, cv, cost), (at, there), (small, far) = candidates, places, penalty
    least = np.int64(path[0])
    for m in range(1, path_simd.MOST):
        least = min(least, np.int64(path[m]))
    for k in range(path_simd.MOST):
        best = least + far
        for m in range(path_simd.MOST):
            gap = abs(np.int64(cu[there + m]) - cu[at + k]) + abs(np.int64(cv[there + m]) - cv[at + k])
            best = min(best, np.int64(path[m]) + min(small * gap, far))
        found = min(np.int64(cost[at + k]) + best - least, np.int64(path_simd.NONE))
        out[k] = found
        total[at + k] += found


def measure(kernel: str, files: list[str]) -> None:
    """Match with one kernel replaced; print preset, digest of the result and seconds."""
    import cv2

    from rille.stages.hfvm.images.params import HfvmParams
    from rille.stages.hfvm.stage import match

    for module, name in KERNELS.get(kernel, ()):
        setattr(module, name, globals()[kernel])
    left, right = (cv2.imread(file, cv2.IMREAD_GRAYSCALE) for file in files)
    for preset, times in PRESETS.items():
        params, seconds = HfvmParams.model_validate({"preset": preset}), []
        for _ in range(times + 1):  # the first one compiles
            begin = time.process_time()
            found: Any = match(left, right, params)
            seconds.append(time.process_time() - begin)
        arrays = found.column_disparity, found.row_disparity, found.validity, found.disparity_std
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()
        print(preset, digest, min(seconds[1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", nargs=2, help="left and right image")
    parser.add_argument("--kernel", help=argparse.SUPPRESS)
    options = parser.parse_args()
    files = options.image
    if files is None:
        street = Path(os.environ.get("RILLE_DATA") or sys.exit("set RILLE_DATA, or give --image")) / "kitti06_51"
        files = [str(min((street / side).iterdir())) for side in ("image_l", "image_r")]
    if options.kernel:
        measure(options.kernel, files)
        return
    found: dict[str, dict[str, tuple[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        # Round by round, as the machine is not equally fast all the time.
        for kernel in ("as it is", *KERNELS) * ROUNDS:
            command = [sys.executable, __file__, "--kernel", kernel, "--image", *files]
            # compiled code must not be shared between the forms
            env = {**os.environ, "NUMBA_CACHE_DIR": f"{folder}/{kernel}"}
            done = subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=True)
            for preset, digest, seconds in map(str.split, done.stdout.splitlines()):
                least = min(float(seconds), found.get(kernel, {}).get(preset, ("", math.inf))[1])
                found.setdefault(kernel, {})[preset] = digest, least
    print("| plain loops for | default, s | / as it is | accurate, s | / as it is | same bits |")
    print("|---|---|---|---|---|---|")
    good, usual = True, found["as it is"]
    for kernel, by in found.items():
        same = all(by[preset][0] == usual[preset][0] for preset in PRESETS)
        good &= same
        times = " | ".join(f"{by[p][1]:.3f} | {by[p][1] / usual[p][1]:.2f}" for p in PRESETS)
        print(f"| {kernel} | {times} | {'yes' if same else 'NO'} |")
    sys.exit(not good)


if __name__ == "__main__":
    main()
