"""Ctrl-C in a command: the documented sentence, and exit code 130."""

import subprocess
import sys

import pytest

from rille.pipeline import cli
from rille.pipeline.runs import session


def test_ctrl_c_says_what_the_documents_say(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "perform", interrupted)
    assert cli._run(["reconstruct", "mockup-short"]) == 130
    assert capsys.readouterr().err == "rille: interrupted; the same command resumes from here\n"


PROGRAM = """
import atexit, os, runpy, signal, sys

moment = sys.argv.pop()

class Interrupter:
    @staticmethod
    def find_spec(name, *more):
        if name == moment:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupter)
if moment == "exit":
    atexit.register(os.kill, os.getpid(), signal.SIGINT)
runpy.run_module("rille", run_name="__main__")
"""


@pytest.mark.parametrize(
    "moment", ["cyclopts", "rich.console", "rille.pipeline.commands.computing.plan", "numpy", "exit"]
)
def test_ctrl_c_while_modules_are_loaded_is_one_line(moment, tmp_path):
    command = [sys.executable, "-c", PROGRAM, "plan", "mockup-short", "--cache", str(tmp_path), moment]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert (ended.returncode, ended.stderr) == (130, "rille: interrupted\n")
