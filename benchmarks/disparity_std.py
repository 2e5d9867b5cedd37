"""Standard deviation of disparities against exact ones: the factors of ``rille.stages.hfvm.refinement`` and
their check.

``python benchmarks/disparity_std.py`` renders pairs of the built-in mockup (kept in ``--cache``), matches them and
prints how many of the matched pixels err by less than one and two standard deviations, also on the photographed pairs
of ``stereo/pairs.py`` (RILLE_DATA). ``--fit`` fits the factors anew to the pairs marked with a star for each
``--floor``, prints them, and says what they make of all pairs: to be done after every change of the matcher. Factors
are those that make 68.3 % of the errors lie below std and 95.4 % below twice that, whatever the parts N, R, M of a
pixel are: the minimum of the two quantiles' pinball losses of log(error / std). The floor cannot be fitted so, since
the mockup has no lens and no gaps between pixels: it is chosen by the photographed pairs marked ``+``.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PAIRS: dict[str, tuple[dict[str, Any], int, bool]] = {
    "seed 1, frame 0": ({"seed": 1}, 0, True),
    "seed 2, frame 8": ({"seed": 2}, 8, True),
    "seed 6, frame 12": ({"seed": 6}, 12, True),
    "noise 4": ({"seed": 7, "noise": 4.0}, 4, True),
    "seed 1, frame 20": ({"seed": 1}, 20, False),
    "seed 3, frame 0": ({"seed": 3}, 0, False),
    "seed 4, frame 16": ({"seed": 4}, 16, False),
    "seed 5, frame 28": ({"seed": 5}, 28, False),
    "more rocks": ({"seed": 8, "rocks": 150.0, "relief": 0.012}, 4, False),
    "little grain": ({"seed": 9, "grain": 0.02}, 4, False),
    "pitch 35": ({"seed": 11, "pitch_deg": 35.0, "jitter_deg": 1.0}, 2, False),
}
"""Name to mockup parameters, frame, and whether factors are fitted to it."""

WEIGHT = 0.5
"""Of the loss at two standard deviations against that at one."""
SAMPLES = 20000

Floats = NDArray[np.float64]


def rendered(cache: Path, parameters: dict[str, Any], frame: int) -> tuple[Any, ...]:
    """Left and right image, the exact column disparity, and both images' masks, of one mockup pair."""
    from rille.datasets.mockup.params import MockupParams
    from rille.datasets.mockup.sequence import mockup
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.engine.task import Spec, ensure

    store, sequence = Store(cache), mockup(MockupParams(**parameters))

    def artifact(source: Any) -> Any:
        refs = {port: artifact(upstream) for port, upstream in source.inputs.items()}
        label = source.module.rsplit(".", 1)[-1]
        return ensure(cache, Spec(source.module, label, source.params, source.args, source.hints), refs).ref

    both = [store.open(artifact(sequence.image(frame, side))) for side in ("left", "right")]
    assert sequence.truth_disparity is not None
    truth = np.asarray(store.open(artifact(sequence.truth_disparity(frame)))["column_disparity"])
    return *(np.asarray(b["image"]) for b in both), truth, *(np.asarray(b["valid"]) for b in both)


def photographs() -> dict[str, tuple[Any, ...]]:
    """Photographed pairs whose disparity was measured; ``+``: for choosing, ``-``: for judging."""
    from stereo.pairs import halves

    return {
        f"{'+' if half == 'chosen' else '-'} {pair.name}": (pair.left, pair.right, pair.truth.u)
        for half, pairs in halves().items()
        for pair in pairs
    }


def judged(
    preset: str, left: Any, right: Any, truth: Any, left_valid: Any = None, right_valid: Any = None
) -> tuple[Floats, Floats, Floats]:
    """Parts (floor, N, R, M) x n, squared pixels, absolute errors (n,) and standard deviations (n,), pixels.

    Of the matched pixels with truth. Parts are NaN at those without texture, which the factors do not describe alone.
    """
    from rille.stages.hfvm import refinement
    from rille.stages.hfvm import stage as hfvm
    from rille.stages.hfvm.params import HfvmParams

    parts: list[Any] = []
    original = refinement.standard_deviation

    def recording(noise: Any, likeness: Any, disparity: Any, keep: Any) -> Any:
        found = refinement.parts(noise, likeness, disparity, keep)
        parts.extend(np.where(keep, p, np.nan) for p in (keep, *found))
        return original(noise, likeness, disparity, keep)

    refinement.standard_deviation = recording
    try:
        params = HfvmParams.model_validate({"preset": preset})
        found = hfvm.match(left, right, params, valid=(left_valid, right_valid))
    finally:
        refinement.standard_deviation = original
    ok = np.isfinite(found.disparity_std) & np.isfinite(truth)
    # Preset fast matches at half the resolution: its parts are squares of pixels twice as large.
    wide = 1 if parts[0].shape == ok.shape else 2
    whole = (wide**2 * np.kron(part, np.ones((wide, wide)))[: ok.shape[0], : ok.shape[1]] for part in parts)
    x = np.stack([part[ok] for part in whole])
    error = np.abs(found.column_disparity - truth)[ok].astype(np.float64)
    return x, error, found.disparity_std[ok].astype(np.float64)


def fit(data: list[tuple[Floats, Floats, Floats]], floor: float) -> Floats:
    """Factors floor, noise, relief, border."""
    from scipy.optimize import minimize

    rng = np.random.default_rng(0)
    chosen = [(x, e, rng.choice(len(e), min(SAMPLES, len(e)), replace=False)) for x, e, _ in data]
    x = np.concatenate([x[:, i] for x, _, i in chosen], axis=1)
    described = np.isfinite(x).all(axis=0)
    x, log_error = x[:, described], np.log(np.concatenate([e[i] for _, e, i in chosen])[described] + 1e-4)

    def loss(p: Floats) -> float:
        over = log_error - 0.5 * np.log(np.exp(np.append(2 * np.log(floor), p)) @ x)
        total = 0.0
        for share, level, weight in ((0.683, 0.0, 1.0), (0.954, np.log(2.0), WEIGHT)):
            total += weight * float(np.mean(np.maximum(share * (over - level), (share - 1) * (over - level))))
        return total

    found = minimize(loss, np.full(3, -1.0), method="Powell", options={"xtol": 1e-3, "ftol": 1e-6})
    return np.append(floor, np.exp(0.5 * found.x))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--cache", type=Path, default=Path(".rille/cache"))
    parser.add_argument("--preset", default="default")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--floor", type=float, nargs="*", default=[0.1, 0.13, 0.16], help="pixels, to fit with")
    options = parser.parse_args()
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    pairs = {name: rendered(options.cache, p, frame) for name, (p, frame, _) in PAIRS.items()}
    pairs |= photographs() if os.environ.get("RILLE_DATA") else {}
    stars = {name for name, (_, _, star) in PAIRS.items() if star}
    data = {name: judged(options.preset, *pair) for name, pair in pairs.items()}
    for name, (_, error, std) in data.items():
        mark = "* " if name in stars else "  " * (name in PAIRS)
        print(f"{mark + name:20s} within 1, 2, 3 std: {inside(error, std)}   median std {np.median(std):.3f} px")
    for floor in options.floor if options.fit else ():
        factors = fit([data[name] for name in stars], floor)
        print("floor, noise, relief, border:", np.round(factors, 3))
        for name, (x, error, std) in data.items():
            by_parts = np.sqrt(np.square(factors) @ np.nan_to_num(x))
            print(f"    {name:18s} {inside(error, np.where(np.isfinite(x).all(axis=0), by_parts, std))}")


def inside(error: Floats, std: Floats) -> str:
    """Shares within one, two and three standard deviations."""
    return " ".join(f"{100 * np.mean(error <= k * std):5.1f} %" for k in (1, 2, 3))


if __name__ == "__main__":
    main()
