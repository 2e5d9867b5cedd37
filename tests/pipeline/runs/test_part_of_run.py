"""Parts of a reconstruction: which tasks of a whole one are computed for some stages, or for some files."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from dry_chain import FRAMES, Chain, laid_out
from raising import raises

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.export.view import RunView
from rille.pipeline.flow.closed_loop import dataflow
from rille.pipeline.runs import part_of_run, run_files


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with laid_out(tmp_path_factory.mktemp("cache")) as chain:
        yield chain


def part(chain: Chain, until: tuple[str, ...] = (), only: tuple[str, ...] = ()) -> tuple[Graph, driver.Result]:
    """The graph of a part, over a store that has every artifact of a reconstruction but those of files."""
    graph = Graph(cut=part_of_run.cut(until, only))
    products, _ = dataflow(graph, chain.sequence, chain.config, FRAMES)
    view = RunView(
        sequence=chain.sequence, frames=FRAMES, config=chain.config, products=products, until=until, only=only
    )
    graph.last = lambda: run_files.lay_out(graph, view, {})
    return graph, driver.run(graph, chain.store, driver.RunOptions(dry=True))


def test_of_each_stage_a_part_has_all_tasks_and_all_that_they_read(chain: Chain) -> None:
    for stage in {h.stage for h in chain.base.nodes} & set(
        part_of_run.config.stages(*part_of_run.config.RECONSTRUCTION)
    ):
        graph, _ = part(chain, (stage,))
        have = {h.label: h for h in graph.nodes}
        assert {h.label for h in chain.base.nodes if h.stage == stage} <= have.keys(), stage
        assert all(up.label in have for h in graph.nodes for up in h.upstream()), stage


@pytest.mark.parametrize(
    ("until", "without"),
    [
        ("motion", {"hfvm", "features", "keyframes", "locus", "trajectory"}),
        ("features", {"crosscheck", "motion", "hfvm", "trajectory"}),
        ("hfvm", {"features", "ground_frame", "locus", "track", "trajectory"}),
        ("trajectory", {"crosscheck", "locus", "accuracy", "agreement", "merge"}),
        ("merge", {"crosscheck", "accuracy", "dem_accuracy", "path", "risk"}),
    ],
)
def test_what_a_stage_does_not_need_is_left_out(chain: Chain, until: str, without: set[str]) -> None:
    graph, result = part(chain, (until,))
    assert without.isdisjoint(h.stage for h in graph.nodes)
    assert result.left_out.total() > 0
    assert result.ok


def test_a_file_is_made_of_what_it_reads_alone(chain: Chain) -> None:
    graph, _ = part(chain, only=("trajectory.tum",))
    assert {h.label for h in graph.nodes if h.label.startswith("output/")} == {"output/trajectory.tum", "output/facts"}
    assert {"locus", "crosscheck", "merge", "accuracy"}.isdisjoint(h.stage for h in graph.nodes)


def test_the_files_of_a_stage_are_those_that_read_nothing_else(chain: Chain) -> None:
    graph, _ = part(chain, ("trajectory",))
    files = {h.label.removeprefix("output/") for h in graph.nodes if h.label.startswith("output/")}
    assert {"trajectory.tum", "trajectory.kitti", "facts"} <= files
    assert {"crosscheck.tum", "dem.tif", "path.gpkg"}.isdisjoint(files)


@pytest.mark.parametrize(
    ("until", "only", "code", "remedy"),
    [
        (("hvfm",), (), "RIL-035", "hfvm"),
        ((), ("dem.tiff",), "RIL-035", "dem.tif"),
        (("rig",), ("a",), "RIL-034", ""),
        ((), ("report.json",), "RIL-036", "leave --only out"),
    ],
)
def test_what_there_is_not_is_refused(
    chain: Chain, until: tuple[str, ...], only: tuple[str, ...], code: str, remedy: str
) -> None:
    with raises(code, remedy):
        part(chain, until, only)
