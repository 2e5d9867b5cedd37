"""Wrong usage of each command: status 2, nothing written, the last line of stderr is one error with its code."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from cyclopts import App
from place import RILLE, Place

from rille.pipeline.cli import COMMANDS, app, summary

WRONG = {
    "": [("no-such-command", "RIL-001"), ("--no-such-option", "RIL-001")],
    "reconstruct": [
        ("no-such-sequence", "RIL-276"),
        ("--no-such-option", "RIL-001"),
        ("other --frames 7:9", "RIL-055"),
        ("other --frames a:b", "RIL-055"),
        ("other --set locus.no_such_key=1", "RIL-027"),
        ("other --set locus.cell_size=large", "RIL-027"),
        ("other --set locus", "RIL-024"),
        ("other --config no-such-file.toml", "RIL-138"),
        ("other --config other/calib.txt", "RIL-026"),
        ("other --executor cloud", "RIL-539"),
        ("other --jobs 0", "RIL-540"),
        ("other --jobs many", "RIL-001"),
        ("other --force no-such-stage", "RIL-035"),
        ("other --memory-limit lots", "RIL-553"),
        ("other --progress loud", "RIL-001"),
    ],
    "drive": [
        ("other", "RIL-059"),
        ("mockup-loop --jobs 0", "RIL-540"),
        ("no-such-sequence", "RIL-276"),
        ("--no-such-option", "RIL-001"),
    ],
    "plan": [
        ("no-such-sequence", "RIL-276"),
        ("--no-such-option", "RIL-001"),
        ("other --frames 7:9", "RIL-055"),
        ("other --executor cloud", "RIL-539"),
        ("other --jobs 0", "RIL-540"),
        ("other --jobs -2", "RIL-540"),
        ("other --force no-such-stage", "RIL-035"),
        ("other --memory-limit lots", "RIL-553"),
        ("other --until no-such-stage", "RIL-035"),
        ("other --only no-such-file", "RIL-035"),
        ("no-such-sequence --runs elsewhere", "RIL-276"),  # taken, as by the run
    ],
    "graph": [
        ("no-such-sequence", "RIL-276"),
        ("--no-such-option", "RIL-001"),
        ("other --frames 7:9", "RIL-055"),
    ],
    "why": [
        ("", "RIL-001"),
        ("no-such-run trajectory", "RIL-067"),
        ("other no-such-task", "RIL-068"),
        ("other trajectory --no-such-option", "RIL-001"),
    ],
    "params": [("no-such-section", "RIL-035"), ("--no-such-flag", "RIL-001")],
    "runs": [("no-such-sequence", "RIL-880"), ("--runs no-such-folder", "RIL-880"), ("other other", "RIL-001")],
    "timing": [("no-such-run", "RIL-067"), ("--runs no-such-folder", "RIL-067"), ("other other", "RIL-001")],
    "compile": [("other", "RIL-001"), ("--no-such-option", "RIL-001")],
    "view": [("no-such-run", "RIL-067"), ("other other", "RIL-001")],
    "compare": [
        ("other", "RIL-001"),
        ("other no-such-run", "RIL-067"),
    ],
    "check": [
        ("", "RIL-001"),
        ("no-such-sequence", "RIL-276"),
        ("other --frames 9:12", "RIL-055"),
        ("other --no-such-option", "RIL-001"),
    ],
    "rig": [("", "RIL-001"), ("no-such-run", "RIL-067")],
    "localize": [("", "RIL-001"), ("no-such-run map.tif", "RIL-067"), ("runs/other/latest", "RIL-844")],
    "merge": [("", "RIL-001"), ("no-such-run runs/other/latest -o one", "RIL-067")],
    "watch": [("", "RIL-001"), ("no-such-sequence", "RIL-276"), ("other --count many", "RIL-001")],
    "mask": [("", "RIL-001"), ("no-such-sequence", "RIL-276"), ("other", "RIL-906")],
    "init": [
        ("", "RIL-001"),
        ("no-such-folder", "RIL-193"),
        ("other/left", "RIL-194"),
        ("other --no-such-option", "RIL-001"),
    ],
    "calibrate": [
        ("other/left other/right", "RIL-001"),
        ("no-such-folder other/right --square 0.1", "RIL-011"),
        ("other/left other/right --square -1", "RIL-152"),
        ("other/left other/right --square 0.1 --corners 9", "RIL-151"),
        ("other/left other/right --square 0.1 --model bent", "RIL-001"),
        ("other/left other/right --square 0.1 -o rig.json", "RIL-871"),
    ],
    "match": [
        ("other/left/000000.png", "RIL-001"),
        ("other/left/000000.png no-such-file.png", "RIL-138"),
        ("other/left/000000.png other/calib.txt", "RIL-171"),
        ("other/left/000000.png other/right/000000.png --preset best", "RIL-001"),
        ("other/left/000000.png other/right/000000.png --set locus.cell_size=1", "RIL-046"),
    ],
    "export": [
        ("other", "RIL-001"),
        ("other --to obj", "RIL-001"),
        ("no-such-run --to laz", "RIL-067"),
        ("runs/other/none --to colmap", "RIL-067"),
        ("runs/other/latest --to laz -o cloud.ply", "RIL-871"),
        ("other --to glb --every 4", "RIL-967"),
        ("other --to frames --voxel 0.1", "RIL-967"),
    ],
    "compare-dem": [
        ("runs/other/latest", "RIL-001"),
        ("runs/other/latest no-such-file.tif", "RIL-627"),
        ("other/calib.txt runs/other/latest", "RIL-629"),
        ("runs/other/latest runs/other/latest --align shear", "RIL-001"),
    ],
    "datasets": [("no-such-dataset", "RIL-001"), ("--no-such-option", "RIL-001")],
    "datasets list": [("other", "RIL-001")],
    "datasets export": [
        ("mockup-short", "RIL-001"),
        ("no-such-dataset x", "RIL-276"),
        ("mockup-short other", "RIL-607"),
    ],
    "cache": [("no-such-command", "RIL-001")],
    "cache verify": [("--no-such-option", "RIL-001"), ("--cache no-such-folder", "RIL-589")],
    "cache gc": [("--no-such-option", "RIL-001"), ("--cache no-such-folder", "RIL-589")],
}


def commands(at: App, name: str = "") -> set[str]:
    """Names of an app's commands, those of its groups too."""
    found = {name}
    for word in at:
        if not word.startswith("-"):
            found |= commands(at[word], f"{name} {word}".strip())
    return found


def test_every_command_is_here() -> None:
    assert set(WRONG) == commands(app)


@pytest.mark.parametrize(
    ("command", "words", "code"), [(name, *case) for name, cases in WRONG.items() for case in cases]
)
def test_wrong_usage_is_one_line_with_a_code(place: Place, command: str, words: str, code: str) -> None:
    before = place.made()
    done = place.here(*command.split(), *words.split())
    assert (done.status, done.out) == (2, "")
    assert place.made() == before
    *warnings, line = done.err.splitlines()
    assert re.match(rf"rille: error {code}: \S", line), done.err
    assert all(line.startswith("rille: warning") for line in warnings)


@pytest.mark.parametrize("command", sorted(commands(app)))
def test_help(place: Place, command: str) -> None:
    done = place.here(*command.split(), "--help")
    assert (done.status, done.err) == (0, "")
    assert done.lines[0].startswith(f"Usage: rille {command}".strip())


@pytest.mark.parametrize("command", COMMANDS)
def test_the_list_says_of_a_command_what_its_own_help_begins_with(command: str) -> None:
    assert app[command].help.startswith(summary(COMMANDS[command]))


def test_the_list_of_commands_imports_none_of_them() -> None:
    program = "import sys; from rille.pipeline.cli import main; main(['--help'])"
    loaded = f"import atexit, sys; atexit.register(lambda: print('numpy' in sys.modules)); {program}"
    done = subprocess.run([sys.executable, "-c", loaded], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "False"


def test_a_word_too_many_is_named(place: Place) -> None:
    done = place.here("match", "a.png", "b.png", "c.tif")
    assert done.err == "rille: error RIL-001: unexpected 'c.tif'. `rille match --help` says what it takes.\n"


def test_a_path_that_looks_like_an_option_is_named_as_one_would_give_it(place: Place, tmp_path: Path) -> None:
    (tmp_path / "-dash dir").mkdir()
    done = place.here("check", "-dash dir", folder=tmp_path)
    assert done.err.endswith("The path -dash dir is given as ./-dash dir.\n")


def test_a_reader_that_has_gone_is_no_traceback() -> None:
    """The few lines are still in Python's buffer when the command has ended."""
    reader, writer = os.pipe()
    os.close(reader)
    given = {"stdout": writer, "stderr": subprocess.PIPE, "env": {**os.environ, "PYTHONUNBUFFERED": ""}}
    done = subprocess.run([str(RILLE), "datasets", "list"], check=False, text=True, **given)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


def test_closed_streams_lead_nowhere() -> None:
    done = subprocess.run(f"'{RILLE}' datasets list >&-", check=False, shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    done = subprocess.run(f"'{RILLE}' datasets lst 2>&-", check=False, shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")


def test_names_are_utf8_in_the_locale_of_ascii(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    for side in ("left", "right"):
        (tmp_path / "gr\u00fcn" / side).mkdir(parents=True)
        (tmp_path / "gr\u00fcn" / side / "1.png").write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    ascii_alone = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = [RILLE, "init", "gr\u00fcn", "-o", "\u00e4.toml"]
    done = subprocess.run(words, cwd=tmp_path, env={**os.environ, **ascii_alone}, capture_output=True, timeout=120)
    assert (done.returncode, "wrote        \u00e4.toml" in done.stdout.decode()) == (0, True), done.stderr
