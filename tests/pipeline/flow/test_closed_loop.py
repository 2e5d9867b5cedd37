"""The closed loop in small: it arrives, it repeats to the bit, no estimate reads the truth, it says why it stops."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises

from rille.datasets.registry import open_sequence
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.run import Result
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow import config, unread
from rille.pipeline.flow.closed_loop import Drive
from rille.pipeline.runs import session

SMALL = (
    "mockup.image_width=160",
    "mockup.image_height=120",
    "mockup.focal_length=90.0",
    "mockup.bed_width=1.0",
    "mockup.bed_length=1.1",
    "mockup.cell=0.004",
    "mockup.rocks=0.0",
    "mockup.craters=0.0",
    "rover.frame_step=0.05",
    "locus.cell_size=0.008",
    "drive.goal=[0.03, 0.25]",
    "drive.around=0.4",
    "obstacle_monitor.enabled=false",
)
KNOW_THE_TRUTH = {"mockup.drive", "mockup.sense", "mockup.render", "mockup.obstacle", "mockup.truth_dem", "drive_check"}


def drive(store: Path, *more: str) -> tuple[Drive, Result]:
    for_dataset, for_stages = config.split_dataset(config.parse_assignments((*SMALL, *more)))
    sequence = open_sequence("mockup-loop", for_dataset)
    assert sequence.vehicle is not None
    layers: list[dict[str, Any]] = [{"vehicle": sequence.vehicle.model_dump()}, config.expand(sequence.defaults)]
    flow = Drive(Graph(), sequence, config.build(*layers, for_stages))
    flow.graph.flow(flow.steps())
    return flow, driver.run(flow.graph, Store(store), driver.RunOptions(executor="inline", keep_going=True))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drive") / "cache"


@pytest.fixture(scope="module")
def arrived(store: Path) -> tuple[Drive, Result]:
    return drive(store)


@pytest.mark.slow
def test_it_arrives_and_knows_where_it_is(arrived: tuple[Drive, Result], store: Path) -> None:
    flow, result = arrived
    assert result.failures == []
    assert flow.outcome()[0] == "goal", flow.outcome()
    assert len(flow.driven.stops) >= 3
    assert flow.driven.check is not None
    assert flow.driven.check.ref is not None
    metrics = Store(store).open(flow.driven.check.ref).meta["metrics"]
    assert [metrics[f"{name}_violations"]["value"] for name in ("clearance", "tilt", "step")] == [0, 0, 0]
    # 0.2 px at 90 px of focal length and 0.4 m are 0.9 mm an image; the legs of a drive of 0.3 m add up to a few
    assert metrics["localisation_error"]["value"] < 0.006
    assert 0.2 < metrics["path_length"]["value"] < 0.45


@pytest.mark.slow
def test_it_reads_none_of_the_sections_of_a_reconstruction(arrived: tuple[Drive, Result]) -> None:
    flow, _ = arrived
    every = [f"{section}.x" for section in type(flow.config).model_fields if section != "terrain"]
    lost = {key.partition(".")[0] for key in unread.unread(every, flow.config, flow.graph)}
    foreign = unread.foreign(driven=True) & set(type(flow.config).model_fields)
    assert lost - {"obstacle_monitor", "map_localization"} == foreign, "both are off here"


@pytest.mark.slow
def test_a_rig_that_is_given_off_by_degrees_is_repaired_at_the_first_stop(store: Path) -> None:
    flow, result = drive(store, "mockup.rig_error_deg=[2.0,2.0,2.0]")
    assert result.failures == []
    assert flow.outcome()[0] == "goal", flow.outcome()
    rigs = [handle for handle in flow.graph.nodes if handle.stage == "rig"]
    assert len(rigs) == 1
    assert rigs[0].ref is not None
    assert "too low" in " ".join(rigs[0].ref.meta["warnings"])
    assert flow.driven.check is not None
    assert flow.driven.check.ref is not None
    metrics = Store(store).open(flow.driven.check.ref).meta["metrics"]
    assert [metrics[f"{name}_violations"]["value"] for name in ("clearance", "tilt", "step")] == [0, 0, 0]
    assert metrics["localisation_error"]["value"] < 0.006


@pytest.mark.slow
def test_driven_again_nothing_is_computed_and_all_is_the_same(arrived: tuple[Drive, Result], store: Path) -> None:
    flow, result = drive(store)
    assert result.counts["computed"] == 0
    assert flow.outcome() == arrived[0].outcome()
    assert [s.frames for s in flow.driven.stops] == [s.frames for s in arrived[0].driven.stops]
    assert {h.label: h.ref.digest for h in flow.graph.nodes if h.ref} == {
        h.label: h.ref.digest for h in arrived[0].graph.nodes if h.ref
    }


@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on_to_the_same_bits(arrived: tuple[Drive, Result], tmp_path: Path) -> None:
    here, cache = Path(__file__).parent, tmp_path / "cache"
    program = "import sys, pathlib, test_closed_loop; test_closed_loop.drive(pathlib.Path(sys.argv[1]))"
    paths = os.pathsep.join(map(str, (here, *here.parents[:3])))
    driving = subprocess.Popen([sys.executable, "-c", program, str(cache)], env=os.environ | {"PYTHONPATH": paths})
    try:
        while len(list(cache.glob("artifacts/local_planner/*/*.zip"))) < 2:
            assert driving.poll() is None, "it had ended before it was killed"
            time.sleep(0.05)
    finally:
        driving.kill()
        driving.wait()
    flow, result = drive(cache)
    assert result.counts["cached"] > 10
    assert result.counts["computed"] > 10
    assert flow.outcome() == arrived[0].outcome()
    assert {h.label: h.ref.digest for h in flow.graph.nodes if h.ref} == {
        h.label: h.ref.digest for h in arrived[0].graph.nodes if h.ref
    }


@pytest.mark.slow
def test_the_report_shows_the_drive(arrived: tuple[Drive, Result], store: Path, tmp_path: Path) -> None:
    given: dict[str, Any] = {"runs": tmp_path, "cache": store, "executor": "inline", "quiet": True}
    first = session.perform("mockup-loop", session.Options(SMALL, **given), verb="drive")
    assert first.code == 0
    assert first.lines[0].startswith("goal: ")
    again = session.perform("mockup-loop", session.Options(SMALL, **given), verb="drive")
    assert again.code == 0
    assert again.lines[0] == first.lines[0], "nothing computed, the same answer"
    folder = tmp_path / "mockup-loop" / "latest"
    facts = json.loads((folder / "report.json").read_text())
    assert facts["complete"], facts["missing"]
    assert facts["metrics"]["drive_step_violations"]["value"] == 0
    page = (folder / "report.html").read_text()
    assert "The drive, stop by stop" in page
    assert page.count('alt="Stop ') == len(arrived[0].driven.stops)
    with raises("RIL-059"):
        session.perform("mockup-short", session.Options(**given), verb="drive")


def numbers(value: Any) -> Iterator[float]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, float):
        yield value


@pytest.mark.slow
def test_no_estimate_reads_a_true_pose(arrived: tuple[Drive, Result]) -> None:
    flow, _ = arrived
    assess = {"accuracy", "truth_dem"}
    positions = {value for f, pose in flow.true.items() if f for value in np.array(pose).reshape(3, 4)[:, 3].tolist()}

    def honest(handle: Handle) -> bool:
        return handle.stage not in KNOW_THE_TRUTH | assess

    for handle in filter(honest, flow.graph.nodes):
        assert not {h.stage for h in handle.upstream()} & {"mockup.drive", "mockup.truth_dem"} or handle.stage in (
            "dem_accuracy",
            "risk",
        ), handle.label
        assert not positions & set(numbers(handle.spec.args)), handle.label
    judged = {h.label for h in flow.graph.nodes if any(u.stage == "mockup.truth_dem" for u in h.upstream())}
    assert judged == {"dem_accuracy/world", "risk/truth"}


@pytest.mark.slow
def test_a_lost_image_is_left_out_and_the_last_one_taken_again(arrived: tuple[Drive, Result], store: Path) -> None:
    frames = arrived[0].driven.stops[0].frames
    flow, result = drive(store, f"rover.lost_frames=[{frames[1]}]", "drive.max_stops=2")
    assert result.failures == []
    first = flow.driven.stops[0]
    assert first.frames == [frames[0], *frames[2:]]
    assert first.event.startswith(f"lost image {frames[1]} (")
    flow, _ = drive(store, f"rover.lost_frames=[{frames[-1]}]", "drive.max_stops=2")
    first = flow.driven.stops[0]
    assert first.frames == [*frames[:-1], frames[-1] + 1]
    assert first.event.endswith(f"taken again as image {frames[-1] + 1}")
    assert flow.true[frames[-1] + 1] == flow.true[frames[-1]]


@pytest.mark.slow
def test_slip_of_thirty_per_cent_stops_says_so_and_keeps_all(
    arrived: tuple[Drive, Result], store: Path, tmp_path: Path
) -> None:
    slips = ("rover.slip=0.3", "rover.slip_sigma=0.0", "drive.max_safety_stops=1")
    flow, _ = drive(store, *slips)
    verdict, reason = flow.outcome()
    assert verdict == "safety stop"
    assert reason.startswith("slip of ")
    assert "by the wheels" in reason
    assert flow.driven.check is not None
    given: dict[str, Any] = {"runs": tmp_path, "cache": store, "executor": "inline", "quiet": True}
    for _ in range(2):  # the second time nothing is computed, and the run before stands
        result = session.perform("mockup-loop", session.Options((*SMALL, *slips), **given), verb="drive")
        assert result.code == session.HOLES
        assert result.lines[0].startswith("safety stop: slip of ")
    lines = (tmp_path / "mockup-loop" / "latest" / "trajectory.tum").read_text().splitlines()
    assert len(lines) == 1 + len(flow.posed) > 2, "the way to where it stopped, too"


def test_a_drive_needs_a_goal_and_a_cell(store: Path) -> None:
    sequence = open_sequence("mockup-loop")
    with_goal = config.build({"drive": {"goal": (0.0, 1.0)}})
    with raises("RIL-032"):
        Drive(Graph(), sequence, with_goal)
    with raises("RIL-031"):
        Drive(Graph(), sequence, config.build({}))


@pytest.mark.parametrize("goal", [(0.0, 100.0), (0.9, 1.0), (0.0, -0.4)])
def test_a_goal_beside_the_ground_is_refused_before_anything_is_computed(goal: tuple[float, float]) -> None:
    drive = config.build({"drive": {"goal": goal}, "locus": {"cell_size": 0.004}})
    with raises("RIL-714", "y -0.35..1.65"):
        Drive(Graph(), open_sequence("mockup-loop"), drive)


@pytest.mark.parametrize("given", [{}, {"prior": (0.0, 0.35, 0.0)}])
def test_a_goal_in_a_map_without_a_pose_or_a_map_is_refused_before_anything_is_computed(given: dict[str, Any]) -> None:
    drive = {"goal": (0.0, 1.0), "frame": "map", **given}
    with raises("RIL-033"):
        Drive(Graph(), open_sequence("mockup-loop"), config.build({"drive": drive, "locus": {"cell_size": 0.004}}))


def test_a_prior_of_negative_deviation_is_refused() -> None:
    with raises("RIL-027", "drive.prior_sigma.0"):
        config.build(config.expand(config.parse_assignments(["drive.prior_sigma=[-0.1, 5.0]"])))


@pytest.mark.slow
def test_a_goal_in_a_global_map_is_found_from_a_rough_prior(store: Path) -> None:
    more = ("rover.map_cell=0.03", "drive.frame=map", "drive.goal=[0.0, 0.6]", "drive.max_stops=1")
    flow, result = drive(store, *more, "drive.prior=[0.0, 0.38, 0.0]", "mockup.relief=0.02")
    assert result.failures == []
    fixed = next(h for h in flow.graph.nodes if h.stage == "map_localization").ref
    assert fixed is not None
    true = np.array(flow.true[0]).reshape(3, 4)[:, 3]
    found = np.array(fixed.meta["T_global_local"]).reshape(3, 4)[:, 3]
    assert np.abs(found - true)[:2].max() < 0.03  # a cell of the map
    assert np.hypot(*flow.goal) == pytest.approx(np.hypot(*(np.array([0.0, 0.6]) - true[:2])), abs=0.03)
    elsewhere, lost = drive(store, *more, "drive.prior=[9.0, 9.0, 0.0]", "mockup.relief=0.02")
    assert getattr(lost.failures[0].error, "code", "") == "RIL-338"
    assert elsewhere.outcome()[0] == "failed"


def test_the_vehicle_that_is_configured_is_the_one_that_stands_on_the_bed(store: Path) -> None:
    for_dataset, for_stages = config.split_dataset(config.parse_assignments((*SMALL, "vehicle.clearance=0.05")))
    for_stages["vehicle"] |= {"track": 0.14, "wheel_base": 0.16}
    sequence = open_sequence("mockup-loop", for_dataset)
    assert sequence.vehicle is not None
    given: dict[str, Any] = {"vehicle": sequence.vehicle.model_dump()}
    flow = Drive(Graph(), sequence, config.build(given, config.expand(sequence.defaults), for_stages))
    flow.graph.flow(flow.steps())
    flow.graph.waiting.clear()
    driver.run(flow.graph, Store(store), driver.RunOptions(executor="inline")).check()
    assert flow.driven.place is not None
    assert flow.driven.place.ref is not None
    found = Store(store).open(flow.driven.place.ref)
    assert np.asarray(found["clearance"]) == pytest.approx(0.05, abs=1e-6), "its belly above a pad that is level"
