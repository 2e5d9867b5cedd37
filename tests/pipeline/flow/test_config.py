"""Configuration: layers, strictness, and the file that is written back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from raising import raises

from rille.datasets.text.reading import read_toml
from rille.pipeline.flow import config
from rille.pipeline.python.arguments import assignments


def test_layers_win_in_order() -> None:
    built = config.build(
        config.expand({"keyframes.stride": 2}),
        {"keyframes": {"stride": 3}},
        config.parse_assignments(["keyframes.stride=5"]),
    )
    assert built.keyframes.stride == 5


def test_fast_matches_are_refined_by_more_steps_unless_others_are_given() -> None:
    steps = [
        config.build({"hfvm": {"preset": "fast"}}, {"locus": locus}).locus.refine_steps
        for locus in ({}, {"refine_steps": 2})
    ]
    assert [*steps, config.build().locus.refine_steps] == [6, 2, 3]


def test_one_setting_makes_terrain_accurate_and_what_is_given_beside_it_wins() -> None:
    plain = config.build()
    assert (plain.hfvm.preset, plain.locus.both, plain.merge.max_std_cells) == ("default", False, None)
    built = config.build({"locus": {"cell_size": 0.01}}, config.parse_assignments(["terrain.preset=accurate"]))
    assert (built.hfvm.preset, built.locus.both, built.merge.max_std_cells) == ("accurate", True, 0.7)
    assert built.locus.cell_size == 0.01
    assert (plain.track.points, built.track.points) == (400, 2000)
    assert built.hfvm == config.build({"hfvm": {"preset": "accurate"}}).hfvm
    built = config.build({"terrain": {"preset": "accurate"}}, config.parse_assignments(["locus.both=false"]))
    assert (built.hfvm.preset, built.locus.both) == ("accurate", False)
    built = config.build({"terrain": {"preset": "accurate"}, "hfvm": {"preset": "default"}})
    assert (built.hfvm.preset, built.locus.both) == ("default", True), "one of each"
    assert config.build().locus.both is False, "the preset itself is not changed by what is laid over it"
    with raises("RIL-027", "terrain.preset", "'best'"):
        config.build({"terrain": {"preset": "best"}})


def test_navigation_matches_fast_unless_told_otherwise(tmp_path: Path) -> None:
    assert config.build({}).hfvm.preset == "default"
    built = config.build(config.parse_assignments(["keyframes.preset=navigation"]))
    assert (built.hfvm.preset, built.hfvm.rounds, built.keyframes.overlap) == ("fast", 2, 0.6)
    assert (built.motion.level, built.track.points) == (3, 200)
    assert (
        config.build(config.parse_assignments(["keyframes.preset=navigation", "track.points=300"])).track.points == 300
    )
    for given in ("hfvm.preset=default", "hfvm.preset=accurate"):
        kept = config.build(config.parse_assignments(["keyframes.preset=navigation", given]))
        assert kept.hfvm == config.build(config.parse_assignments([given])).hfvm
    assert config.build(config.parse_assignments(["keyframes.preset=navigation", "hfvm.rounds=3"])).hfvm.rounds == 3
    path = tmp_path / "config.toml"
    path.write_text(config.to_toml(built))
    assert config.build(read_toml(path, "configuration")) == built


def test_unknown_key_names_the_nearest() -> None:
    with raises("RIL-027", "'keyframes.strid'", "mean keyframes.stride?"):
        config.build(config.parse_assignments(["keyframes.strid=2"]))
    with raises("RIL-027", "'locsu'", "mean locus"):
        config.build({"locsu": {"cell_size": 1.0}})


def test_a_key_that_two_tables_share_and_a_section_that_is_named_twice() -> None:
    with raises("RIL-027", "mean vehicle.track?"):
        config.build({"risk": {"track": 0.1}})
    for section, values in (("hfvm", {"preset": "fast"}), ("vehicle", {"track": 0.1})):
        with raises("RIL-027", f"mean {section}.{next(iter(values))}?"):
            config.build({section: {section: values}})
    with raises("RIL-027") as caught:
        config.build({"terrain": {"reference": "grond"}})
    assert "literal" not in str(caught.value)


def test_value_out_of_range_says_what_is_permitted() -> None:
    with raises("RIL-027", "keyframes.stride"):
        config.build(config.parse_assignments(["keyframes.stride=0"]))
    with raises("RIL-027", "keyframes.stride", "'many'"):
        config.build(config.parse_assignments(["keyframes.stride=many"]))


def test_assignment_without_key_or_value() -> None:
    for text in ("keyframes.stride", "stride=3"):
        with raises("RIL-024"):
            config.parse_assignments([text])


def test_written_configuration_reads_back_as_the_same(tmp_path: Path) -> None:
    built = config.build(config.parse_assignments(["keyframes.stride=7", "vehicle.max_step=0.05"]))
    path = tmp_path / "config.toml"
    path.write_text(config.to_toml(built))
    again = config.build(read_toml(path, "configuration"))
    assert again == built
    assert again.vehicle.max_step == 0.05


def test_unreadable_files(tmp_path: Path) -> None:
    with raises("RIL-138"):
        read_toml(tmp_path / "none.toml", "configuration")
    bad = tmp_path / "bad.toml"
    bad.write_text("[select\nstride=1")
    with raises("RIL-026"):
        read_toml(bad, "configuration")


@pytest.mark.parametrize(
    "keys",
    [
        {"locus": 1, "locus.cell_size": 0.1},
        {"locus.cell_size": 0.1, "locus": 1},
        {"locus.cell_size": 0.1, "locus.cell_size.x": 2},
        {"a.b.c": 1, "a.b": [2]},
        {"locus": "wide", "locus.cell_size": 0.1},
    ],
)
def test_a_key_that_is_a_value_and_a_section_is_named(keys):
    with raises("RIL-721"):
        config.expand(keys)


def test_so_where_they_stand_in_two_places():
    for one, other in (({"locus": 1}, {"locus": {"both": True}}), ({"locus": {"both": True}}, {"locus": 1})):
        with raises("RIL-721"):
            config.build(one, other)
    with raises("RIL-721"):
        config.parse_assignments(["locus.both=true", "locus.both.x=1"])


def test_a_section_and_dotted_keys_of_it_are_one():
    assert config.expand({"locus": {"both": True}, "locus.cell_size": 0.1}) == {
        "locus": {"both": True, "cell_size": 0.1}
    }


def test_a_switch_is_no_number():
    with raises("RIL-027", "locus.cell_size", "no switch"):
        config.build({"locus": {"cell_size": True}})
    assert config.build({"locus": {"both": False}}).locus.both is False


def test_numbers_of_numpy_are_numbers():
    given = {"locus": {"cell_size": np.float64(0.004)}, "track": {"points": np.int64(50)}}
    built = config.build(config.parse_assignments(assignments(given)))
    assert (built.locus.cell_size, built.track.points) == (0.004, 50)
