"""Exposures: a jump is found and taken out, a gradient along the way is not piled up."""

from __future__ import annotations

import pytest

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.terrain import radiometry as stage
from rille.stages.terrain.radiometry import FADING_WEIGHT, LOG_GAIN_STEP, level

CHAIN = {4 * k: (0.02 * (k % 2), 0.3 * k) for k in range(12)}


def ratios(log_grey: dict[int, float], gradient: float = 0.0) -> list[tuple[int, int, float]]:
    pairs = sorted(CHAIN)
    return [
        (a, b, log_grey.get(b, 0.0) - log_grey.get(a, 0.0) + gradient * (CHAIN[b][1] - CHAIN[a][1]))
        for i, a in enumerate(pairs)
        for b in pairs[i + 1 : i + 3]
    ]


def worst_seam(steps: dict[int, int], seams: list[tuple[int, int, float]]) -> float:
    return max(abs(r + LOG_GAIN_STEP * (steps.get(b, 0) - steps.get(a, 0))) for a, b, r in seams)


# of a jump on four seams the second term leaves a weight w / (4 + w), one per cent; and each end is rounded by half a
# step
LEFT = 0.3 * FADING_WEIGHT / 4 + LOG_GAIN_STEP


def test_one_model_that_was_exposed_longer_is_darkened() -> None:
    steps = level(CHAIN, ratios({20: 0.3}))
    assert steps[20] < -20
    assert all(abs(n) <= 6 for pair, n in steps.items() if pair != 20)
    assert worst_seam(steps, ratios({20: 0.3})) < LEFT


def test_two_models_meet_in_the_middle() -> None:
    """The gradient cannot be told from the jump, and takes it: one step of the camera is no exposure."""
    assert level({0: (0, 0), 4: (0, 0)}, [(0, 4, 0.2)]) == {0: 10, 4: -10}


@pytest.mark.parametrize("gradient", [-0.3, 0.3])
def test_a_gradient_along_the_way_is_no_exposure(gradient: float) -> None:
    # of the 0.99 along the whole way less than a tenth is left, at either end
    assert all(abs(n) <= 5 for n in level(CHAIN, ratios({}, gradient)).values())
    same, steps = level(CHAIN, ratios({20: 0.3})), level(CHAIN, ratios({20: 0.3}, gradient))
    assert all(abs(steps.get(k, 0) - same.get(k, 0)) <= 5 for k in CHAIN)


def test_seams_of_a_lasting_change_are_less_than_half_of_it() -> None:
    log_grey = {pair: 0.2 for pair in CHAIN if pair >= 24}
    steps = level(CHAIN, ratios(log_grey))
    assert worst_seam(steps, ratios(log_grey)) < 0.1


def test_a_small_change_elsewhere_changes_nothing() -> None:
    before = ratios({20: 0.3})
    moved = [(a, b, r + (1e-4 if 40 in (a, b) else 0.0)) for a, b, r in before]
    assert level(CHAIN, moved) == level(CHAIN, before)
    assert level(CHAIN, before[::-1]) == level(CHAIN, before)
    assert level({0: (0, 0)}, []) == {}


def test_the_stage_reads_the_seams_and_can_be_switched_off() -> None:
    seams = [Bundle({}, {"seams": [{"pair": b, "other": a, "log_ratio": r}]}) for a, b, r in ratios({20: 0.3})]
    seams.append(Bundle({}, {"seams": [{"pair": 44, "other": 0, "log_ratio": None}]}))
    args = {"centres": {str(k): list(c) for k, c in CHAIN.items()}}
    meta = stage.radiometry_stage.run(NoParams(), args, {"seams": seams}).meta
    assert meta["steps"] == {str(k): n for k, n in level(CHAIN, ratios({20: 0.3})).items()}
