"""The time left: of a run like an earlier one, on a slower machine, with compiled kernels, and half in the cache."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rille.pipeline.engine import forecast
from rille.pipeline.engine.forecast import Forecast, kind
from rille.pipeline.engine.reference import REFERENCE

EARLIER = {"image": (0.0, 0.1, 0.0), "match": (0.0, 1.0, 4.0), "map": (0.25, 2.0, 6.0)}
OPENED = [f"image/{k}" for k in range(4)] + [f"match/{k}" for k in range(4)]


def end(run: Forecast, label: str, seconds: float, status: str = "computed", compiling: float = 0.0) -> None:
    took = SimpleNamespace(seconds=seconds, compiling=compiling)
    handle: Any = SimpleNamespace(label=label, status=status, took=took)
    run.ended(handle)


def test_a_kind_is_a_label_without_numbers() -> None:
    assert [kind(label) for label in ("locus/world/12", "motion/3-4", "rig")] == ["locus/world", "motion", "rig"]


def test_nothing_is_said_before_anything_was_computed_or_where_nothing_is_known() -> None:
    run = Forecast(OPENED, EARLIER, 1)
    assert run.left() is None
    end(run, "image/0", 0.0, status="cached")
    assert run.left() is None
    drive = Forecast(["stop/0"], None, 1)
    end(drive, "stop/0", 1.0)
    assert drive.left() is None


@pytest.mark.parametrize(("slower", "jobs"), [(1.0, 1), (3.0, 1), (3.0, 2)])
def test_what_was_never_laid_out_is_expected_at_the_pace_so_far(slower: float, jobs: int) -> None:
    run = Forecast(OPENED, EARLIER, jobs)
    end(run, "image/0", 0.1 * slower)
    assert run.left() == pytest.approx(slower * (3 * 0.1 + 4 * 1.0 + 2 * 2.0) / jobs)


def test_kernels_that_are_there_are_not_compiled() -> None:
    warm, cold = Forecast(OPENED, EARLIER, 1), Forecast(OPENED, EARLIER, 1)
    end(warm, "match/0", 1.0)
    end(cold, "match/0", 9.0, compiling=8.0)
    assert warm.left() == pytest.approx(4 * 0.1 + 3 * 1.0 + 2 * 2.0)
    assert cold.left() == pytest.approx(warm.left() + 2 * 6.0)


def test_the_share_that_was_found_in_the_cache_is_expected_of_the_rest() -> None:
    run = Forecast(OPENED, EARLIER | {"map": (0.0, 0.0, 0.0)}, 1)
    end(run, "image/0", 0.1)
    for k in (1, 2, 3):
        end(run, f"image/{k}", 0.0, status="cached")
    end(run, "match/0", 1.0)
    end(run, "match/1", 0.0, status="cached")
    assert run.left() == pytest.approx(2 * (2 / 3) * 1.0)


def test_what_a_run_leaves_is_what_the_next_one_starts_from(tmp_path: Any) -> None:
    run = Forecast(OPENED, None, 1)
    for label in OPENED:
        end(run, label, 2.0, compiling=1.0)
    run.added("map/0")
    end(run, "map/0", 5.0)
    forecast.remember(tmp_path, run)
    found = forecast.recall(tmp_path)
    assert found == {"image": (0.0, 1.0, 4.0), "match": (0.0, 1.0, 4.0), "map": (0.125, 5.0, 0.0)}
    for damaged in ('{"image": 3}', "[" * 100_000):
        (tmp_path / forecast.FILE).write_text(damaged)
        assert forecast.recall(tmp_path) is None


def test_a_run_that_opens_with_no_task_leaves_what_its_tasks_took(tmp_path: Any) -> None:
    run = Forecast([], None, 1)
    run.added("map/0")
    end(run, "map/0", 5.0)
    forecast.remember(tmp_path, run)
    assert forecast.recall(tmp_path) == {"map": (1.0, 5.0, 0.0)}


def test_images_that_are_not_rendered_are_expected_without_what_renders_them() -> None:
    expected = Forecast(["motion/0"], None, 1).earlier
    assert not {"scene", "image/left", "truth_dem/local", "risk/truth"} & expected.keys()
    assert {"image_quality", "risk/world"} <= expected.keys()


def test_a_kind_that_is_switched_off_is_not_expected() -> None:
    run = Forecast(OPENED, EARLIER | {"crosscheck": (0.0, 16.0, 0.0)}, 1)
    end(run, "image/0", 0.1)
    assert run.left() == pytest.approx(3 * 0.1 + 4 * 1.0 + 2 * 2.0)


def test_the_reference_has_all_that_a_reconstruction_spends_its_time_on() -> None:
    assert {
        "hfvm",
        "locus/world",
        "motion",
        "merge",
        "resect",
        "path/local",
        "risk/world",
        "crosscheck",
        "output",
    } <= REFERENCE.keys()
