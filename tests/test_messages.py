"""Messages: errors carry their code, and the command line prints it."""

from __future__ import annotations

import pickle

import pytest

from pipeline.cli import main
from pipeline.store import GoneError


def test_an_error_keeps_its_code_between_processes_and_with_a_place() -> None:
    error = GoneError("RIL-123", "it has gone", remedy="run again")
    for same in (pickle.loads(pickle.dumps(error)), error.at("merge/0")):
        assert (type(same), same.code, same.remedy) == (GoneError, "RIL-123", "run again")
    assert str(error.at("merge/0")) == "merge/0: it has gone: run again"


@pytest.mark.parametrize(
    ("argv", "code", "status"),
    [(["reconstruct", "nothing-of-this-name"], "RIL-", 2), (["reconstruct", "--no-such-option"], "RIL-001", 2)],
)
def test_the_command_line_prints_the_code(
    argv: list[str], code: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == status
    line = capsys.readouterr().err
    assert line.startswith(f"rille: error {code}")
    assert line.count("\n") == 1


def test_an_error_of_the_program_itself_has_a_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("datasets.registry.catalogue", broken)
    with pytest.raises(SystemExit) as ended:
        main(["datasets"])
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith("rille: error RIL-999: ZeroDivisionError: division by zero (run again")
