"""Compile the kernels of every stage before the first run asks for them.

Numba compiles a kernel for the types that it is called with, so the kernels are called: by a small reconstruction and a
small drive of simulated sequences, in a temporary folder. What they compile stays in the folder of this user's kernels.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from rille.pipeline.engine.runtime import numba_cache
from rille.pipeline.runs.session import Options, perform

SMALL = (
    "mockup.frames=5",
    "mockup.image_width=190",
    "mockup.image_height=174",
    "mockup.focal_length=200",
    "mockup.bed_width=0.8",
    "mockup.bed_length=0.8",
    "locus.cell_size=0.005",
)
"""A reconstruction of five small pairs; it calls every kernel but one of what `mockup-short` calls."""

SHORT = ("drive.max_stops=3",)
"""A drive that ends, far from its goal, when all kernels of driving were called."""


def compile_kernels() -> int:
    """Compile the kernels that are not compiled yet, and print their number; gives the exit code."""
    print("rille: compiling kernels; from nothing this takes one to two minutes", file=sys.stderr)
    began, before = time.perf_counter(), _kernels()
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        for verb, sequence, assignments in (("reconstruct", "mockup-short", SMALL), ("drive", "mockup-loop", SHORT)):
            perform(
                Options(
                    sequence,
                    assignments,
                    runs=Path(folder) / "runs",
                    cache=Path(folder) / "cache",
                    progress="quiet",
                    verb=verb,
                )
            )
    made, seconds = len(_kernels() - before), time.perf_counter() - began
    print(f"{numba_cache.folder()}  kernels compiled: {made}, in {seconds:.0f} s")
    return 0


def _kernels() -> set[str]:
    return {path.name for path in numba_cache.folder().glob("*.nbc")}
