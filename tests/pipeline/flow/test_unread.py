"""A parameter that was set and that nothing reads is an error that names it."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from raising import raises
from toys.chain import build as toy

from rille.datasets.registry import open_sequence
from rille.pipeline.cli import main
from rille.pipeline.commands.sequences.check import check
from rille.pipeline.engine.graph import Graph
from rille.pipeline.export.view import Settled
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow import unread
from rille.pipeline.runs import session
from rille.pipeline.runs.options import Settings


def settled(tmp_path: Path, sequence: str, *assignments: str, config: Path | None = None) -> Settled:
    return session.settings(sequence, session.Options(assignments, config=config, cache=tmp_path / "cache"))


def test_only_values_that_differ_from_what_would_be_in_force_count(tmp_path):
    assert settled(tmp_path, "mockup", "track.points=300", "keyframes.stride=4").given == ("track.points",), "4 it is"
    assert settled(tmp_path, "mockup", "terrain.preset=accurate", "keyframes.preset=navigation").given == ()


@pytest.mark.parametrize("name", ["mockup", "mockup-loop"])
def test_the_configuration_of_a_run_can_be_given_back(tmp_path, name):
    more = ("locus.cell_size=0.008", "vehicle.max_step=0.01")
    first = settled(tmp_path, name, *more)
    path = tmp_path / "config.toml"
    path.write_text(configuration.to_toml(first.config, first.sequence.parameters))
    again = settled(tmp_path, name, config=path)
    assert sorted(again.given) == sorted(more_key.partition("=")[0] for more_key in more)
    assert again.config == first.config
    assert "crosscheck" in tomllib.loads(path.read_text())
    unread.refuse(again.given, again.config, unread.foreign(driven=name != "mockup"), name)


def test_what_a_user_has_switched_off_himself_may_stay(tmp_path):
    assert settled(tmp_path, "mockup", "crosscheck.enabled=false", "crosscheck.window=25").given == ()
    off = settled(tmp_path, "mockup-loop", "crosscheck.window=25")
    assert off.given == ("crosscheck.window",), "it is off in a drive anyway"


@pytest.mark.parametrize(
    ("name", "assignment"),
    [
        ("mockup", "local_planner.max_length=0.3"),
        ("mockup", "drive.goal=[0.0,1.0]"),
        ("mockup-loop", "keyframes.max_gap=3"),
        ("mockup-loop", "crosscheck.enabled=true"),
        ("mockup-loop", "terrain.reference=scene"),
    ],
)
def test_what_no_such_run_can_read_is_refused_before_anything_is_computed(tmp_path, name, assignment, capsys):
    folders = "--cache", str(tmp_path / "cache"), "--runs", str(tmp_path / "runs")
    with pytest.raises(SystemExit) as end:
        main(["reconstruct", name, "--set", assignment, *folders])
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert "RIL-730" in told
    assert assignment.partition("=")[0] in told
    assert not (tmp_path / "cache" / "artifacts").exists()


@pytest.mark.parametrize("assignment", ["mockup.forward=0.1", "mockup.frames=3", "mockup.up_noise_deg=1.0"])
def test_a_drive_refuses_how_a_recorded_rig_moves(assignment):
    given = configuration.parse_assignments([assignment])
    with raises("RIL-280", assignment.partition("=")[0]):
        open_sequence("mockup-loop", given)
    with raises("RIL-281", "misalign"):
        open_sequence("mockup-loop", {"misalign": {"rows": 3.0}})


def test_check_refuses_what_it_does_not_read(tmp_path):
    assignments = ("hfvm.preset=fast", "motion.level=2", "tiling.memory=900", "locus.both=true")
    with raises("RIL-730", "locus.both") as caught:
        check("mockup", options=Settings(assignments=assignments, cache=tmp_path / "cache"))
    assert "hfvm" not in str(caught.value)


def test_sections_without_a_task_in_the_graph_are_told():
    config = configuration.build({})
    graph = Graph()
    toy(graph)
    assert unread.unread(["track.points", "drive.goal"], config, graph) == ["track.points"]
    graph.node(
        "rille.stages.odometry.motion",
        "motion",
        config.motion,
        {"vehicle": {}},
        inputs={"a": graph.nodes[0], "b": graph.nodes[0]},
    )
    keys = ["motion.level", "vehicle.track", "tiling.tile", "loops.apart"]
    assert unread.unread(keys, config, graph) == ["tiling.tile", "loops.apart"]
    assert unread.error(["loops.apart"], config).remedy.startswith("leave it out")
    off = configuration.build({"loops": {"enabled": False}})
    assert "loops.enabled=true" in unread.error(["loops.apart"], off).remedy
