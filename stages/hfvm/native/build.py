"""Compile the native solver with the C compiler ``cc`` of this machine, into the folder of its sources.

The name of the binary holds a digest of the sources, so that none of other sources is ever loaded; it is not that of a
module of Python, which walks over the package would import. Each instruction set
is compiled from the same file; :mod:`rille.stages.hfvm.native.library` takes the best one that the processor has. Needs
nothing but Python: it runs while the package is built, when nothing else is installed.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
SOURCES = ("lanes.h", "level.h", "level.c")

FLAGS = ("-std=gnu11", "-O3", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
"""Without contraction: a multiplication and an addition in one would round otherwise than the reference."""

VARIANTS = {
    "": ("-DANY_PROCESSOR",),
    "_v3": ("-march=x86-64-v3",),
    "_v4": ("-march=x86-64-v4", "-mprefer-vector-width=256"),
}
"""Suffix of the functions, and flags, of each instruction set: any processor; on x86 AVX2; AVX-512."""


def binary() -> Path:
    """Path of the binary that belongs to these sources, whether it exists or not."""
    parts = [(FOLDER / name).read_bytes() for name in SOURCES] + [repr((FLAGS, VARIANTS)).encode()]
    return FOLDER / f"_level-{hashlib.sha256(b''.join(parts)).hexdigest()[:16]}-{platform.machine()}.bin"


def compiled() -> Path | None:
    """Path of the binary, made anew; None: there is no compiler, it fails, or the folder is read-only."""
    compiler = shutil.which("cc")
    if compiler is None or not os.access(FOLDER, os.W_OK):
        return None
    path = binary()
    with tempfile.TemporaryDirectory() as folder:
        objects = [name for suffix, flags in VARIANTS.items() if (name := _object(compiler, folder, suffix, flags))]
        # In the folder itself first, so that it appears there as a whole.
        part = path.with_suffix(f".{os.getpid()}")
        if not objects or not _runs(compiler, "-shared", *objects, "-o", str(part), "-lm"):
            part.unlink(missing_ok=True)
            return None
        part.replace(path)
    for other in FOLDER.glob("_level-*.bin"):
        if other != path:
            other.unlink(missing_ok=True)
    return path


def _object(compiler: str, folder: str, suffix: str, flags: tuple[str, ...]) -> str | None:
    """Compiled functions of one instruction set, or None: the compiler does not know it."""
    if suffix and platform.machine() not in ("x86_64", "AMD64"):
        return None
    name = f"{folder}/level{suffix}.o"
    source = str(FOLDER / "level.c")
    return name if _runs(compiler, *FLAGS, *flags, f"-DVARIANT={suffix}", "-c", source, "-o", name) else None


def _runs(*command: str) -> bool:
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False).returncode == 0
