"""Ctrl-C in a command: the documented sentence, and exit code 130."""

from rille.pipeline import cli
from rille.pipeline.runs import session


def test_ctrl_c_says_what_the_documents_say(monkeypatch, capsys):
    def interrupted(options):
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "reconstruct", interrupted)
    assert cli._run(["reconstruct", "mockup-short"]) == 130
    assert capsys.readouterr().err == "rille: interrupted; the same command resumes from here\n"
