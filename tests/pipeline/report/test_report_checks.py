"""How the report shows that a run checks itself: rig, other program, overlaps, gaps of the truth, a single pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from toys.finished import BASIC, FRAMES, Written, bundles, checked, checks, products, view, written

from rille.datasets.georeference import Georeference
from rille.pipeline.report import figures, gather, summary
from rille.pipeline.report.gather import compare
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.hazard.risk import RiskParams
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path import PathParams


@pytest.fixture(scope="module")
def self_checked(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The report of a run with a repaired rig and another program's poses."""
    made = bundles() | checks()
    return written(tmp_path_factory.mktemp("checked"), view(made, products=checked()), pictures=True)


def test_the_rig_is_shown_before_and_after(self_checked: Written) -> None:
    facts, page_, _, _ = self_checked
    assert {"rig", "rig-chapter", "pairs", "trajectory"} <= set(page_.ids)
    found = facts["metrics"]
    # At infinity a pitch of 0.01 rad moves rows by 60 px tan(0.01 + a) - tan(a): 0.6 px at the centre, more outside.
    assert found["rig_residual_given"]["value"] == pytest.approx(0.6, abs=0.06)
    assert found["rig_residual"]["value"] == pytest.approx(0.0, abs=1e-4)
    assert found["rig_residual"]["completeness"] == "2 basic pairs, 68 matches"
    of_matches = gather.Scene(view(bundles() | checks(), products=checked())).calibration
    assert of_matches is not None
    assert np.abs(of_matches.before) == pytest.approx(np.full(68, 0.7), abs=0.15)
    assert np.abs(of_matches.after).max() < 1e-4
    assert page_.text.count("+0.5730°") >= 2


def test_suspicions_stand_before_the_figures(self_checked: Written) -> None:
    facts, page_, _, _ = self_checked
    rig, frames = facts["warnings"]
    assert "0.60 px" in rig
    assert "frame 3" in frames
    assert facts["verdict"].startswith("Complete but for what is listed, with 2 warnings: ")
    assert page_.ids.index("missing-box") < page_.ids.index("warnings-box")
    assert page_.text.index("0.60 px") < page_.text.index("Accuracy Quantity")


@pytest.mark.parametrize(("share", "told"), [(None, 0), (12.0, 0), (29.0, 1), (190_000.0, 1)])
def test_a_crosscheck_that_is_wrong_as_a_whole_is_told(share: float | None, told: int) -> None:
    values = {"rmse": 512.3, "length": 0.27, "share": share}
    lines = summary._unlike({f"agreement_{name}": {"value": value} for name, value in values.items()})
    assert len(lines) == told
    assert all("512 m" in line and "0.270 m" in line for line in lines)


@pytest.mark.parametrize(("angle", "told"), [(0.0025, True), (0.0005, False), (0.0, False)])
def test_a_toe_in_is_told_where_it_moves_disparities_at_the_sides(angle, told, monkeypatch: pytest.MonkeyPatch) -> None:
    left, right = (Camera(707.0 * n, 707.0 * n, 612.5 * n, 184.5 * n, 1226 * n, 370 * n) for n in (2, 1))
    rig = Rig(left, right, RigidTransform(np.eye(3), np.array([-0.5, 0.0, 0.0])))
    monkeypatch.setattr(summary, "facts_of", lambda *_: {"errors": {"toe-in": [angle, 0.0001]}})
    products = SimpleNamespace(intrinsics=None)
    lines = summary.wrong_toe_in(SimpleNamespace(products=products, sequence=SimpleNamespace(rig=rig)))
    assert bool(lines) == told
    assert all("by 1.3 px" in line and "+0.143 +- 0.006 degrees" in line for line in lines)


def test_the_other_program_is_compared_frame_by_frame(self_checked: Written) -> None:
    facts, _, _, _ = self_checked
    rows, found = facts["frames"], facts["metrics"]
    assert [r["flagged"] for r in rows] == [False, False, False, True, False, False]
    assert rows[3]["disagreement_m"] == 0.002
    assert rows[3]["disagreement_deg"] == pytest.approx(0.5)
    assert rows[3]["step_disagreement_m"] == 0.002
    assert (rows[5]["disagreement_m"], rows[5]["crosscheck_error_m"]) == (None, None)
    assert facts["crosscheck"]["flagged"] == [{"frame": 3, "why": ["position", "rotation"]}]
    assert found["agreement_rmse"]["value"] == 9e-4
    assert found["agreement_rmse"]["completeness"] == "5 of 6 frames"
    assert found["agreement_flagged"]["value"] == 1
    assert found["crosscheck_drift"]["completeness"] == "5 of 6 frames"
    assert found["crosscheck_drift"]["group"] == "COLMAP against truth"
    (missing,) = facts["missing"]
    assert "frame 5" in missing["why"]
    assert facts["complete"] is True


def test_overlapping_models_and_the_choice_of_pairs_are_tabled(self_checked: Written) -> None:
    facts, _, _, _ = self_checked
    first, second = facts["pairs"]
    assert (first["overlap"], first["why_basic"], first["difference_m"]) == (None, "first frame", None)
    assert (second["overlap"], second["why_basic"], second["epipolar_px"]) == (0.72, "overlap", 0.6)
    assert second["difference_m"] == pytest.approx(-0.003, abs=1e-6)
    assert second["difference_deviation_m"] == pytest.approx(0.0, abs=1e-6)
    assert facts["metrics"]["overlap_median"]["value"] == pytest.approx(0.003, abs=1e-6)
    assert facts["metrics"]["path_inclination"]["value"] == pytest.approx(np.degrees(0.1))


def test_consumers_survive_facts_that_are_not_there(tmp_path: Path) -> None:
    made = bundles() | checks()
    rig, agreement = made["rig"].meta, made["agreement"]
    made["rig"] = Bundle({}, {"rig": rig["rig"], "source": "given calibration"})
    made["keyframes"] = Bundle({}, {"basic": list(BASIC)})
    made["agreement"] = Bundle(agreement.arrays, {})
    del made["crosscheck_accuracy"], made["orientation4"]
    facts, page_, _, _ = written(tmp_path, view(made, products=checked()))
    assert not [m for m in facts["missing"] if m["kind"] == "figure"]
    assert {"rig", "rig-chapter", "pairs", "trajectory"} <= set(page_.ids)
    assert facts["pairs"][1]["overlap"] is None


def test_a_broken_comparison_says_why(tmp_path: Path) -> None:
    made = bundles() | checks()
    reasons = ["no two images match (median 12 features an image)"]
    meta = {"pieces": [[0, 1, 2, 3], [4]], "reasons": reasons}
    made["crosscheck"] = Bundle(made["crosscheck"].arrays, made["crosscheck"].meta | meta)
    facts, _, _, _ = written(tmp_path, view(made, products=checked()))
    (missing,) = facts["missing"]
    facts_of = ("frame 5", "2 pieces", "no two images match (median 12 features an image)")
    assert [fact for fact in facts_of if fact not in missing["why"]] == []


def test_no_comparison_is_told_only_where_it_was_switched_off(tmp_path: Path) -> None:
    vehicle = Vehicle(name="rover")
    config = SimpleNamespace(
        vehicle=vehicle, risk=RiskParams(), path=PathParams(), crosscheck=SimpleNamespace(enabled=False)
    )
    facts, _, html, _ = written(tmp_path, view(config=config))
    assert facts["missing"] == []
    assert [m["kind"] for m in facts["absent"]] == ["crosscheck"]
    assert "crosscheck.enabled = false" in facts["absent"][0]["why"]
    assert 'class="note missing"' not in html
    assert 'class="note neutral"' in html
    assert facts["complete"] is True


def test_gaps_of_the_truth_are_told_and_bridged(tmp_path: Path) -> None:
    made = bundles()
    made["accuracy"]["position_truth"][[0, 3]] = np.nan
    base = view(made)
    truth = list(base.sequence.truth or ())
    truth[0] = truth[3] = None
    facts, _, _, _ = written(tmp_path, replace(base, sequence=replace(base.sequence, truth=tuple(truth))))
    gaps = [m for m in facts["absent"] if m["kind"] == "no truth"]
    assert [("0, 3" in gap["why"]) for gap in gaps] == [True]
    errors = [r["error_m"] for r in facts["frames"]]
    assert [e is None for e in errors] == [True, False, False, True, False, False]
    assert [e for e in errors if e is not None] == pytest.approx([0.0] * 4, abs=1e-12)
    assert facts["truth"]["used"] is True
    assert facts["complete"] is True


def test_truth_outside_of_the_chosen_frames_is_no_truth(tmp_path: Path) -> None:
    base = view({k: v for k, v in bundles().items() if k != "accuracy"})
    truth = (*[None] * 5, (base.sequence.truth or ())[5])
    run = replace(base, sequence=replace(base.sequence, truth=truth), frames=FRAMES[:5])
    facts, _, _, _ = written(tmp_path, run)
    assert facts["truth"]["used"] is False
    assert "not assessed against truth" in facts["verdict"]


def test_a_single_pair_has_no_trajectory_and_lacks_none(tmp_path: Path) -> None:
    made = bundles()
    trajectory = made["trajectory"]
    made["trajectory"] = Bundle({k: v[:1] for k, v in trajectory.arrays.items()}, {"frames": [0], "main": 0})
    one: Any = products()
    for name in ("disparity", "level", "local_dem", "local_risk", "local_path", "local_dem_accuracy"):
        setattr(one, name, {0: getattr(one, name)[0]})
    one.resections = []
    facts, page_, _, _ = written(tmp_path, view(made, products=one, frames=(0,)))
    assert facts["missing"] == []
    assert facts["verdict"].startswith("Complete: one stereo pair")
    assert not {"trajectory", "pairs"} & set(page_.ids)
    assert "trajectory_drift" not in facts["metrics"]


def test_numbers_of_the_cameras_that_rest_on_the_calibration_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {"focal length": [0.001, 0.002], "column": [0.0, 0.0013], "row": [0.0, 0.004], "toe-in": [0.0, 0.1]}
    monkeypatch.setattr(summary, "facts_of", lambda *_: {"errors": errors, "held": ["focal length", "row", "toe-in"]})
    (line,) = summary.resting(view())
    assert "focal length +- 0.2 %, row +- 0.4 % of the focal length" in line
    monkeypatch.setattr(summary, "facts_of", lambda *_: {})
    assert summary.resting(view()) == []


def test_residuals_of_a_part_of_the_image_are_one_median() -> None:
    points = np.array([[0.0, 0.0], [1.0, 1.0], [1.5, 0.5], [47.0, 23.0]])
    cells = figures.medians(points, np.array([1.0, 5.0, 2.0, -3.0]), (48, 24))
    assert cells.shape == (12, 24)
    assert (cells[0, 0], cells[11, 23]) == (2.0, -3.0)
    assert np.isfinite(cells).sum() == 2


def in_pieces(piece: list[int], main: int) -> dict[str, Bundle]:
    """Artifacts of a run whose trajectory falls into pieces."""
    made = bundles() | checks()
    trajectory = made["trajectory"]
    rows = [np.flatnonzero(np.array(piece) == k) for k in range(max(piece) + 1)]
    facts = {"pieces": [r.tolist() for r in rows], "main": main, "verticals": ["attitude"] * len(rows)}
    made["trajectory"] = Bundle(trajectory.arrays | {"piece": np.array(piece, dtype=np.int16)}, trajectory.meta | facts)
    return made


def test_frames_in_another_piece_are_posed_by_the_other_program_all_the_same(tmp_path: Path) -> None:
    made = in_pieces([0, 0, 0, 1, -1, -1], 0)
    found = compare(view(made, products=checked()), made["agreement"])
    # COLMAP has lost frame 5 alone. Frame 4 lies behind the other piece, so in its frame.
    assert found.registered.tolist() == [True] * 5 + [False]
    assert np.isfinite(found.poses).all(axis=(1, 2)).tolist() == [True] * 3 + [False] * 3
    facts, _, _, _ = written(tmp_path, view(made, products=checked()))
    assert [m for m in facts["missing"] if "COLMAP" in m["why"] and "frame 5" in m["why"]]
    assert "4 of 6 frames posed, 3 of them in the world," in facts["verdict"]
    assert [row["piece"] for row in facts["frames"]] == [1, 1, 1, 2, None, None]


@pytest.mark.parametrize(("main", "told"), [(0, 0), (1, 1)])
def test_a_place_on_earth_is_that_of_the_first_camera(main: int, told: int) -> None:
    run = view(in_pieces([0, 0, 1, 1, 1, 1], main))
    assert summary._displaced(run) == []
    here = replace(run.sequence, georeference=Georeference("EPSG:32633", (5e5, 5.2e6, 300.0), 0.5))
    lines = summary._displaced(replace(run, sequence=here))
    assert len(lines) == told
    assert all("world begins at frame 2" in line for line in lines)


@pytest.mark.parametrize(
    ("blurs", "told"), [([1.9, 1.8, None], "right"), ([-1.5, -1.5], "left"), ([1.2, None, None], "")]
)
def test_a_camera_that_is_out_of_focus_is_named(blurs: list[float | None], told: str) -> None:
    made, found = bundles(), checked()
    found.disparity.clear()
    for k, blur in enumerate(blurs):
        found.disparity[k] = f"disparity/{k}"  # type: ignore[assignment]
        made[f"disparity/{k}"] = Bundle({}, {} if blur is None else {"blur": blur})
    lines = summary._blurred(view(made, products=found))
    assert len(lines) == bool(told)
    assert all(line.startswith(f"the {told} images are blurred by 1.") for line in lines), lines


def test_one_frame_that_is_left_of_all_is_no_choice_of_pairs(tmp_path: Path) -> None:
    made, found = bundles() | checks(), checked()
    found.screening = "screening"  # type: ignore[assignment]
    made["screening"] = Bundle({}, {"chain": [0]})
    made["keyframes"] = Bundle({}, {"basic": [0], "overlap": [None], "why": ["first frame"], "displacement": []})
    facts, _, _, _ = written(tmp_path, view(made, products=found))
    assert not [m for m in facts["missing"] if m["kind"] == "figure"]
