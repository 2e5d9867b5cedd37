"""The report on synthetic artifacts: what it says, what it admits, and that it needs nothing but itself."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from toys.finished import BASIC, TASKS, Written, bundles, products, report, view, written

from rille.datasets.georeference import Georeference
from rille.datasets.mockup.sequence import vehicle_at_scale
from rille.pipeline.export.view import TaskRow
from rille.pipeline.flow.products import Driven, Products
from rille.pipeline.report import canvas, figures, gather, metrics, strips
from rille.pipeline.report.delivery import lacking
from rille.stages.core import quantities
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import RilleError
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.hazard.risk import RiskParams
from rille.stages.odometry.resection.trajectory import Chained, account
from rille.stages.planning.path import PathParams


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The report of a run that lacks nothing, written once."""
    return written(tmp_path_factory.mktemp("whole"), view(), pictures=True)


def test_a_whole_run_has_every_figure_and_nothing_missing(whole: Written) -> None:
    facts, page_, html, folder = whole
    assert facts["missing"] == []
    assert facts["complete"] is True
    assert facts["absent"] == []
    assert facts["verdict"].startswith("Complete: ")
    assert "Nothing is missing" in page_.text
    for anchor in ("map", "map-view", "trajectory", "elevation-error", "pairs", "stops"):
        assert anchor in page_.ids
    assert len(page_.images) == 5 + len(BASIC)
    assert facts["warnings"] == []
    assert "warnings-box" not in page_.ids
    assert all(image["alt"] for image in page_.images)
    assert len(html) < 5_000_000
    assert {p.name for p in folder.iterdir()} == {"report.html", "report.json"}


def test_pictures_of_the_pairs_keep_to_their_budget(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    whole = strips.pairs(gather.Scene(view()))
    assert whole is not None
    assert [p.frame for p in whole.panels] == list(BASIC)
    size = sum(len(p.uri) for p in whole.panels)
    assert size <= strips.BUDGET_CHARACTERS
    monkeypatch.setattr(strips, "BUDGET_CHARACTERS", size // 2)
    smaller = strips.pairs(gather.Scene(view()))
    assert smaller is not None
    assert smaller.panels[0].width < whole.panels[0].width
    monkeypatch.setattr(strips, "BUDGET_CHARACTERS", 3000)
    fewer = strips.pairs(gather.Scene(view()))
    assert fewer is not None
    assert len(fewer.panels) == 1
    assert "1 of 2 are shown" in written(tmp_path, view())[1].text


def test_the_page_needs_nothing_but_itself(whole: Written) -> None:
    _, page_, html, folder = whole
    assert page_.addresses
    files = {path.name for path in folder.iterdir()}
    assert all(a.startswith(("data:image/", "#")) or a in files for a in page_.addresses)
    assert {a[1:] for a in page_.addresses if a.startswith("#")} <= set(page_.ids)
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", re.sub(r"data:image/[^\"]+", "", html))


def test_text_from_outside_is_escaped(whole: Written) -> None:
    _, page_, html, _ = whole
    assert "Rendered for test <1>." in page_.text
    assert "<1>" not in html
    assert "<m>" not in html


def test_report_json_has_the_promised_shape(whole: Written) -> None:
    facts, _, _, _ = whole
    for key in ("run", "command", "missing", "sequence", "truth", "metrics", "stages", "versions", "seconds", "frames"):
        assert key in facts
    for name, metric in facts["metrics"].items():
        assert set(metric) >= {"label", "value", "unit", "how", "truth", "completeness"}, name
        assert metric["how"]
    assert facts["stages"]["hfvm"] == {
        "computed": 1,
        "cached": 1,
        "failed": 0,
        "skipped": 0,
        "seconds": 2.0,
        "seconds_when_computed": 6.0,
    }
    assert facts["metrics"]["path_length"]["value"] == 0.49
    # 5 x 9 of the 60 x 80 cells of 1 cm are undefined.
    assert facts["metrics"]["mapped_area"]["value"] == pytest.approx((60 * 80 - 45) * 1e-4)
    assert facts["metrics"]["unknown"]["value"] == pytest.approx(45 / 4800)


def test_truth_is_aligned_by_the_first_frame_alone(whole: Written) -> None:
    facts, page_, _, _ = whole
    # The estimate equals the truth up to the truth's own world frame.
    assert [r["error_m"] for r in facts["frames"]] == pytest.approx([0.0] * 6, abs=1e-12)
    assert facts["truth"] == {"used": True, "source": "exact poses"}
    assert "exact poses" in page_.text


def test_pairs_without_any_cell_have_no_error_but_a_completeness() -> None:
    found = metrics._local_elevation(view(), [{"rmse_m": None, "completeness": 0.0}])
    assert found["dem_pairs_rmse_max"]["value"] is None
    assert found["dem_pairs_rmse_median"]["value"] is None
    assert found["dem_pairs_completeness_min"]["value"] == 0.0


def test_the_median_of_a_large_map_of_which_little_is_known_is_that_of_all_that_is() -> None:
    rng = np.random.default_rng(0)
    values = np.full(4_000_000, np.nan)
    values[rng.choice(values.size, 2000, replace=False)] = np.arange(2000.0)
    assert len(canvas.sample(values.reshape(2000, 2000))) == 2000


def test_error_never_without_completeness(whole: Written) -> None:
    facts, _, _, _ = whole
    found = facts["metrics"]
    assert found["dem_pairs_rmse_max"]["value"] == pytest.approx(5e-3)
    assert found["dem_pairs_rmse_median"]["value"] == pytest.approx(3e-3)
    assert found["dem_pairs_completeness_min"]["value"] == pytest.approx(0.7)
    assert found["dem_merged_rmse"]["value"] == pytest.approx(4e-4, rel=1e-3)
    assert found["path_check_hazard_cells"]["value"] == 0
    # Named by itself: the way of the trajectory's truth is another path.
    assert found["path_check_path_length"]["label"] == "Path length"
    for name, metric in found.items():
        if metric["truth"] and not name.startswith("path_check"):
            assert metric["completeness"], name


def test_without_truth_it_says_so_and_shows_no_errors(tmp_path: Path) -> None:
    made = {k: v for k, v in bundles().items() if "accuracy" not in k and k != "path_check"}
    facts, page_, html, _ = written(tmp_path, view(made, truth=False))
    assert facts["complete"] is True
    assert facts["missing"] == []
    assert [m["kind"] for m in facts["absent"]] == ["no truth"]
    assert 'class="note missing"' not in html, "what every user's own data have is no fault"
    answers = "Answers, and what was not asked for or is not available No truth"
    assert page_.text.index("Nothing is missing") < page_.text.index(answers)
    assert all(metric["truth"] is None for metric in facts["metrics"].values())
    assert all(r["error_m"] is None for r in facts["frames"])
    assert "not assessed against truth" in page_.text
    assert "elevation-error" not in page_.ids


def test_what_is_missing_comes_first(tmp_path: Path) -> None:
    made = {
        k: v for k, v in bundles().items() if k not in {"trajectory", "tile", "risk", "path", "resect1", "local_dem4"}
    }
    tasks = (
        *TASKS,
        TaskRow("resect/4", "resect", "failed", None, "frame 5: 3 landmarks, 6 are needed: set track.points higher"),
        TaskRow("trajectory", "trajectory", "skipped", None, "resect/4 failed", "resect/4"),
        TaskRow("risk/world", "risk", "skipped", None, "resect/4 failed", "resect/4"),
    )
    facts, page_, _, _ = written(tmp_path, view(made, tasks=tasks))
    assert facts["complete"] is False
    assert facts["verdict"].startswith("Incomplete: 0 of 6 frames")
    kinds = [m["kind"] for m in facts["missing"]]
    assert kinds[:3] == ["failed", "no pose", "no path"]
    text = page_.text
    assert text.index("3 landmarks, 6 are needed") < text.index("Accuracy Quantity")
    assert page_.ids.index("missing-box") < page_.ids.index("trajectories")
    assert "trajectory" not in page_.ids


def test_a_warning_outranks_that_nothing_is_missing(tmp_path: Path) -> None:
    facts = {"models": [], "seam_count": 0, "seams": [], "warnings": ["the models are askew"]}
    made = bundles() | {"overlap_audit": Bundle({}, facts)}
    facts, page_, _, _ = written(tmp_path, view(made, products=products(made)))
    assert facts["complete"] is True
    assert facts["verdict"].startswith("Complete, with 1 warning: ")
    assert page_.text.index("The models are askew") < page_.text.index("Nothing is missing")


def test_what_is_missing_is_no_warning_besides(tmp_path: Path) -> None:
    wrong, more = "4 of 6 elevation models contradict their neighbours", "a seam of pair 3 is rough"
    facts = {"models": [], "seam_count": 0, "seams": [], "warnings": [wrong, more], "contradiction": wrong}
    made = bundles() | {"overlap_audit": Bundle({}, facts)}
    told, page_, _, _ = written(tmp_path, view(made, products=products(made)))
    assert wrong in told["warnings"]
    assert page_.text.index("Look at this A seam of pair 3 is rough.") > page_.text.index(f"Missing {wrong}")


def test_frames_without_a_pose_are_named(tmp_path: Path) -> None:
    made = bundles()
    poses, piece = (made["trajectory"][name].copy() for name in ("poses", "piece"))
    poses[[2, 3, 5]], piece[[2, 3, 5]] = np.nan, -1
    made["trajectory"] = Bundle({**made["trajectory"].arrays, "poses": poses, "piece": piece}, made["trajectory"].meta)
    facts, _, _, _ = written(tmp_path, view(made))
    lost = next(m for m in facts["missing"] if m["kind"] == "no pose")
    assert "2-3, 5" in lost["why"]
    assert facts["frames"][2]["x_m"] is None
    assert facts["complete"] is False


def test_frames_posed_are_counted_alike_all_over_the_report(tmp_path: Path) -> None:
    """Of six frames five have a pose, three of them in the world; the other two are a piece of their own."""
    made = bundles()
    arrays, piece = dict(made["trajectory"].arrays), np.array([0, 0, 0, -1, 1, 1], dtype=np.int16)
    arrays["poses"] = np.where((piece < 0)[:, None, None], np.nan, arrays["poses"])
    arrays |= {"piece": piece}
    found = Chained(own_covariance=arrays["covariance"], **arrays)
    facts = account([0, 1, 2, 3, 4, 5], found, {3: "black"}, ["attitude", "attitude"])
    made["trajectory"] = Bundle(arrays, {"frames": [0, 1, 2, 3, 4, 5]} | facts)
    facts, _, _, _ = written(tmp_path, view(made))
    assert facts["metrics"]["frames_posed"]["value"] == 5
    assert facts["metrics"]["frames_in_world"]["value"] == 3
    assert facts["verdict"].startswith("Incomplete: 5 of 6 frames")
    assert [(m["kind"], m["why"]) for m in facts["missing"]] == [("no pose", "frame 3"), ("piece", "frames 4-5")]
    assert [(r["posed"], r["piece"]) for r in facts["frames"]] == [(True, 1)] * 3 + [(False, None)] + [(True, 2)] * 2


@pytest.mark.parametrize(("y", "where"), [(0.63, "0.63 m ahead of"), (-1.12, "1.12 m behind")])
def test_no_path_says_how_far_ahead_it_is_blocked(tmp_path: Path, y: float, where: str) -> None:
    made = bundles()
    meta = {"found": False, "reason": "no way through", "blocking_y": y}
    meta |= {"length_m": None, "climb_m": None, "max_inclination": None}
    arrays = {**made["path"].arrays, "path": np.empty((0, 3))}
    made["path"] = made["local_path0"] = made["local_path4"] = Bundle(arrays, meta)
    facts, page_, _, _ = written(tmp_path, view(made))
    assert facts["complete"] is True  # an answer, not a hole
    (missing,) = facts["missing"]
    assert missing["kind"] == "no path"
    assert [fact for fact in ("no way through", f" {where} the first") if fact not in missing["why"]] == []
    assert facts["metrics"]["local_paths"]["value"] == 0
    assert facts["verdict"].startswith("Complete but for")
    assert "path_length" not in facts["metrics"]
    assert "path_start" not in facts["metrics"]
    assert "There is no path: no way through" in page_.text
    assert "map" in page_.ids


def test_a_stop_without_a_local_path_is_told_but_lacks_nothing(tmp_path: Path) -> None:
    made = bundles()
    meta = {**made["path"].meta, "found": False, "reason": "no free cell", "length_m": None}
    made["local_path4"] = Bundle({**made["path"].arrays, "path": np.empty((0, 3))}, meta)
    facts, _, _, _ = written(tmp_path, view(made))
    assert facts["missing"] == []
    (absent,) = facts["absent"]
    assert "no free cell" in absent["why"]
    assert facts["verdict"].startswith("Complete: ")


def test_a_path_says_where_it_starts_when_that_is_not_at_the_vehicle(tmp_path: Path) -> None:
    """It starts 0.21 m ahead of the camera: within the length of the default rover, but two of a rover at 1:10."""
    config = SimpleNamespace(vehicle=vehicle_at_scale(), risk=RiskParams(), path=PathParams())
    facts, _, _, _ = written(tmp_path, view(config=config))
    assert facts["metrics"]["path_start"]["value"] == pytest.approx(0.21)
    assert "starts 0.210 m" in facts["verdict"]
    near, _, _, _ = written(tmp_path, view())
    assert "starts" not in near["verdict"]


@pytest.mark.parametrize("verdict", ["goal", "no path"])
def test_a_drive_that_arrived_does_not_say_that_there_is_no_path(tmp_path: Path, verdict: str) -> None:
    made = products()
    made.path, made.local_path = None, {}
    made.drive = Driven(verdict=verdict, reason="" if verdict == "goal" else "hazards all around")
    facts, page_, _, _ = written(tmp_path, view(products=made))
    assert "There is no path" not in page_.text
    of_drive = [m for m in facts["missing"] if m["what"].startswith("Drive:")]
    missing = [m["what"] for m in of_drive]
    assert (not lacking(of_drive)) == (verdict == "goal")  # as the exit code says: the goal was asked for
    if verdict == "goal":
        assert "map-still" in page_.ids
        assert "goal was reached" in page_.text
        assert missing == []
    else:
        assert "hazards all around" in page_.text
        assert missing == ["Drive: no path"]


def test_nothing_at_all_still_makes_a_page(tmp_path: Path) -> None:
    facts, page_, _, _ = written(tmp_path, view({}, tasks=(), products=Products()))
    assert facts["complete"] is False
    assert page_.images == []
    assert any(m["kind"] == "no pose" for m in facts["missing"])


def test_a_figure_that_cannot_be_drawn_is_admitted(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "raster", lambda *a, **k: 1 / 0)
        facts, page_, _, _ = written(tmp_path, view(bundles()))
    assert "elevation-error" not in page_.ids
    assert "trajectory" in page_.ids
    lost = [m for m in facts["missing"] if m["kind"] == "figure"]
    assert {m["what"] for m in lost} == {"Elevation error"}
    assert all("ZeroDivisionError" in m["why"] for m in lost)
    assert not facts["complete"]


def test_a_failed_write_leaves_the_old_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "report.html").write_text("old")

    def broken(source: object, target: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises((OSError, RilleError), match="disk full"):
        report(tmp_path, view({}, tasks=(), products=Products()))
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0004312, "m", "0.431 mm"),
        (1.234567, "m", "1.23 m"),
        (-0.00012, "m", "−0.120 mm"),
        (12, "frames", "12 frames"),
        (1, "frames", "1 frame"),
        (0.0, "m", "0 m"),
        (17.25, "deg", "17.2°"),
        (None, "m", "–"),
        ("pitch", "", "pitch"),
        (1234.5678, "s", "1235 s"),
        (0.1234, "1", "12.3 %"),
        (3.1e-17, "m", "0 m"),
        (3.1e-7, "%", "3e−07 %"),
    ],
)
def test_numbers_have_sensible_digits(value: Any, unit: str, text: str) -> None:
    assert quantities.quantity(value, unit) == text


def test_signed_lengths_have_a_plus_where_they_are_positive() -> None:
    lengths = 0.0123, -0.0123, 3.1e-17, None, np.nan
    assert [quantities.metres(v, signed=True) for v in lengths] == ["+12.3 mm", "−12.3 mm", "0 m", "–", "–"]


def test_limits_are_robust_and_never_empty() -> None:
    values = np.concatenate([np.linspace(0, 1, 1000), [1e6]])
    assert canvas.limits(values)[1] < 1.0
    for constant in (np.full(5, np.nan), np.zeros(5), np.full(5, 3.0)):
        low, high = canvas.limits(constant)
        assert high > low


def test_ground_limits_ignore_crowns() -> None:
    ground = np.linspace(-1.7, -1.6, 900)
    crowns = np.full(90, 2.0)
    low, high = canvas.ground_limits(np.concatenate([ground, crowns]))
    # The ground spreads by 0.1 m: its robust deviation is 0.037 m, five of them 0.19 m.
    assert -1.7 <= low < -1.69
    assert -1.6 <= high < -1.4


def test_spans() -> None:
    assert quantities.spans([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"


def test_frames_without_truth_are_counted_where_errors_are_stated(tmp_path: Path) -> None:
    base = view()
    assert base.sequence.truth is not None
    truth = tuple(None if k in (1, 3) else pose for k, pose in enumerate(base.sequence.truth))
    facts, _, _, _ = written(tmp_path, replace(base, sequence=replace(base.sequence, truth=truth)))
    assert facts["metrics"]["trajectory_ate_rmse"]["completeness"] == "6 of 6 frames, truth for 4"
    assert facts["metrics"]["frames_posed"]["completeness"] == "6 of 6 frames"


def test_the_page_says_where_the_files_lie(tmp_path: Path) -> None:
    base = view()
    assert "EPSG" not in written(tmp_path, base)[1].text
    place = Georeference("EPSG:32633", (1.0, 2.0, 3.0), 0.5)
    page_ = written(tmp_path, replace(base, sequence=replace(base.sequence, georeference=place)))[1]
    assert "EPSG:32633" in page_.text


def test_a_curve_of_many_frames_does_not_fill_the_page() -> None:
    def size(frames: int) -> int:
        values = np.random.default_rng(frames).normal(size=frames)
        plot = figures.Plot("x", (figures.Curve("y", canvas.INK, values),))
        return len(figures.curves(range(frames), [plot], "frame", "", marked=range(0, frames, 2)).uri)

    assert size(4000) < 10 * size(400)


@pytest.mark.parametrize("roll", [0.0, 1.57, 3.14])
@pytest.mark.parametrize(
    "centre", [(0.1, 0.01, 0.0), (-0.1, 0.0, 0.0), (0.01, 0.1, 0.0), (0.0, -0.1, 0.0), (0, 0, 0.2)]
)
def test_near_pixels_of_a_pair_are_yellow_and_far_ones_blue(centre: tuple[float, float, float], roll: float) -> None:
    camera, rotation = Camera(60.0, 60.0, 31.5, 23.5, 64, 48), rotation_exp([0.0, 0.0, roll])
    rig = Rig(camera, camera, RigidTransform(rotation, -rotation @ np.array(centre)))
    pixels = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), -1)
    depth = np.where(pixels[..., :1] < 32, 1.0, 5.0)
    column, row = np.moveaxis(rig.right.project(rig.T_right_left.apply(depth * camera.rays(pixels))) - pixels, -1, 0)
    maps = {"column_disparity": column, "row_disparity": row, "validity": np.ones((48, 64), np.uint8)}
    photo = Image.new("RGBA", (32, 24), "black")
    left, right = np.asarray(strips.matches_picture(photo, Bundle(maps, {}), rig))[12, [4, -4], :3].astype(int)
    assert (left[:2] > left[2] + 50).all()
    assert right[2] > right[:2].max()


def test_both_cameras_are_told_where_they_differ(tmp_path: Path) -> None:
    given = view()
    small = Camera(30.0, 30.0, 15.5, 11.5, 32, 24)
    rig = replace(given.sequence.rig, right=small)
    facts, _, _, _ = written(tmp_path, replace(given, sequence=replace(given.sequence, rig=rig)))
    told = facts["sequence"]
    assert (told["image_width_px"], told["image_height_px"], told["focal_length_px"]) == (64, 48, 60.0)
    assert [told[f"right_{name}"] for name in ("image_width_px", "image_height_px", "focal_length_px")] == [
        32,
        24,
        30.0,
    ]


def test_a_gap_is_a_dash_in_words() -> None:
    assert [quantities.number(np.nan), quantities.metres(np.nan), quantities.metres(None)] == ["–"] * 3
