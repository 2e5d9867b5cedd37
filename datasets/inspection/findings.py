"""What inspection of a folder of stereo images finds: views, calibration, tables; paths are relative to the folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from rille.stages.geometry.geometry import RigidTransform, Sizes


@dataclass(frozen=True)
class FoundImages:
    """The left and right images that were found.

    Attributes
    ----------
    left, right : patterns relative to the folder.
    pairs : number of pairs.
    sizes : of the left and of the right images, if all of a side have the same.
    why : how left and right were recognised.
    trouble : why the images cannot be paired; empty: they can.
    stamped : whether the left images' names are times, since 1970 or as date and time of day.
    sides : the words or letters in the names that mark left and right.
    absent : missing files of pairs, which are counted in ``pairs``.
    lines : on the pairing by time stamps in the names, if these differ.
    others : lines on images that are of another set of pairs, or of none.
    """

    left: str
    right: str
    pairs: int
    sizes: Sizes | None
    why: str
    trouble: str = ""
    stamped: bool = False
    sides: tuple[str, str] = ("left", "right")
    absent: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class FoundCalibration:
    """Suitable calibration files: one for both cameras or one each, relative to the folder.

    ``names``: of the two cameras, if the file has more. ``mount``: T_reference_left, if the reference frame of the
    files is not the left camera's, but mostly that of the body or of the IMU.
    """

    files: tuple[str, ...]
    sizes: tuple[tuple[int, int] | None, tuple[int, int] | None]
    baseline: float | None
    cameras: int
    names: tuple[str, str] | None = None
    mount: RigidTransform | None = None

    def suits(self, sizes: Sizes | None) -> bool:
        """Whether it fits images of these sizes, as far as both are known."""
        return sizes is None or all(own in (None, size) for own, size in zip(self.sizes, sizes, strict=True))


@dataclass
class Findings:
    """Findings in a folder; paths are relative to it."""

    folder: Path
    views: FoundImages
    calibration: FoundCalibration | None = None
    others: list[str] = field(default_factory=list)
    masks: dict[str, str] = field(default_factory=dict)
    tables: dict[str, list[str]] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)


def relative(path: Path, folder: Path) -> str:
    """Path relative to the folder, as in a manifest."""
    return path.relative_to(folder).as_posix()
