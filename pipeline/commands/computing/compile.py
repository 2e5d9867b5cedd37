"""``rille compile``: compile the kernels of every stage before the first run.

Numba compiles a kernel for the types of a call, so a small reconstruction and a small drive of simulated sequences call
them, in a temporary folder. Compiled kernels stay in the folder of this user's kernels.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from rille.pipeline.engine.runtime import kernels
from rille.pipeline.runs.options import Options
from rille.pipeline.runs.session import perform

SMALL = (
    "mockup.frames=5",
    "mockup.image_width=190",
    "mockup.image_height=174",
    "mockup.focal_length=200",
    "mockup.bed_width=0.8",
    "mockup.bed_length=0.8",
    "locus.cell_size=0.005",
)
"""A reconstruction of five small pairs, which calls all kernels of `mockup-short` except one."""


def compile_kernels() -> None:
    """Compile the numerical kernels for this user and machine, so that the first run need not.

    Runs two small simulated sequences in a temporary folder. What is compiled stays: again, nothing is left to compile.
    """
    print("rille: compiling kernels; from nothing this takes one to two minutes", file=sys.stderr)
    began, before = time.perf_counter(), _kernels()
    with tempfile.TemporaryDirectory() as folder:
        options = Options(SMALL, runs=Path(folder) / "runs", cache=f"{folder}/cache", quiet=True)
        perform("mockup-short", options, warn=lambda _: None)
        # A drive that ends early, when it has called all kernels of driving.
        driven = replace(options, assignments=("drive.max_stops=3",))
        perform("mockup-loop", driven, verb="drive", warn=lambda _: None)
    made, seconds = len(_kernels() - before), time.perf_counter() - began
    print(f"{kernels.folder()}  kernels compiled: {made}, in {seconds:.0f} s")


def _kernels() -> set[str]:
    return {str(path) for path in kernels.folder().glob("*/*.nbc")}
