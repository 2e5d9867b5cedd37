"""Failures of the machine and of libraries, in one line that says where and what to change."""

from __future__ import annotations

import errno
import tempfile
from pathlib import Path

from rille.datasets.text.reading import missing_target
from rille.stages.core.errors import ConfigError, RilleError

FULL = (errno.ENOSPC, errno.EDQUOT)
CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)


def translated(error: BaseException) -> RilleError | None:
    """Translate a failure into an error of Rille with a remedy; None if Rille knows no better message."""
    if isinstance(error, RilleError):
        return error
    if isinstance(error, MemoryError):
        remedy = "set --memory-limit or fewer --jobs, or match in tiles (tiling.memory)"
        return RilleError("RIL-736", "memory is used up", remedy=remedy)
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{error.filename}: " if error.filename else ""
        kind = ConfigError if error.errno == errno.ENAMETOOLONG else RilleError
        remedy = remedy_of(error.errno)
        if error.errno in FULL and str(error.filename).startswith(
            f"{tempfile.gettempdir()}/{tempfile.gettempprefix()}"
        ):
            remedy = "free space there, or set TMPDIR to a folder that has more"
        return kind("RIL-737", f"{where}{reason_of(error)}", remedy=remedy)
    library = type(error).__module__.split(".")[0]
    if library == "cv2":
        return RilleError("RIL-738", f"OpenCV cannot do this: {error}", remedy="check the images and their sizes")
    if library in ("rasterio", "lazrs"):
        what = "a raster" if library == "rasterio" else "a cloud of points"
        remedy = "check the space in --runs or --output"
        return RilleError("RIL-739", f"cannot write or read {what}: {error}", remedy=remedy)
    return None


def reason_of(error: OSError) -> str:
    """Why the system refused, in words."""
    if not error.filename and error.errno == errno.ENOENT:
        return "the current folder was removed"
    path = Path(str(error.filename or ""))
    links = (missing_target(link, str(link)) for link in (path, *path.parents))
    return next(filter(None, links), str(error.strerror))


def remedy_of(number: int) -> str:
    """What to change where the system refused with this number (:mod:`errno`)."""
    if number in FULL:
        return "free space, clear the cache, or choose another place with --output, --runs or --cache"
    if number in CLOSED:
        return "check its rights, or choose a place that may be written with --output, --runs or --cache"
    if number == errno.ENAMETOOLONG:
        return "give a shorter name"
    return "check the path; the same command resumes from here"
