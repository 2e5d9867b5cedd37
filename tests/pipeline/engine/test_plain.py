from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rille.pipeline import cli
from rille.pipeline.engine.plain import UNSEEN, PlainStream, plain, plain_output

ESCAPE = "\x1b]0;owned\x07\x1b[2J\u202etxt.\x9b1m"


@given(st.text(st.characters(codec=None)))
def test_nothing_that_a_terminal_obeys_is_printed(text):
    stream = io.StringIO()
    assert PlainStream(stream).write(text) == len(text)
    assert not UNSEEN.search(stream.getvalue())
    assert plain(text) == text or UNSEEN.search(text)
    stream.getvalue().encode()  # bytes of names that are no UTF-8 included


def test_all_that_is_printed_passes_through(capsys):
    with plain_output():
        print(ESCAPE)
    assert capsys.readouterr().out == "\\x1b]0;owned\\x07\\x1b[2J\\u202etxt.\\x9b1m\n"


def test_letters_that_a_terminal_does_not_have_are_spelt_out(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, "ascii", write_through=True))
    with plain_output():
        print("3 °")
    assert written.getvalue() == b"3 \\xb0\n"


def test_a_file_of_an_evil_name_does_nothing_to_the_terminal(tmp_path, capsys):
    (tmp_path / f"{ESCAPE}.rille.toml").write_text("x = 1")
    with pytest.raises(SystemExit):
        cli.main(["check", str(tmp_path), "--cache", str(tmp_path / "cache")])
    shown = capsys.readouterr()
    assert "owned" in shown.err
    assert "\x1b" not in shown.err + shown.out


def test_a_complaint_is_one_line_of_a_bounded_length(tmp_path, capsys):
    (tmp_path / "m.toml").write_text("\n".join(f"a{k} = '{'x' * 5000}'" for k in range(100)))
    with pytest.raises(SystemExit):
        cli.main(["check", str(tmp_path / "m.toml"), "--cache", str(tmp_path / "cache")])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("rille: error RIL-223")
    assert len(line) < 1100
