"""Several sequences in one command: order, exit code, and what became of each."""

from __future__ import annotations

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


def run(names: list[str], *, keep_going: bool = True) -> tuple[int, batch.Ended]:
    def one(name: str) -> tuple[int, Path | str]:
        end = ENDS[name]
        if isinstance(end, Exception):
            raise end
        return end, Path(name)

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
        batch.each(["a", "b"], one, keep_going=True)
