"""Formulas of the benchmarks by hand: those by which figures of the docs could be wrong unnoticed."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from rille.datasets.images.misalign import MisalignParams
from rille.pipeline.flow import config
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import RigidTransform, cross_matrix, rotation_exp
from rille.stages.geometry.lattice import Lattice

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import disparity_std
import gaps
import hazard_ablation
import planner_ablation
from driving.ratios import Ratios, wilson
from gridding import ideas as of_terrain
from gridding.mesh import rasterise
from odometry import ideas as of_navigation
from odometry.measures import claims
from odometry.measures import judge as judge_odometry
from stereo.measures import Found, fill, judge, locking
from stereo.misalignment import conditions, knocked
from stereo.pairs import measured, parallel
from stereo.ratios import means
from surest import surest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
STAGES = config.stages()
NONE = np.nan


@pytest.mark.parametrize("path", sorted(BENCHMARKS.rglob("*.py")), ids=lambda p: str(p.relative_to(BENCHMARKS)))
def test_names_that_a_benchmark_takes_from_the_package_are_there(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rille"):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.import_module(f"{node.module}.{alias.name}")


@pytest.mark.parametrize("path", sorted(BENCHMARKS.rglob("*.py")), ids=lambda p: str(p.relative_to(BENCHMARKS)))
def test_what_a_benchmark_gives_a_stage_is_an_input_or_argument_of_it(path: Path) -> None:
    """Of ``node(tile_index_stage, label, dem=...)`` and ``self._stage("track", {"frames": ...}, pyramids=...)``."""
    for call in (n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)):
        first = ast.unparse(call.args[0]).strip("'").removesuffix("_stage") if call.args else ""
        if not re.search("node|_stage", ast.unparse(call.func)) or first not in STAGES:
            continue
        facts = [name.value for d in call.args[1:] if isinstance(d, ast.Dict) for name in d.keys if name is not None]
        names = {*facts, *(k.arg for k in call.keywords if k.arg)}
        stage = STAGES[first]
        assert stage.function is not None
        assert names <= {*stage.ports(), *inspect.signature(stage.function).parameters}, ast.unparse(call)


def test_what_an_ablation_replaces_is_there() -> None:
    whole = [*planner_ablation.replacements().values(), *hazard_ablation.replacements().values()]
    places = [(owner, name) for owner, name, _ in whole]
    places += [place for *_, changes in (*of_terrain.IDEAS, *of_terrain.TWO_WAYS) for place in changes]
    for idea in of_navigation.IDEAS:
        config.build(config.parse_assignments(list(idea.parameters)))
        module, _, name = f"{of_navigation.STAGES}.{idea.name}".rpartition(".")
        places += [(importlib.import_module(module), name)] if idea.name else []
    for owner, name in places:
        assert hasattr(owner, name), (owner, name)


# -- matching ----------------------------------------------------------------------------------------------------------


def matched(u: Any, v: Any = None, rows: bool = True, std: Any = None) -> Found:
    column = np.asarray(u, np.float64)
    return Found(column, 0 * column if v is None else v, np.isfinite(column), rows, std)


def test_matching_shares_and_completeness_of_a_row() -> None:
    truth = parallel(np.array([[10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, NONE]]))
    # Off by 0, 0.5, 1.5, 2.5, 3.5; then two holes that the background (9) fills; the last one has no truth.
    figures = judge(matched([[-10.0, -10.5, -11.5, -12.5, -13.5, NONE, NONE, -9.0]]), truth)
    assert [figures[f"bad{t}"] for t in (1, 2, 3)] == pytest.approx([3 / 7, 2 / 7, 1 / 7])
    assert [figures[f"bad{t}_matched"] for t in (1, 2, 3)] == pytest.approx([3 / 5, 2 / 5, 1 / 5])
    assert (figures["median"], figures["completeness"]) == pytest.approx((1.5, 5 / 7))
    nothing = judge(matched(np.full((2, 4), NONE)), parallel(np.full((2, 4), 5.0)))
    assert (nothing["bad3"], nothing["completeness"]) == (1.0, 0.0)


def test_matching_rows_count_for_those_that_search_them_only() -> None:
    truth, u, v = parallel(np.full((1, 4), 5.0)), np.full((1, 4), -5.0), np.full((1, 4), 4.0)
    assert [judge(matched(u, v, rows), truth)["bad3"] for rows in (True, False)] == [1.0, 0.0]


def test_matching_filled_rows_follow_the_lines_of_all_matches() -> None:
    y, x = np.indices((20, 60), np.float64)
    u = -5.0 - 3.0 * np.sin(x / 7.0) * np.cos(y / 5.0)
    known = (x < 20) | (x > 50)
    filled = fill(matched(np.where(known, u, NONE), np.where(known, 0.5 + 0.04 * (x + u) - 0.01 * y, NONE)))
    np.testing.assert_allclose(filled.v, 0.5 + 0.04 * (x + filled.u) - 0.01 * y, atol=0.01)


def test_matching_spread_of_columns_and_what_is_claimed_for_it() -> None:
    # Errors 1, 2, 3, 5 and one beyond everything: median 3, departures 2, 1, 0, 2, 97; their median 2.
    std = np.array([[1.0, 1.5, 1.0, 2.0, 5.0, NONE]])
    figures = judge(matched([[-9.0, -8.0, -7.0, -5.0, 90.0, NONE]], std=std), parallel(np.full((1, 6), 10.0)))
    assert [figures[k] for k in ("nmad", "within_1", "within_2")] == pytest.approx([1.4826 * 2, 1 / 5, 2 / 5])


@pytest.mark.parametrize(("preset", "pixel"), [("default", 1), ("fast", 2)])
def test_parts_of_standard_deviations_add_up_to_them(preset: str, pixel: int) -> None:
    """Of odd numbers of rows and columns; preset fast computes its parts in pixels twice as large."""
    grey = ndimage.gaussian_filter(np.random.default_rng(4).standard_normal((151, 191)), 1.5)
    grey = 128.0 + 40.0 * grey / grey.std()
    x, _, std = disparity_std.judged(preset, grey[:, :-6], grey[:, 6:], np.full((151, 185), -6.0))
    x, std = x[:, np.isfinite(x).all(axis=0)], std[np.isfinite(x).all(axis=0)]
    assert std.size > 10000
    assert (x[0] == pixel**2).all()
    factors, *_ = np.linalg.lstsq(x.T, std**2, rcond=None)
    np.testing.assert_allclose(np.sqrt(factors @ x), std, rtol=0.01)


def test_matching_locking_to_whole_pixels() -> None:
    assert locking(np.arange(-50, 50) / 10.0)[0] == pytest.approx(1.0)
    assert locking(np.array([-3.0, -2.96, 4.04, 7.0]))[1] == [10.0, *[0.0] * 9]


@pytest.mark.parametrize("params", conditions(), ids=str)
def test_matching_truth_of_a_knocked_camera_leads_to_the_same_grey_values(params: MisalignParams) -> None:
    y, x = np.mgrid[:90, :120].astype(np.float64)
    grey = ndimage.gaussian_filter(np.random.default_rng(3).standard_normal(x.shape), 4.0, mode="wrap")
    grey = 128.0 + 40.0 * grey / grey.std()
    # x_right = 0.97 x - 6: inverted to sample the left image.
    right = ndimage.map_coordinates(grey, [y, (x + 6.0) / 0.97], order=3, mode="nearest")
    images = [np.rint(i).clip(0, 255).astype(np.uint8) for i in (grey, right)]
    case = knocked(measured("pattern", *images, parallel(6.0 + 0.03 * x)), params)
    assert case.truth is not None
    at = np.stack([y + case.truth.v, x + case.truth.u])
    seen = ndimage.map_coordinates(case.right.astype(np.float64), at, order=3, mode="nearest")
    assert np.abs(seen - case.left)[12:-12, 20:-12].mean() < 0.5  # rounded to whole grey values, up to three times


def test_matching_means_of_ratios_to_the_first_and_to_the_best_peer() -> None:
    def one(pair: str, method: str, bad: float, own: float | None, cpu: float) -> dict[str, Any]:
        rest = {"bad1": 2 * bad, "completeness": 0.8, "bad2_matched": bad / 4}
        return {"pair": pair, "method": method, "bad2": bad, "bad2_own": own, "cpu_ratio": cpu, **rest}

    a = one("a", "first", 0.2, None, 1.0), one("a", "peer", 0.1, 0.3, 8.0), one("a", "HFVM x", 0.05, 0.1, 3.0)
    b = one("b", "first", 0.4, None, 1.0), one("b", "peer", 0.8, 0.4, 4.0), one("b", "HFVM x", 0.60, 0.2, 2.0)
    _, peer, ours = means([*a, *b])
    assert [peer[key] for key in ("bad1", "bad2", "bad2_own", "bad2_best")] == pytest.approx([1.25, 1.25, 1.25, 1.5])
    assert [ours[key] for key in ("bad2", "bad2_own", "bad2_best", "time")] == pytest.approx([0.875, 0.5, 1.0, 2.5])


# -- trajectories, drives, elevations ----------------------------------------------------------------------------------


def line(steps: Any) -> Any:
    """Poses (frame, 3, 4) along z."""
    poses = np.tile(np.eye(3, 4), (len(steps), 1, 1))
    poses[:, 2, 3] = steps
    return poses


def test_navigation_figures_of_a_stretched_drive() -> None:
    figures = judge_odometry(line(0.51 * np.arange(30)), line(0.5 * np.arange(30)))
    assert (figures["one_frame"], figures["drift"], figures["lost"]) == pytest.approx((0.01, 2.0, 0))
    # Positions on a line, one centimetre too far apart each: after alignment of the means k - 9.5 centimetres.
    assert figures["rmse_first"] == pytest.approx(0.01 * np.std(np.arange(20)))
    assert figures["rmse"] == pytest.approx(0.01 * np.std(np.arange(30)))


def test_claims_are_judged_apart_from_how_the_truth_is_mounted() -> None:
    """A walk of a camera whose single motions err as is stated; its truth is of a body turned by 3 degrees."""
    rng = np.random.default_rng(3)
    sigma, mount = np.repeat([3e-3, 1e-3], 3), RigidTransform(rotation_exp([0.02, 0.05, 0.0]), np.array([0.1, 0, 0]))
    at = made = RigidTransform.identity()
    truth, poses, covariance = [at @ mount.inverse()], [made], [np.zeros((6, 6))]
    for k in range(1, 40):
        step = RigidTransform(rotation_exp(rng.normal(0, 0.2, 3)), rng.normal(0, 0.3, 3))
        off = sigma * rng.standard_normal(6)
        at, made = at @ step, made @ step @ RigidTransform(rotation_exp(off[3:]), off[:3])
        truth, poses = [*truth, at @ mount.inverse()], [*poses, made]
        lever = np.eye(6)
        lever[:3, 3:] = -cross_matrix(poses[k].translation - poses[k - 1].translation)
        covariance.append(lever @ covariance[-1] @ lever.T + np.diag(sigma**2))
    figures = claims(*(np.array(v) for v in ([p.matrix34 for p in poses], covariance, [p.matrix34 for p in truth])))
    assert figures["nees"] > 10
    assert 0.3 < figures["nees_mounted"] < 2.5


def test_gaps_error_and_sigma_are_those_of_the_gap_alone() -> None:
    covariance = np.zeros((4, 6, 6))
    covariance[:, 2, 2] = [0.0, 0.01, 0.02, 0.06]
    arrays = {"poses": line([7.0, 8.0, NONE, 10.5]), "covariance": covariance, "piece": np.array([0, 0, -1, 0])}
    row = gaps.judge(Bundle(arrays, {"pieces": [[1, 2, 3, 4]]}), line(np.arange(6.0)), 2, 4, 1)
    assert (row["error"], row["sigma"]) == pytest.approx((0.5, np.sqrt(0.05)))


def test_driving_ratios_and_their_intervals() -> None:
    ways = [(1.0, 1.0), (3.0, 2.0), (2.3, 2.0), (0.9, 1.0)]
    assert Ratios(ways).together() == pytest.approx(7.2 / 6.0)  # the long ways count more
    low, high = Ratios(ways).interval()
    assert 0.9 < low < 1.2 < high < 1.5
    assert Ratios([(1.15, 1.0), (1.1501, 1.0)]).within() == 1
    assert wilson(10, 10) == pytest.approx((10 / (10 + 1.959964**2), 1.0))  # 1 / (1 + z^2 / n)
    assert wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)


@pytest.mark.parametrize(("share", "rms", "limit"), [(0.125, 1.0, 0.1), (0.25, 2.5**0.5, 0.2), (0.75, NONE, NONE)])
def test_the_surest_of_eight_cells(share: float, rms: float, limit: float) -> None:
    error, sigma = np.array([3.0, -1.0, 9.0, 2.0]), np.array([0.3, 0.1, 0.9, 0.2])
    assert surest(error, sigma, 8, share) == pytest.approx((rms, limit), nan_ok=True)


def test_terrain_triangles_are_sampled_at_cell_centres_and_the_highest_wins() -> None:
    lattice = Lattice.at(0, 3, 1.0, 4, 4)  # x 0..3, y 3..0
    x, y = np.meshgrid([-0.5, 2.5], [2.5, 0.5])
    points = np.stack([x, y, 1.0 + x + 2.0 * y], axis=-1)
    both = np.concatenate([points, points + np.array([0.0, 0.0, 5.0])], axis=0)
    expected = np.full((4, 4), NONE)
    expected[1:3, :3] = (1.0 + lattice.xy()[..., 0] + 2.0 * lattice.xy()[..., 1])[1:3, :3]
    np.testing.assert_allclose(rasterise(points, np.ones((1, 1), bool), lattice), expected)
    np.testing.assert_allclose(rasterise(both, np.array([[True], [False], [True]]), lattice), expected + 5.0)
