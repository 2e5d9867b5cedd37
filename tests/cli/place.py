"""How ``rille`` is started as a user does, and the commands that fill a folder with two sequences and a drive."""

from __future__ import annotations

import io
import os
import subprocess
import sysconfig
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from rille.pipeline.cli import main

RILLE = Path(sysconfig.get_path("scripts")) / "rille"

LIMIT = 300.0
"""Seconds that a command may take, a first compilation of all kernels among them."""

SMALL = (
    "mockup.image_width=96",
    "mockup.image_height=80",
    "mockup.focal_length=100.0",
    "mockup.bed_width=0.9",
    "mockup.bed_length=0.8",
    "mockup.cell=0.002",
)

SEQUENCE = (*SMALL, "mockup.frames=3")

SETTINGS = """[crosscheck]
enabled = false

[locus]
cell_size = 0.01

[hfvm]
preset = "default"

[vehicle]
wheel_diameter = 0.03
track = 0.08
wheel_base = 0.1
clearance = 0.025
max_step = 0.015
"""

DRIVE = (
    "mockup.image_width=160",
    "mockup.image_height=120",
    "mockup.focal_length=90.0",
    "mockup.bed_width=1.0",
    "mockup.bed_length=1.1",
    "mockup.cell=0.004",
    "mockup.rocks=0.0",
    "mockup.craters=0.0",
    "rover.frame_step=0.05",
    "locus.cell_size=0.008",
    "hfvm.preset=default",
    "drive.goal=[0.03, 0.25]",
    "drive.around=0.4",
    "obstacle_monitor.enabled=false",
)


def sets(assignments: tuple[str, ...]) -> list[str]:
    """As options of the command line."""
    return [word for a in assignments for word in ("--set", a)]


COMPUTING = ["--config", "settings.toml", "--jobs", "1"]

MOCKUP = ["mockup-short", *sets(SEQUENCE), *COMPUTING]
"""The first sequence, with what it is computed with."""

OTHER = ["other", "--config", "settings.toml", "--executor", "inline"]
"""The second one, a folder of plain files."""

PREPARATION = {
    "export": ["datasets", "export", "mockup-short", "other", *sets((*SMALL, "mockup.frames=2", "mockup.seed=5"))],
    "mockup": ["reconstruct", *MOCKUP, "--progress", "plain"],
    "mockup again": ["reconstruct", *MOCKUP, "--progress", "plain"],
    "other": ["reconstruct", *OTHER, "--progress", "plain"],
    "other again": ["reconstruct", *OTHER, "--progress", "plain"],
    "drive": ["drive", "mockup-loop", *sets(DRIVE), "--executor", "inline", "--progress", "plain"],
    "drive again": ["drive", "mockup-loop", *sets(DRIVE), "--executor", "inline", "--progress", "plain"],
    "check": ["check", "other"],
    "check again": ["check", "other"],
}

STARTED = {"export", "mockup", "check"}
"""Of these, what is started as a user does; the others are called in one process, which is faster."""


@dataclass(frozen=True)
class Done:
    """A command that has ended."""

    status: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """Lines of stdout."""
        return self.out.splitlines()

    @property
    def last(self) -> str:
        """Last line of stdout."""
        return self.lines[-1] if self.out else ""

    @property
    def complaint(self) -> str:
        """Last line of stderr."""
        return self.err.splitlines()[-1] if self.err else ""


@dataclass(frozen=True)
class Place:
    """A folder to call ``rille`` in, and what the calls that prepared it said."""

    folder: Path
    said: dict[str, Done]

    def rille(self, *words: str | Path, folder: Path | None = None) -> Done:
        """Start ``rille`` as a user does."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith("RILLE_")}
        done = subprocess.run(
            [str(RILLE), *map(str, words)],
            cwd=folder or self.folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        return Done(done.returncode, done.stdout, done.stderr)

    def here(self, *words: str | Path, folder: Path | None = None) -> Done:
        """Call ``rille`` in this process, which spares the start of another one."""
        out, err = io.StringIO(), io.StringIO()
        environment = {name: value for name, value in os.environ.items() if not name.startswith("RILLE_")}
        with pytest.MonkeyPatch.context() as patched, redirect_stdout(out), redirect_stderr(err):
            patched.chdir(folder or self.folder)
            patched.setattr(os, "environ", environment)
            with pytest.raises(SystemExit) as ended:
                main(list(map(str, words)))
        return Done(int(ended.value.code or 0), out.getvalue(), err.getvalue())

    def made(self) -> set[Path]:
        """Files and folders here, and the folders of all runs."""
        return {*self.folder.iterdir(), *self.folder.glob("runs/*/*")}

    def runs(self, sequence: str) -> list[Path]:
        """Folders of a sequence's runs, the oldest first."""
        return sorted(p for p in (self.folder / "runs" / sequence).iterdir() if not p.is_symlink())
