"""Several sequences in one command: order, exit code, and the table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rille.pipeline.commands import batch
from rille.pipeline.runs.options import COMPLETE, FAILED, HOLES, USAGE
from rille.stages.core.errors import DegenerateError, InputError

ENDS = {
    "whole": COMPLETE,
    "holes": HOLES,
    "none": InputError("RIL-276", "no sequence"),
    "dark": DegenerateError("RIL-050", "no image"),
    "fault": ZeroDivisionError("own"),
}


def run(names: list[str], *, keep_going: bool = True) -> list[batch.Ended]:
    def one(name: str) -> tuple[int, Path | None]:
        end = ENDS[name]
        if isinstance(end, Exception):
            raise end
        return end, None

    return batch.each(names, one, keep_going=keep_going)


@pytest.mark.parametrize(
    ("names", "code"),
    [
        (["whole", "whole"], COMPLETE),
        (["whole", "holes", "whole"], HOLES),
        (["none", "holes", "whole"], USAGE),
        (["none", "dark", "holes"], FAILED),
        (["fault", "whole"], FAILED),
    ],
)
def test_the_exit_code_is_that_of_the_worst_and_all_are_tried(names, code, capsys):
    ended = run(names)
    assert [one.sequence for one in ended] == names
    assert batch.worst(ended) == code
    said = capsys.readouterr().err
    assert said.count("rille: error") == sum(isinstance(ENDS[name], Exception) for name in names)


def test_what_cannot_be_run_ends_the_others_unless_they_shall_go_on(capsys):
    names = ["holes", "none", "whole"]
    ended = run(names, keep_going=False)
    assert [one.sequence for one in ended] == ["holes", "none"]
    assert "RIL-276" in capsys.readouterr().err
    rows = [row.split() for row in batch.table(ended, names).splitlines()]
    assert rows[-2:] == [["none", "refused", "0.0", "RIL-276"], ["whole", "not", "begun"]]


def test_an_interrupt_ends_the_command():
    def one(name: str) -> tuple[int, Path | None]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        batch.each(["a", "b"], one, keep_going=True)


def test_figures_are_those_of_the_report(tmp_path):
    frames = [{"posed": True}, {"posed": False}, {"posed": True}, {"posed": True}]
    report = {"metrics": {"trajectory_drift": {"value": 0.71234}}, "frames": frames}
    report["missing"] = [{"kind": "failed"}, {"kind": "no pose"}, {"kind": "no path"}]
    report["stages"] = {"a": {"computed": 0, "cached": 2}, "b": {"computed": 1, "cached": 0}}
    (tmp_path / "report.json").write_text(json.dumps(report))
    row = batch.table([batch.Ended("street", HOLES, tmp_path, 12.34)], ["street"]).splitlines()[1]
    assert row.split() == ["street", "with", "holes", "75", "%", "0.712", "%", "2", "1", "2", "12.3", str(tmp_path)]
