"""The benchmark of dense matching: figures, filling, truth files, and the truth of a knocked camera."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.stereo import limits, methods, pairs, ratios, timing
from benchmarks.stereo.measures import Found, Truth, fill, judge, locking
from benchmarks.stereo.misalignment import camera_of, conditions, knocked
from benchmarks.stereo.pairs import Pair, measured, parallel, read_truth
from rille.datasets.images.misalign import MisalignParams

NONE = np.nan


def found(u: Any, rows: bool = True, v: Any = None) -> Found:
    column = np.asarray(u, np.float64)
    row = np.zeros_like(column) if v is None else np.asarray(v, np.float64)
    return Found(column, row, np.isfinite(column), rows)


def texture(shape: tuple[int, int], smooth: float, seed: int = 3) -> NDArray[np.float64]:
    grey = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(shape), smooth, mode="wrap")
    return 128.0 + 40.0 * grey / grey.std()


class TestMeasures:
    def test_the_truth_itself_has_no_error(self) -> None:
        truth = parallel(np.random.default_rng(0).uniform(1, 40, (20, 30)))
        figures = judge(found(truth.u), truth)
        wrong = [figures[k] for k in figures if k.startswith("bad") and k != "bad2_own"]
        assert wrong == [0.0] * len(wrong)
        assert figures["median"] == 0.0
        assert figures["completeness"] == 1.0

    def test_figures_of_a_hand_made_row(self) -> None:
        truth = parallel(np.array([[10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, NONE]]))
        # off by 0, 0.5, 1.5, 2.5, 3.5; then two holes that the background (9) fills; the last one has no truth
        figures = judge(found([[-10.0, -10.5, -11.5, -12.5, -13.5, NONE, NONE, -9.0]]), truth)
        assert [figures[f"bad{t}"] for t in (1, 2, 3)] == pytest.approx([3 / 7, 2 / 7, 1 / 7])
        assert [figures[f"bad{t}_matched"] for t in (1, 2, 3)] == pytest.approx([3 / 5, 2 / 5, 1 / 5])
        assert figures["median"] == 1.5
        assert figures["completeness"] == pytest.approx(5 / 7)

    def test_rows_without_any_match_are_bad(self) -> None:
        truth = parallel(np.full((2, 4), 5.0))
        figures = judge(found([[-5.0] * 4, [NONE] * 4]), truth)
        assert [figures[f"bad{t}"] for t in (1, 2, 3)] == [0.5] * 3
        assert figures["bad2_matched"] == 0.0

    def test_nothing_matched_is_all_bad(self) -> None:
        figures = judge(found(np.full((2, 4), NONE)), parallel(np.full((2, 4), 5.0)))
        assert figures["bad3"] == 1.0
        assert figures["median"] is None
        assert figures["completeness"] == 0.0

    def test_rows_count_for_those_that_search_them_only(self) -> None:
        truth = parallel(np.full((1, 4), 5.0))
        u, v = np.full((1, 4), -5.0), np.full((1, 4), 4.0)
        assert judge(found(u, True, v), truth)["bad3"] == 1.0
        assert judge(found(u, True, v), truth)["bad3_column"] == 0.0
        assert judge(found(u, False, v), truth)["bad3"] == 0.0

    def test_counterparts_outside_the_image_are_told_apart(self) -> None:
        truth = parallel(np.full((1, 10), 4.0))
        assert judge(found([[NONE, NONE, NONE, NONE, *[-4.0] * 6]]), truth)["bad2_inside"] == 0.0
        assert judge(found([[-9.0, -9.0, -9.0, -9.0, *[-4.0] * 6]]), truth)["bad2"] == 0.4
        assert judge(found([[-9.0, -9.0, -9.0, -9.0, *[-4.0] * 6]]), truth)["bad2_inside"] == 0.0

    def test_filling_takes_the_background_and_its_row(self) -> None:
        filled = fill(found([[NONE, -8.0, NONE, NONE, -3.0, NONE]], v=[[0.0, 1.0, 0.0, 0.0, 2.0, 0.0]]))
        assert filled.u.tolist() == [[-8.0, -8.0, -3.0, -3.0, -3.0, -3.0]]
        assert filled.v.tolist() == [[1.0, 1.0, 2.0, 2.0, 2.0, 2.0]]

    def test_filled_rows_follow_the_lines_of_all_matches(self) -> None:
        y, x = np.indices((20, 60), np.float64)
        u = -5.0 - 3.0 * np.sin(x / 7.0) * np.cos(y / 5.0)
        v = 0.5 + 0.04 * (x + u) - 0.01 * y
        known = (x < 20) | (x > 50)
        filled = fill(found(np.where(known, u, NONE), v=np.where(known, v, NONE)))
        np.testing.assert_allclose(filled.v, 0.5 + 0.04 * (x + filled.u) - 0.01 * y, atol=0.01)
        assert np.array_equal(filled.v[known], v[known])

    def test_spread_of_matched_columns_and_what_is_claimed_for_it(self) -> None:
        # errors 1, 2, 3, 5 and one beyond everything: median 3, departures 2, 1, 0, 2, 97; their median 2
        truth = parallel(np.full((1, 6), 10.0))
        u = np.array([[-9.0, -8.0, -7.0, -5.0, 90.0, NONE]])
        std = np.array([[1.0, 1.5, 1.0, 2.0, 5.0, NONE]])
        figures = judge(Found(u, 0 * u, np.isfinite(u), True, std), truth)
        assert figures["nmad"] == pytest.approx(1.4826 * 2)
        assert figures["within_1"] == pytest.approx(1 / 5)
        assert figures["within_2"] == pytest.approx(2 / 5)
        assert judge(found(u), truth)["within_1"] is None
        assert judge(found(np.full((1, 6), NONE)), truth)["nmad"] is None

    def test_own_filling_is_judged_as_it_is(self) -> None:
        truth = parallel(np.array([[5.0, 5.0, 5.0, 9.0]]))
        u = np.array([[-5.0, NONE, NONE, -9.0]])
        dense = np.array([[-5.0, -9.0, -5.5, -9.0]]), np.array([[0.0, 0.0, 3.0, 0.0]])
        figures = judge(Found(u, 0 * u, np.isfinite(u), True, dense=dense), truth)
        assert figures["bad2"] == 0.0
        assert figures["bad2_own"] == 0.5
        assert judge(found(u), truth)["bad2_own"] is None

    def test_locking(self) -> None:
        assert locking(np.arange(-50, 50) / 10.0)[0] == pytest.approx(1.0)
        assert locking(np.array([-3.0, -2.96, 4.04, 7.0]))[1] == [10.0, *[0.0] * 9]
        assert locking(-np.arange(160) / 16.0)[0] == pytest.approx(1.25)


class TestTruthFiles:
    def expected(self) -> NDArray[np.float64]:
        return np.array([[-1.5, NONE, -3.0], [-4.0, -5.25, NONE]])

    def stored(self, scale: float) -> NDArray[np.float64]:
        return np.nan_to_num(-self.expected() * scale)

    def test_arrays(self, tmp_path: Path) -> None:
        np.save(tmp_path / "a.npy", np.where(self.stored(1) == 0, np.inf, self.stored(1)).astype(np.float32))
        np.savez(tmp_path / "a.npz", self.stored(1))
        for name in ("a.npy", "a.npz"):
            np.testing.assert_array_equal(read_truth(tmp_path / name).u, self.expected())

    def test_png(self, tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "sixteen.png"), self.stored(256).astype(np.uint16))
        cv2.imwrite(str(tmp_path / "eight.png"), self.stored(4).astype(np.uint8))
        np.testing.assert_array_equal(read_truth(tmp_path / "sixteen.png").u, self.expected())
        np.testing.assert_array_equal(read_truth(tmp_path / "eight.png", 4.0).u, self.expected())

    @pytest.mark.parametrize(("scale", "order"), [("-1.0", "<f4"), ("1.0", ">f4")])
    def test_pfm(self, tmp_path: Path, scale: str, order: str) -> None:
        bottom_up = np.where(self.stored(1) == 0, np.inf, self.stored(1))[::-1].astype(order)
        (tmp_path / "a.pfm").write_bytes(f"Pf\n3 2\n{scale}\n".encode() + bottom_up.tobytes())
        np.testing.assert_array_equal(read_truth(tmp_path / "a.pfm").u, self.expected())

    def test_vectors(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", column=self.expected(), row=2 * self.expected(), occluded=self.expected())
        truth = read_truth(tmp_path / "a.npz")
        np.testing.assert_array_equal(truth.v, 2 * self.expected())


class TestKnockedCamera:
    """Left image: a smooth pattern; right image: the same, 6 to 9 px to the left."""

    def pair(self) -> Pair:
        shape = (90, 120)
        grey = texture(shape, 4.0)
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
        # x_right = 0.97 x - 6: invert to sample the left image
        right = ndimage.map_coordinates(grey, [y, (x + 6.0) / 0.97], order=3, mode="nearest")
        images = [np.rint(i).clip(0, 255).astype(np.uint8) for i in (grey, right)]
        return measured("pattern", *images, parallel(6.0 + 0.03 * x))

    @pytest.mark.parametrize("params", conditions(), ids=str)
    def test_the_truth_leads_to_the_same_grey_values(self, params: MisalignParams) -> None:
        case = knocked(self.pair(), params)
        assert case.truth is not None
        y, x = np.mgrid[: case.left.shape[0], : case.left.shape[1]].astype(np.float64)
        at = np.stack([y + case.truth.v, x + case.truth.u])
        seen = ndimage.map_coordinates(case.right.astype(np.float64), at, order=3, mode="nearest")
        inner = np.s_[12:-12, 20:-12]
        # rounding to whole grey values, up to three times
        assert np.abs(seen - case.left)[inner].max() < 2.0
        assert np.abs(seen - case.left)[inner].mean() < 0.5

    def test_values_of_shift_and_roll(self) -> None:
        pair = self.pair()
        down = knocked(pair, MisalignParams(rows=3.0)).truth
        assert pair.truth is not None
        assert down is not None
        np.testing.assert_allclose(down.u, pair.truth.u, atol=1e-9)
        np.testing.assert_allclose(down.v, 3.0, atol=1e-9)
        rolled = knocked(pair, MisalignParams(roll_deg=2.0)).truth
        assert rolled is not None
        camera, x, y = camera_of(pair), 80, 30
        angle = np.deg2rad(2.0)
        dx, dy = x + pair.truth.u[y, x] - camera.cx, y - camera.cy
        # clockwise on the screen, where y points down
        wanted = (
            camera.cx + np.cos(angle) * dx - np.sin(angle) * dy,
            camera.cy + np.sin(angle) * dx + np.cos(angle) * dy,
        )
        assert (x + rolled.u[y, x], y + rolled.v[y, x]) == pytest.approx(wanted, abs=1e-9)

    def test_the_range_follows(self) -> None:
        case = knocked(self.pair(), MisalignParams(roll_deg=20.0))
        assert case.truth is not None
        assert case.low <= -np.nanmax(case.truth.u)
        assert case.range[0] + case.range[1] > -np.nanmin(case.truth.u)


class TestMethods:
    @pytest.mark.parametrize("disparity", [7, -5])
    @pytest.mark.parametrize("method", methods.opencv(), ids=lambda m: m.name)
    def test_opencv_finds_a_known_shift(self, method: methods.Method, disparity: int) -> None:
        grey = np.rint(texture((80, 160), 1.0)).clip(0, 255).astype(np.uint8)
        left, right = grey[:, 20:-20].copy(), grey[:, 20 + disparity : 140 + disparity].copy()
        pair = measured("shift", left, right, Truth(np.full(left.shape, -disparity * 1.0), np.zeros(left.shape)))
        result = method(pair)
        inner = np.s_[10:-10, 20:-20]
        assert result.matched[inner].all()
        assert np.abs(result.u + disparity)[inner].max() < 0.5

    def test_every_preset_is_there(self) -> None:
        names = [m.name for m in methods.hfvm(["rounds=2 refine=false"], 1)]
        assert {"HFVM default", "HFVM paper", "HFVM rounds=2 refine=false"} <= set(names)

    def test_sizes_for_timing(self) -> None:
        pair = measured("p", *[np.zeros((50, 74), np.uint8)] * 2, parallel(np.full((50, 74), 9.0)))
        large = pairs.enlarged(pair, 14000.0)
        assert abs(large.left.size / 14000.0 - 1.0) < 0.02
        assert large.searching(224).range == (0, 224)


PANDORA = """
    from types import SimpleNamespace
    import numpy as np
    import rasterio

    def check_conf(plan, machine):
        assert plan["pipeline"]["optimization"]["optimization_method"] == "sgm"
        return plan

    def create_dataset_from_inputs(one):
        with rasterio.open(one["img"]) as file:
            return file.read(1), one["disp"]

    def run(machine, left, right, plan):
        machine.calls += 1
        (image, (low, high)), (_, others) = left, right
        assert others == [-high, -low]
        d = np.full(image.shape, -7.0)
        flags = np.zeros(image.shape, int)
        d[:, 20], flags[:, 20] = np.nan, 1
        flags[:, 21], flags[:, 22] = 2, 4
        d[0], d[-1], d[:, 0], d[:, -1] = 99.0, 99.0, 99.0, 99.0
        d[30, 2:5] = low, high, -machine.calls
        return SimpleNamespace(data=d), SimpleNamespace(data=flags)

    def both(*given):
        d, flags = run(*given)
        return ({"disparity_map": d, "validity_mask": flags},)
"""
"""A stand-in: 7 px everywhere, one column invalid, two filled; row 30 the limits of the range and the calls."""

ELAS = """
    import numpy as np
    PRESET_MIDDLEBURY = 1

    class Elas:
        def set_preset(self, preset):
            self.add_corners = True
            self.ipol_gap_width = 5000

        def process(self, left, right):
            left, right = (image.astype(float) for image in (left, right))
            far = [np.abs(left - np.roll(right, d, axis=1)) for d in range(self.disp_min, self.disp_max + 1)]
            sums = [sum(np.roll(f, (y, x), (0, 1)) for y in (-2, 0, 2) for x in (-2, 0, 2)) for f in far]
            found = np.argmin(sums, axis=0).astype(np.float32)
            if not self.add_corners:
                assert self.ipol_gap_width == 3
                found[:, 28] = -1
            return found, found
"""
"""A stand-in that finds whole disparities from 0 on; without corners it leaves a column out."""


class TestPeersElsewhere:
    """Stand-ins of the two libraries, found by the Python that runs ``peers.py``."""

    @pytest.fixture(autouse=True)
    def _libraries(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        folder = tmp_path / "pandora"
        folder.mkdir()
        (folder / "all.py").write_text(textwrap.dedent(PANDORA))
        modules = {
            "__init__": "from .all import both as run\ndef import_plugin(): pass",
            "check_configuration": "from .all import check_conf",
            "constants": "class Criteria:\n    "
            + "; ".join(
                f"PANDORA_MSK_PIXEL_{word} = {flag}"
                for word, flag in (("INVALID", 1), ("FILLED_OCCLUSION", 2), ("FILLED_MISMATCH", 4))
            ),
            "img_tools": "from .all import create_dataset_from_inputs",
            "state_machine": "class PandoraMachine:\n    calls = 0",
        }
        for name, text in modules.items():
            (folder / f"{name}.py").write_text(text)
        (tmp_path / "elas.py").write_text(textwrap.dedent(ELAS))
        for name, version in (("pandora", "1.2"), ("pyelas", "3.4")):
            described = tmp_path / f"{name}-{version}.dist-info"
            described.mkdir()
            (described / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def pair(self, disparity: int) -> Pair:
        grey = np.rint(texture((80, 160), 1.0)).clip(0, 255).astype(np.uint8)
        left, right = grey[:, 20:-20].copy(), grey[:, 20 + disparity : 140 + disparity].copy()
        return measured("shift", left, right, Truth(np.full(left.shape, -disparity * 1.0), np.zeros(left.shape)))

    def test_pandora(self) -> None:
        method, version = methods.elsewhere("pandora", Path(sys.executable))
        assert (method.name, version) == ("Pandora", "pandora 1.2")
        pair = self.pair(7)
        raw = method.run(pair)
        result = method.read(raw, pair)
        # the frame is two pixels wide, so that row 30 and columns 20 to 22 come two earlier
        assert raw["disparity"].shape == pair.left.shape
        assert np.flatnonzero(~result.matched[0]).tolist() == [18, 19, 20]
        assert result.dense is not None
        assert np.flatnonzero(np.isnan(result.dense[0][0])).tolist() == [18]
        low, count = pair.range
        assert raw["disparity"][28, :3].tolist() == [low + count - 1, -low, 2.0]
        assert np.all(result.u[0][result.matched[0]] == -7.0)
        wall, processor = method.told(raw) if method.told else (0.0, 0.0)
        assert wall > 0
        assert processor >= 0

    @pytest.mark.parametrize("disparity", [7, -5])
    def test_elas(self, disparity: int) -> None:
        method, version = methods.elsewhere("elas", Path(sys.executable))
        assert (method.name, version) == ("ELAS", "pyelas 3.4")
        pair = self.pair(disparity)
        result = method(pair)
        inner = np.s_[10:-10, 30:-30]
        assert np.all(result.u[inner] == -disparity)
        assert not result.rows
        assert np.flatnonzero(~result.matched.all(axis=0)).tolist() == [20]
        assert result.dense is not None
        assert np.isfinite(result.dense[0]).all()

    def test_time_is_what_the_program_tells(self) -> None:
        told = iter([(2.0, 1.0), (4.0, 3.0)])
        quick = methods.Method("quick", lambda pair: None, lambda raw, pair: found([[1.0]]), lambda raw: (0.5, 0.25))
        slow = methods.Method("slow", lambda pair: None, lambda raw, pair: found([[1.0]]), lambda raw: next(told))
        first, second = timing.timings(self.pair(7), [quick, slow], 2, 8.0)
        assert (first["cpu_ratio"], second["cpu_ratio"], second["min_ratio"]) == (1.0, 4.0, 4.0)

    def test_what_is_not_there_is_one_line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv("PYTHONPATH")
        with pytest.raises(SystemExit, match=r"^ELAS, run by .*: .*PackageNotFoundError: .*pyelas$"):
            methods.elsewhere("elas", Path(sys.executable))


class TestRatios:
    def found(self) -> list[dict[str, Any]]:
        def one(pair: str, method: str, bad: float, own: float | None, cpu: float) -> dict[str, Any]:
            rest = {"bad1": 2 * bad, "completeness": 0.8, "bad2_matched": bad / 4}
            return {"pair": pair, "method": method, "bad2": bad, "bad2_own": own, "cpu_ratio": cpu, **rest}

        return [
            *(one("a", "first", 0.2, None, 1.0), one("a", "peer", 0.1, 0.3, 8.0), one("a", "HFVM x", 0.05, 0.1, 3.0)),
            *(one("b", "first", 0.4, None, 1.0), one("b", "peer", 0.8, 0.4, 4.0), one("b", "HFVM x", 0.60, 0.2, 2.0)),
        ]

    def test_means_of_ratios(self) -> None:
        first, peer, ours = ratios.means(self.found())
        assert [row["method"] for row in (first, peer, ours)] == ["first", "peer", "HFVM x"]
        # the best peers: 0.1 on a, 0.4 on b
        assert (first["bad2"], first["bad2_own"], first["bad2_best"]) == pytest.approx((1.0, None, 1.5))
        assert [peer[key] for key in ("bad1", "bad2", "bad2_own", "bad2_best")] == pytest.approx(
            [1.25, 1.25, 1.25, 1.5]
        )
        assert [ours[key] for key in ("bad2", "bad2_own", "bad2_best", "time")] == pytest.approx([0.875, 0.5, 1.0, 2.5])
        assert (ours["completeness"], ours["bad2_matched"]) == pytest.approx((0.8, 0.08125))

    def test_picture(self, tmp_path: Path) -> None:
        ratios.picture(ratios.means(self.found()), tmp_path / "new" / "peers.png")
        image = cv2.imread(str(tmp_path / "new" / "peers.png"))
        assert image is not None
        assert min(image.shape[:2]) > 300

    def test_every_matcher_is_judged_and_timed_on_every_pair(self) -> None:
        shape = (20, 60)
        pair = measured("p", *[np.zeros(shape, np.uint8)] * 2, parallel(np.full(shape, 9.0)))
        right, wrong = (
            methods.Method(name, lambda pair: None, lambda raw, pair, u=u: found(np.full(shape, u)), lambda raw: (1, 2))
            for name, u in (("right", -9.0), ("wrong", -5.0))
        )
        figures = ratios.figures([pair, pair], [right, wrong], 2, lambda name: None)
        assert [(f["method"], f["bad2"]) for f in figures] == [("right", 0.0), ("wrong", 1.0)] * 2
        assert [f["cpu_ratio"] for f in figures] == [1.0] * 4


class TestClaims:
    def figures(self) -> dict[str, Any]:
        def accuracy(pair: str, method: str, bad2: float, **more: Any) -> dict[str, Any]:
            rest = {"nmad": 0.12, "completeness": 0.75, "within_1": 0.62, "within_2": None}
            return {"pair": pair, "method": method, "bad2": bad2, **rest, **more}

        def time(pair: str, size: list[int], method: str, least: float, median: float) -> dict[str, Any]:
            return {"pair": pair, "size": size, "method": method, "min_ratio": least, "median_ratio": median}

        return {
            "accuracy": [
                accuracy("cones", "SGBM 3WAY", 0.1),
                accuracy("cones", "HFVM accurate", 0.101),
                accuracy("cones", "HFVM default", 0.119),
                accuracy("mockup", "HFVM accurate", 0.5, nmad=0.121),
            ],
            "misalignment": [
                {"pair": "cones", "method": "SGBM 3WAY", "condition": "aligned", "bad2": 0.1},
                {"pair": "cones", "method": "HFVM default", "condition": "shift 4 px", "bad2": 0.14},
                {"pair": "cones", "method": "HFVM default", "condition": "shift 3 px", "bad2": 0.9},
            ],
            "time": [
                time("street", [1226, 370], "SGBM 3WAY", 1.0, 1.0),
                time("street", [1226, 370], "HFVM default", 0.9, 1.1),
                time("motorcycle x 1.944", [1440, 972], "SGBM 3WAY", 1.0, 1.0),
                time("motorcycle x 1.944", [1440, 972], "HFVM default", 0.7, 0.6),
            ],
        }

    def test_each_figure_is_held_against_its_limit(self) -> None:
        found = limits.lines(self.figures())
        assert [(c.figure, c.limit, c.kept) for c in found] == [
            (pytest.approx(1.01), "<= 1", False),
            (pytest.approx(1.19), "<= 1.2", True),
            (pytest.approx(1.4), "<= 1.5", True),
            (0.121, "<= 0.12", False),
            (0.75, ">= 0.75", True),
            (0.62, "0.61 .. 0.75", True),
            (0.9, "<= 1", True),
            (1.1, "<= 1", False),
            (0.7, "<= 0.7", True),
            (0.6, "<= 0.7", True),
        ]

    def test_what_was_not_measured_is_left_out(self) -> None:
        figures = self.figures()
        assert limits.lines({}) == []
        del figures["accuracy"][0], figures["misalignment"][0], figures["time"][2]
        assert [c.figure for c in limits.lines(figures)] == [0.121, 0.75, 0.62, 0.9, 1.1]
