"""The report on synthetic artifacts: what it says, what it admits, and that it needs nothing but itself."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from datasets.protocol import Sequence
from pipeline.reconstruct import Products
from pipeline.report import RunView, TaskRow, canvas, figures, page, summary, tables, write_report
from stages.accuracy import metric as figure
from stages.accuracy import trajectory_accuracy
from stages.declare import Bundle
from stages.dem_accuracy import dem_accuracy
from stages.errors import RilleError
from stages.geometry import Camera, Rig, RigidTransform
from stages.lattice import Lattice
from stages.path_check import path_check
from stages.vehicle import Vehicle

CELL, ROWS, COLS = 0.01, 60, 80
LATTICE = {"x0": -0.4, "y0": 0.8, "cell": CELL, "rows": ROWS, "cols": COLS}
FRAMES = tuple(range(6))
BASIC = (0, 4)
STEP = np.array([0.015, 0.030, 0.0])


def level_pose(position: np.ndarray) -> RigidTransform:
    """Optical camera at ``position``, looking along y."""
    return RigidTransform(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), position)


def sequence(*, truth: bool) -> Sequence:
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), np.array([-0.097, 0.0, 0.0])))
    # The truth's own world is turned and shifted: only alignment by the first frame brings it here.
    turn = RigidTransform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([5.0, 6.0, 7.0]))
    poses = tuple(turn @ level_pose(i * STEP) for i in FRAMES) if truth else None
    return Sequence(
        name="bed <1>",
        rig=rig,
        frames=len(FRAMES),
        image=lambda frame, camera: None,  # type: ignore[arg-type,return-value]
        frame_names=tuple(f"left{i:03d}" for i in FRAMES),
        truth=poses,
        truth_source="exact poses" if truth else "",
        notes=("Rendered for a test.",),
    )


def bundles() -> dict[str, Bundle]:
    """Artifacts of a run of six frames and two basic pairs, by the name of their handle."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:ROWS, 0:COLS]
    z = (-0.18 + 0.01 * np.sin(x / 9.0) * np.cos(y / 7.0)).astype(np.float32)
    z[:5, :9] = np.nan
    risk = np.zeros((ROWS, COLS), dtype=np.uint8)
    risk[20:30, 50:60] = 1
    risk[:5, :9] = 2
    rows = np.arange(ROWS - 1, 9, -1)
    path = np.column_stack([np.zeros(len(rows)), 0.8 - CELL * rows, np.full(len(rows), -0.18)])
    cost = np.where(risk == 0, 0.001 * (ROWS - y), np.nan).astype(np.float32)
    sigma = np.where(np.isfinite(z), 5e-4, np.nan).astype(np.float32)
    dem = {"elevation": z, "elevation_std": sigma, "ortho": (z - z[30, 30] + 0.5) * 100}
    lattice = {"lattice": LATTICE}
    path_meta = {
        "found": True,
        "reason": "",
        "blocking_row": None,
        "blocking_y": None,
        "target_row": 10,
        "length_m": 0.49,
        "climb_m": 0.004,
        "max_inclination": 0.1,
        "grid": {"ahead": [0.0, 1.0], "i0": -40, "j0": 80, "cell": CELL, "rows": ROWS, "cols": COLS},
    }
    poses = np.array([level_pose(i * STEP).matrix34 for i in FRAMES])
    made = {
        "tile": Bundle({**dem, "count": np.where(np.isfinite(z), 2, 0).astype(np.uint16)}, lattice),
        "risk": Bundle({"risk": risk, "inclination": np.full((ROWS, COLS), 0.1, dtype=np.float32)}, lattice),
        "path": Bundle({"path": path, "cost_to_go": cost, "reachable": (risk[10] == 0).astype(np.uint8)}, path_meta),
        "trajectory": Bundle(
            {
                "poses": poses,
                "covariance": np.tile(1e-8 * np.eye(6), (6, 1, 1)),
                "segment": np.array([0, 0, 0, 0, 0, 1], dtype=np.int16),
            },
            {"frames": list(FRAMES)},
        ),
    }
    error = np.where(np.isfinite(z), 4e-4, np.nan).astype(np.float32)
    judged = dem_accuracy(z, z - error, np.ones(z.shape, dtype=bool))
    made["dem_accuracy"] = Bundle({"error": error}, {**lattice, "metrics": judged})
    _, assessed = trajectory_accuracy(poses, poses)
    made["accuracy"] = Bundle({}, {"metrics": assessed})
    _, checked = path_check(path, risk, Lattice.from_dict(LATTICE))
    made["path_check"] = Bundle({}, {"metrics": checked})
    for frame in FRAMES:
        image = rng.integers(0, 255, (48, 64)).astype(np.uint8)
        made[f"image{frame}"] = Bundle({"image": image}, {"frame": frame})
    for number, segment in enumerate(((0, 1, 2, 3, 4), (4, 5))):
        points = rng.uniform(5, 40, (12, 1, 2)) + 2.0 * np.arange(len(segment))[None, :, None]
        points[3, 2:] = np.nan
        facts = [{"frame": f, "landmarks": 12, "inliers": 11, "rms_px": 0.2 + 0.01 * f} for f in segment]
        made[f"track{number}"] = Bundle({"points": points.astype(np.float32)}, {"frames": list(segment)})
        made[f"resect{number}"] = Bundle(
            {"inlier": np.ones((12, len(segment)), dtype=np.uint8)},
            {"per_frame": facts, "landmark_source": "disparity"},
        )
    column = np.full((48, 64), -8.0, dtype=np.float32)
    column[:4] = np.nan
    validity = np.where(np.isfinite(column), 1, 16).astype(np.uint8)
    for pair in BASIC:
        made[f"disparity{pair}"] = Bundle(
            {"column_disparity": column, "row_disparity": 0.1 * column, "validity": validity}, {}
        )
        made[f"level{pair}"] = Bundle({}, {"source": "pitch"})
        made[f"local_dem{pair}"] = Bundle(dem, {**lattice, "defined": 0.9, "median_elevation_std": 5e-4})
        metrics = {"rmse": figure(1e-3 * (1 + pair), "m", "x"), "completeness": figure(0.9 - 0.05 * pair, "1", "x")}
        made[f"local_dem_accuracy{pair}"] = Bundle({}, {"metrics": metrics})
        made[f"local_risk{pair}"] = made["risk"]
        made[f"local_path{pair}"] = made["path"]
    return made


def products() -> Products:
    def each(name: str, numbers: tuple[int, ...]) -> dict[int, Any]:
        return {n: f"{name}{n}" for n in numbers}

    found: Any = Products(
        images=each("image", FRAMES),
        disparity=each("disparity", BASIC),
        level=each("level", BASIC),
        local_dem=each("local_dem", BASIC),
        local_risk=each("local_risk", BASIC),
        local_path=each("local_path", BASIC),
        world_dem=each("world_dem", BASIC),
        local_dem_accuracy=each("local_dem_accuracy", BASIC),
    )
    found.tracks, found.resections, found.tiles = ["track0", "track1"], ["resect0", "resect1"], ["tile"]
    found.trajectory, found.risk, found.path, found.dem_accuracy = "trajectory", "risk", "path", "dem_accuracy"
    found.accuracy, found.path_check = "accuracy", "path_check"
    return found  # type: ignore[no-any-return]


TASKS = (
    TaskRow("hfvm/0", "hfvm", "computed", 2.0),
    TaskRow("hfvm/4", "hfvm", "cached", 4.0),
    TaskRow("locus/local/0", "locus", "computed", 1.0),
    TaskRow("locus/local/4", "locus", "computed", 1.0),
    TaskRow("locus/world/0", "locus", "cached", 0.5),
    TaskRow("risk/local/0", "risk", "computed", 0.1),
    TaskRow("path/local/0", "path", "computed", 0.1),
    TaskRow("track/0", "track", "computed", 0.3),
    TaskRow("resect/0", "resect", "computed", 0.2),
    TaskRow("pyramid/left/0", "pyramid", "cached", 0.05),
)


def view(made: dict[str, Bundle] | None = None, *, truth: bool = True, **changes: Any) -> RunView:
    store = bundles() if made is None else made
    base = RunView(
        run_id="20260101T000000Z-abcdef12",
        sequence=sequence(truth=truth),
        frames=FRAMES,
        products=products(),
        bundle=lambda handle: store.get(handle) if isinstance(handle, str) else None,
        tasks=TASKS,
        config=SimpleNamespace(vehicle=Vehicle()),
        config_toml="[locus]\ncell_size = 0.01  # <m>\n",
        seconds=12.3,
        versions={"rille": "0.1.0", "numpy": "2.4"},
        command="rille reconstruct bed",
        vehicle_source="sequence",
    )
    return replace(base, **changes)


class Page(HTMLParser):
    """Text in reading order, addresses, identifiers, images."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.images: list[dict[str, Any]] = []
        self._hidden = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self._hidden = tag == "style"
        self.addresses += [str(found[k]) for k in ("src", "href", "srcset", "action", "data", "poster") if k in found]
        self.ids += [str(found["id"])] if "id" in found else []
        self.images += [found] if tag == "img" else []
        assert tag not in {"script", "link", "iframe", "object", "embed"}

    def handle_endtag(self, tag: str) -> None:
        self._hidden = self._hidden and tag != "style"

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


Written = tuple[dict[str, Any], Page, str, Path]


def written(folder: Path, run: RunView) -> Written:
    write_report(folder, run)
    html = (folder / "report.html").read_text(encoding="utf-8")
    return json.loads((folder / "report.json").read_text(encoding="utf-8")), Page(html), html, folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The report of a run that lacks nothing, written once."""
    return written(tmp_path_factory.mktemp("whole"), view())


def test_a_whole_run_has_every_figure_and_nothing_missing(whole: Written) -> None:
    facts, page_, html, folder = whole
    assert facts["missing"] == []
    assert facts["complete"] is True
    assert facts["verdict"] == "Complete: 6 of 6 frames posed, 2 of 2 elevation models, a path of 0.49 m."
    for anchor in (
        "figure-6",
        "figure-7",
        "risk-map",
        "figure-3",
        "figure-8",
        "figure-9",
        "terrain",
        "elevation-error",
    ):
        assert anchor in page_.ids
    assert len(page_.images) == 4 + 2 + 2 + 2 + 4 + 2 + 3 + 1
    assert all(image["alt"] for image in page_.images)
    assert len(html) < 5_000_000
    assert {p.name for p in folder.iterdir()} == {"report.html", "report.json"}


def test_the_page_needs_nothing_but_itself(whole: Written) -> None:
    _, page_, html, _ = whole
    assert page_.addresses
    assert all(a.startswith(("data:image/", "#")) for a in page_.addresses)
    assert {a[1:] for a in page_.addresses if a.startswith("#")} <= set(page_.ids)
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", re.sub(r"data:image/[^\"]+", "", html))


def test_text_from_outside_is_escaped(whole: Written) -> None:
    _, page_, html, _ = whole
    assert "bed <1>" in page_.text
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


def test_error_never_without_completeness(whole: Written) -> None:
    facts, _, _, _ = whole
    found = facts["metrics"]
    assert found["dem_pairs_rmse_max"]["value"] == pytest.approx(5e-3)
    assert found["dem_pairs_rmse_median"]["value"] == pytest.approx(3e-3)
    assert found["dem_pairs_completeness_min"]["value"] == pytest.approx(0.7)
    assert found["dem_merged_rmse"]["value"] == pytest.approx(4e-4, rel=1e-3)
    assert found["path_check_hazard_cells"]["value"] == 0
    for name, metric in found.items():
        if metric["truth"] and not name.startswith("path_check"):
            assert metric["completeness"], name
    assert found["trajectory_kitti_translation"]["value"] is None
    assert "not applicable" in found["trajectory_kitti_translation"]["how"]


def test_without_truth_it_says_so_and_shows_no_errors(tmp_path: Path) -> None:
    made = {k: v for k, v in bundles().items() if "accuracy" not in k and k != "path_check"}
    facts, page_, _, _ = written(tmp_path, view(made, truth=False))
    assert facts["complete"] is True
    assert [m["kind"] for m in facts["missing"]] == ["no truth"]
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
        TaskRow("trajectory", "trajectory", "skipped", None, "resect/4 failed"),
        TaskRow("risk/world", "risk", "skipped", None, "resect/4 failed"),
    )
    facts, page_, _, _ = written(tmp_path, view(made, tasks=tasks))
    assert facts["complete"] is False
    assert facts["verdict"].startswith("Incomplete: 0 of 6 frames posed, 1 of 2 elevation models, no path")
    kinds = [m["kind"] for m in facts["missing"]]
    assert kinds[:4] == ["failed", "skipped", "no pose", "no path"]
    skipped = facts["missing"][1]
    assert skipped["what"] == "trajectory, risk/world"
    text = page_.text
    assert text.index("3 landmarks, 6 are needed") < text.index("Key figures Quantity")
    assert page_.ids[0] == "missing-box"
    assert "figure-9" not in page_.ids


def test_frames_without_a_pose_are_named(tmp_path: Path) -> None:
    made = bundles()
    poses = made["trajectory"]["poses"].copy()
    poses[[2, 3, 5]] = np.nan
    made["trajectory"] = Bundle({**made["trajectory"].arrays, "poses": poses}, made["trajectory"].meta)
    facts, _, _, _ = written(tmp_path, view(made))
    lost = next(m for m in facts["missing"] if m["kind"] == "no pose")
    assert lost["what"] == "3 of 6 frames have no pose"
    assert lost["why"] == "frames 2-3, 5"
    assert facts["frames"][2]["x_m"] is None
    assert facts["complete"] is False


def test_no_path_names_the_row_that_blocks(tmp_path: Path) -> None:
    made = bundles()
    meta = {"found": False, "reason": "no free cell of this row can be entered", "blocking_row": 17, "blocking_y": 0.63}
    meta |= {"target_row": 0, "length_m": None, "climb_m": None, "max_inclination": None}
    arrays = {**made["path"].arrays, "path": np.empty((0, 3))}
    made["path"] = made["local_path0"] = made["local_path4"] = Bundle(arrays, meta)
    facts, page_, _, _ = written(tmp_path, view(made))
    assert facts["complete"] is True  # an answer, not a hole
    assert facts["missing"] == [
        {
            "kind": "no path",
            "what": "No path",
            "why": "no free cell of this row can be entered; blocked at row 17, 0.63 m ahead",
        }
    ]
    assert "path_length" not in facts["metrics"]
    assert "risk-map" in page_.ids


def test_nothing_at_all_still_makes_a_page(tmp_path: Path) -> None:
    facts, page_, _, _ = written(tmp_path, view({}, tasks=(), products=Products()))
    assert facts["complete"] is False
    assert page_.images == []
    assert any(m["kind"] == "no pose" for m in facts["missing"])


def test_a_figure_that_cannot_be_drawn_is_admitted(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "disparity", lambda *a: 1 / 0)
        facts, page_, _, _ = written(tmp_path, view(bundles()))
    assert "figure-6" not in page_.ids
    assert "figure-7" in page_.ids
    assert any(m["kind"] == "figure" and "ZeroDivisionError" in m["why"] for m in facts["missing"])


def test_table_2_sums_the_units_of_a_cycle() -> None:
    rows, together = tables.table_2(view())
    assert [t.in_1999 for t in rows] == [40, 20, 1, 1, 5, 5]
    hfvm = rows[0]
    assert (hfvm.unit, hfvm.total, hfvm.computed, hfvm.cached) == (3.0, 6.0, 1, 1)
    assert rows[1].tasks == 2  # the world's Locus is not among the local ones
    assert together.in_1999 == 72
    assert together.unit == pytest.approx(3.0 + 1.0 + 0.1 + 0.1 + 0.3 + 0.2)
    assert [t.name for t in tables.other_stages(view())] == ["locus/world", "pyramid"]


def test_a_failed_write_leaves_the_old_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "report.html").write_text("old")

    def broken(source: object, target: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises((OSError, RilleError), match="disk full"):
        write_report(tmp_path, view({}, tasks=(), products=Products()))
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (0.0004312, "m", "0.431 mm"),
        (1.234567, "m", "1.23 m"),
        (-0.00012, "m", "−0.120 mm"),
        (12, "frames", "12 frames"),
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
def test_numbers_have_sensible_digits(value: Any, unit: str, words: str) -> None:
    assert page.quantity(value, unit) == words


def test_shrinking_averages_what_is_defined() -> None:
    a = np.array([[1.0, 3.0, np.nan, np.nan], [5.0, np.nan, np.nan, np.nan]], dtype=np.float32)
    np.testing.assert_allclose(canvas.shrink(a, 2), [[3.0, np.nan]])
    assert canvas.shrink(a, 4) is not None
    assert canvas.shrink(np.ones((5, 9, 3)), 3).shape == (1, 3, 3)


def test_limits_are_robust_and_never_empty() -> None:
    values = np.concatenate([np.linspace(0, 1, 1000), [1e6]])
    assert canvas.limits(values)[1] < 1.0
    for constant in (np.full(5, np.nan), np.zeros(5), np.full(5, 3.0)):
        low, high = canvas.limits(constant)
        assert high > low


def test_measured_and_interpolated_are_told_apart() -> None:
    bits = np.array([[1, 2, 2 | 4, 8, 0]], dtype=np.uint8)
    np.testing.assert_array_equal(figures.validity_classes(bits), [[0, 1, 1, 2, 2]])


def test_ground_limits_ignore_crowns() -> None:
    ground = np.linspace(-1.7, -1.6, 900)
    crowns = np.full(90, 2.0)
    low, high = canvas.ground_limits(np.concatenate([ground, crowns]))
    # The ground spreads by 0.1 m: its robust deviation is 0.037 m, five of them 0.19 m.
    assert -1.7 <= low < -1.69
    assert -1.6 <= high < -1.4


def test_shading_is_bright_towards_the_light() -> None:
    x, y = np.meshgrid(np.arange(9.0), -np.arange(9.0))  # row 0 at the greatest y
    towards, away = figures._shade(0.5 * (x - y), 1.0), figures._shade(-0.5 * (x - y), 1.0)
    assert towards[4, 4] > figures._shade(0 * x, 1.0)[4, 4] > away[4, 4]


def test_spans() -> None:
    assert summary._spans([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
