"""What degraded images cost a matcher: ten Middlebury pairs whose right image is made worse in ten ways.

    RILLE_DATA=... python benchmarks/robustness.py [--preset default --preset accurate]

For each degradation: the mean over the pairs of filled bad-2 (of the vector; all matchers filled alike, missing pixels
counted) over the matcher's own on the images as they are, and over that of OpenCV's SGBM 3WAY on the same degraded
pairs; the matched share; bad-2 of the matched; and the shares within one and two of the standard deviations claimed.
Settings were chosen with the first half of the pairs (``chosen``: motorcycle, Baby1, Cloth1, Lampshade1, Midd1); the
second half (``judged``: cones, Bowling1, Monopoly, Rocks1, Wood1) had no part in it. Truth is given to a third of a
pixel for all but motorcycle and cones, and off by up to a quarter as a whole: standard deviations below that cannot
hold there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]


def bytes_of(values: NDArray[Any]) -> Grey:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def noisy(image: Grey) -> Grey:
    return bytes_of(image + np.random.default_rng(0).normal(0, 5, image.shape))


def jpeg(image: Grey) -> Grey:
    found = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 50])[1], cv2.IMREAD_GRAYSCALE)
    return np.asarray(found, np.uint8)


def vignetted(image: Grey) -> Grey:
    y, x = (np.linspace(-1, 1, n) for n in image.shape)
    return bytes_of(image * (1 - 0.6 * (x[None, :] ** 2 + y[:, None] ** 2) / 2))


DEGRADATIONS: dict[str, Callable[[Grey], Grey]] = {
    "as they are": lambda image: image,
    "noise, SD 5": noisy,
    "JPEG 50": jpeg,
    "vignetting to 0.4": vignetted,
    "gain 0.6": lambda image: bytes_of(0.6 * image),
    "gamma 0.7": lambda image: bytes_of(255 * (image / 255.0) ** 0.7),
    "blur, SD 1": lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8),
}
"""What is done to the right image; the knocks below move the truth, too."""


def altered(pair: Any, change: Callable[[Grey], Grey]) -> Any:
    return replace(pair, right=change(pair.right))


def cases() -> Iterable[tuple[str, Callable[[Any], Any]]]:
    from stereo.misalignment import knocked

    from rille.datasets.images.misalign import MisalignParams

    for name, change in DEGRADATIONS.items():
        yield name, partial(altered, change=change)
    for name, knock in (
        ("2 rows", {"rows": 2.0}),
        ("0.5 degrees", {"roll_deg": 0.5}),
        ("2 degrees", {"roll_deg": 2.0}),
    ):
        yield name, partial(knocked, params=MisalignParams(**knock))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", action="append", help="of Rille's matcher; may be repeated (default)")
    parser.add_argument("--pairs", type=int, help="so many of each half only")
    given = parser.parse_args()
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    from stereo import methods
    from stereo.measures import judge
    from stereo.pairs import halves

    methods.set_threads(1)
    wanted = [f"HFVM {preset}" for preset in given.preset or ["default"]]
    peer = next(m for m in methods.opencv() if m.name == "SGBM 3WAY")
    mine = [m for m in methods.hfvm([], 1) if m.name in wanted]
    print(
        "| half | matcher | right image | / own, as it is | / SGBM 3WAY | matched | bad-2 of them | within 1, 2 std |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for half, pairs in halves().items():
        clean: dict[tuple[str, str], float] = {}
        for case, change in cases():
            changed = {pair.name: change(pair) for pair in pairs[: given.pairs]}
            peers = {name: judge(peer(pair), pair.truth)["bad2"] for name, pair in changed.items()}
            for method in (peer, *mine):
                found = {name: judge(method(pair), pair.truth) for name, pair in changed.items()}
                for name, figures in found.items():
                    clean.setdefault((method.name, name), figures["bad2"])
                own = np.mean([f["bad2"] / clean[method.name, name] for name, f in found.items()])
                other = np.mean([f["bad2"] / peers[name] for name, f in found.items()])
                share, wrong = (np.mean([f[key] for f in found.values()]) for key in ("completeness", "bad2_matched"))
                std = [
                    np.mean([f[key] for f in found.values()]) for key in ("within_1", "within_2") if method is not peer
                ]
                within = ", ".join(f"{s:.2f}" for s in std) or "-"
                row = f"{own:.2f} | {other:.2f} | {share:.2f} | {wrong:.3f} | {within}"
                print(f"| {half} | {method.name} | {case} | {row} |", flush=True)


if __name__ == "__main__":
    main()
