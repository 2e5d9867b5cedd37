"""Several sequences in one command: order, exit code, and what became of each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rille.pipeline.commands import complaints
from rille.pipeline.commands.computing import reconstruct
from rille.pipeline.runs.options import COMPLETE, FAILED, HOLES, USAGE, Options
from rille.stages.core.errors import DegenerateError, InputError

ENDS = {
    "whole": COMPLETE,
    "holes": HOLES,
    "none": InputError("RIL-276", "no sequence"),
    "dark": DegenerateError("RIL-050", "no image"),
    "fault": ZeroDivisionError("own"),
}


def run(names: list[str], *, keep_going: bool = True) -> tuple[int, complaints.Ended]:
    def one(name: str) -> tuple[int, Path | str]:
        end = ENDS[name]
        if isinstance(end, Exception):
            raise end
        return end, Path(name)

    return complaints.each(names, one, keep_going=keep_going)


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
    worst, ended = run(names)
    assert [name for name, _ in ended] == names
    assert worst == code
    said = capsys.readouterr().err
    assert said.count("rille: error") == sum(isinstance(ENDS[name], Exception) for name in names)


def test_what_cannot_be_run_ends_the_others_unless_they_shall_go_on(capsys):
    _, ended = run(["holes", "none", "whole"], keep_going=False)
    assert ended == [("holes", Path("holes")), ("none", "RIL-276"), ("whole", "not begun")]
    assert "RIL-276" in capsys.readouterr().err
    assert run(["fault"])[1] == [("fault", "ZeroDivisionError")]


def test_an_interrupt_ends_the_command():
    def one(name: str) -> tuple[int, Path | str]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        complaints.each(["a", "b"], one, keep_going=True)


def test_runs_are_listed_and_then_the_sequences_without_one(tmp_path, monkeypatch, capsys):
    def one(name: str, options: Options) -> tuple[int, Path]:
        if name == "none":
            raise ENDS["none"]
        (tmp_path / name / "1").mkdir(parents=True)
        (tmp_path / name / "1" / "ledger.jsonl").write_text(json.dumps({"run": {"ok": True, "total": 2.5}}) + "\n")
        return COMPLETE, tmp_path / name / "1"

    monkeypatch.setattr(reconstruct, "_perform", one)
    assert reconstruct.reconstruct("none", "whole", options=Options(keep_going=True)) == USAGE
    rows = [row.split() for row in capsys.readouterr().out.splitlines()]
    assert rows[1:] == [["whole/1", "complete", "0", "0", "2.5"], ["none", "RIL-276"]]
    monkeypatch.setattr(reconstruct, "_perform", lambda name, options: (COMPLETE, tmp_path / "whole" / "1"))
    reconstruct.reconstruct("whole", "whole")
    assert all(capsys.readouterr().out.splitlines())
