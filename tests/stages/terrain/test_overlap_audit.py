"""The audit names the model that was planted with an error, tells pose from noise, and is silent where all is well."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from seam_scenes import SIGMA, along

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.terrain import overlap_audit as audit_stage
from rille.stages.terrain import overlap_qa as seam_stage
from rille.stages.terrain.overlap_audit import audit, stands_out

PLANTED = 12


def audited(dems: dict[int, Bundle]) -> tuple[list[Bundle], dict]:
    seams, pairs = [], sorted(dems)
    for i, pair in enumerate(pairs):
        inputs = {"dem": dems[pair], "others": [dems[other] for other in pairs[:i]][::-1]}
        seams.append(seam_stage.overlap_qa_stage.run(NoParams(), {}, inputs))
        check_outputs(seam_stage.overlap_qa_stage, seams[-1])
        json.dumps(seams[-1].meta, allow_nan=False)
    found = audit_stage.overlap_audit_stage.run(NoParams(), {}, {"seams": seams})
    json.dumps(found.meta, allow_nan=False)
    return seams, dict(found.meta)


def test_models_that_agree_are_not_suspected() -> None:
    seams, meta = audited(along(7))
    assert [m["pair"] for m in meta["models"] if m["contradicts"]] == []
    assert meta["warnings"] == []
    facts = [s for bundle in seams for s in bundle.meta["seams"]]
    assert len(facts) == 6 + 5 + 4  # each model reaches over the next three steps
    for s in facts:
        # noise of both models, and their sigma, are SIGMA
        assert s["cells"] < 5000 or s["noise"] == pytest.approx(math.sqrt(2) * SIGMA, rel=0.15)
        assert s["expected"] == pytest.approx(math.sqrt(2) * SIGMA, rel=1e-5)


@pytest.mark.parametrize("where", [0, PLANTED, 24])
def test_a_planted_bias_ranks_first_with_its_size(where: int) -> None:
    _, meta = audited(along(7, bias={where: 5e-4}))
    worst = meta["models"][0]
    assert worst["pair"] == where
    assert worst["bias"] == pytest.approx(5e-4, abs=5e-5)
    assert not worst["contradicts"]  # it is less than the sigma of a cell allows
    assert meta["warnings"] == []


@pytest.mark.parametrize("axis", [0, 1])
def test_a_planted_tilt_ranks_first_with_its_size(axis: int) -> None:
    tilt = [0.0, 0.0]
    tilt[axis] = math.radians(0.2)
    _, meta = audited(along(7, tilt={PLANTED: tilt}))
    worst = meta["models"][0]
    assert worst["pair"] == PLANTED
    assert worst["tilt"] == pytest.approx(tilt, abs=math.radians(0.04))


def test_a_model_beyond_its_sigma_is_warned_of_by_name_and_figure() -> None:
    _, meta = audited(along(7, bias={PLANTED: 0.01}))
    (line,) = meta["warnings"]
    assert line.startswith("1 of 7 elevation models contradict")
    assert [
        fact
        for fact in (f"pair {PLANTED} ", "0, 4, 8, 16", "10.0 mm where sigma allows 0.707 mm", "offset +10.0 mm")
        if fact not in line
    ] == []
    assert "either may be wrong" not in line
    assert [m["pair"] for m in meta["models"] if m["contradicts"]] == [PLANTED]
    assert PLANTED in (meta["seams"][0]["pair"], meta["seams"][0]["other"])


def test_a_model_that_is_far_off_is_stated_in_metres() -> None:
    (line,) = audited(along(7, bias={PLANTED: 1.5}))[1]["warnings"]
    assert [fact for fact in ("1.50 m where sigma allows 0.707 mm", "offset +1.50 m") if fact not in line] == []


def test_of_two_models_nobody_can_tell_which_is_wrong() -> None:
    _, meta = audited(along(2, bias={4: 0.01}))
    assert "either may be wrong" in meta["warnings"][0]


def test_two_wrong_models_are_both_named() -> None:
    _, meta = audited(along(12, bias={PLANTED: 0.002, 32: -0.003}))
    assert [m["pair"] for m in meta["models"] if m["contradicts"]] == [32, PLANTED]


def test_where_most_models_contradict_each_other_the_run_is_not_complete() -> None:
    wrong = {4 * k: 0.004 * k * (-1) ** k for k in range(7)}
    _, most = audited(along(7, bias=wrong))
    _, one = audited(along(7, bias={PLANTED: 0.01}))
    assert most["contradiction"] == most["warnings"][0]
    assert "contradiction" not in one


def test_noise_that_sigma_does_not_know_is_no_error_of_pose() -> None:
    dems = along(7)
    rough = dems[PLANTED]
    rng = np.random.default_rng(5)
    z = rough["elevation"] + rng.normal(0, 4 * SIGMA, rough["elevation"].shape).astype(np.float32)
    seams, meta = audited({**dems, PLANTED: Bundle({**rough.arrays, "elevation": z}, rough.meta)})
    assert not any(m["contradicts"] for m in meta["models"])
    for s in (s for bundle in seams for s in bundle.meta["seams"]):
        excess = s["noise"] / s["expected"]
        assert (excess > 2.5) == (PLANTED in (s["pair"], s["other"]))


def test_exposure_is_read_from_the_same_cells() -> None:
    seams, _ = audited(along(3, grey={4: 130.0}))
    got = {(s["pair"], s["other"]): s["log_ratio"] for b in seams for s in b.meta["seams"]}
    wanted = {(4, 0): math.log(1.3), (8, 4): -math.log(1.3), (8, 0): 0.0}
    assert got == {k: pytest.approx(v, abs=0.005) for k, v in wanted.items()}


def test_of_a_large_overlap_some_cells_tell_as_much() -> None:
    (bundle,) = audited(along(2, rows=400, cols=330, step=100, bias={4: 0.3}))[0][1:]
    (facts,) = bundle.meta["seams"]
    assert facts["cells"] > seam_stage.MAX_CELLS
    assert facts["bias"] == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize(("systematic", "noise", "expected"), [(2.1, 1.0, True), (1.9, 0.1, False), (2.1, 1.1, False)])
def test_a_seam_stands_out_beyond_sigma_and_noise(systematic: float, noise: float, expected: bool) -> None:
    assert stands_out({"systematic": systematic, "expected": 1.0, "noise": noise}) is expected


def test_a_model_with_half_of_its_seams_wrong_does_not_contradict() -> None:
    seam = {"cells": 100, "bias": 0.0, "tilt": [0.0, 0.0], "noise": 0.0, "expected": 1.0}
    ends = (0, 4, 9.0), (4, 8, 0.0), (8, 12, 0.0)
    models = audit([seam | {"other": a, "pair": b, "systematic": error} for a, b, error in ends])
    assert [m["pair"] for m in models if m["contradicts"]] == [0]


def test_a_cell_without_a_grey_value_does_not_hide_the_exposure() -> None:
    dems = along(3, grey={4: 130.0})
    dems[4]["ortho"][20, 20] = np.nan
    seams, _ = audited(dems)
    ratios = [s["log_ratio"] for b in seams for s in b.meta["seams"] if s["pair"] == 4]
    assert ratios == [pytest.approx(math.log(1.3), abs=0.005)]
