"""The calibration files of a folder that suit its images best."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rille.datasets.cameras import KNOWN, CalibratedCamera, read_cameras
from rille.datasets.cameras.model import of_size, relative_pose
from rille.datasets.images.kinds import line
from rille.datasets.inspection.patterns import relative
from rille.datasets.inspection.tables import TABLES
from rille.datasets.inspection.views import FoundImages
from rille.datasets.text.sides import two_sides
from rille.stages.core.errors import RilleError
from rille.stages.geometry.geometry import RigidTransform, Sizes

CALIBRATIONS = (
    *(".yaml", ".yml", ".xml", ".txt", ".toml", ".ini", ".cfg", ".conf", ".json"),
    *(".tsai", ".cameramodel", ".lbl", ".cahv", ".cahvor", ".cahvore"),
)


@dataclass(frozen=True)
class FoundCalibration:
    """Suitable calibration files: one for both cameras or one each, relative to the folder.

    ``names``: of the two cameras, if the file has more, which are ``among``. ``mount``: T_reference_left, if the
    reference frame of the files is not the left camera's, but mostly that of the body or of the IMU.
    """

    files: tuple[str, ...]
    sizes: tuple[tuple[int, int] | None, tuple[int, int] | None]
    baseline: float | None
    cameras: int
    names: tuple[str, str] | None = None
    among: tuple[str, ...] = ()
    mount: RigidTransform | None = None

    def suits(self, sizes: Sizes | None) -> bool:
        """Whether it fits images of these sizes, as far as both are known."""
        return sizes is None or all(own in (None, size) for own, size in zip(self.sizes, sizes, strict=True))


class Calibrations(NamedTuple):
    """The files that suit the images best, None where none does; other calibrations; and lines on what is not read."""

    best: FoundCalibration | None
    others: list[str]
    unread: list[str]


def find_calibration(folder: Path, texts: list[Path], views: FoundImages) -> Calibrations:
    """Find the one or the two calibration files that suit the images of a folder best."""
    read, unread = dict[str, list[CalibratedCamera]](), list[str]()
    for path in texts:
        try:
            cameras = read_cameras(path)
        except (RilleError, OSError, ValueError) as error:
            # Most text files are tables, or something else; a file refused for its lens is a calibration.
            other = path.suffix.lower() in TABLES or (isinstance(error, RilleError) and error.remedy == KNOWN)
            refused = re.match(r"RIL-(81\d|120|135)", getattr(error, "code", ""))
            named = "calib" in path.stem.lower() and getattr(error, "remedy", "") != KNOWN
            if refused or named or not other:
                unread.append(" ".join(str(error).split()))
            continue
        if cameras:
            read[relative(path, folder)] = cameras
    # Of equally good files one of two cameras rather than one of more.
    in_turn = sorted(read.items(), key=lambda item: len(item[1]) > 2)
    candidates = [_calibration((name,), cameras, views) for name, cameras in in_turn]
    single = {name: cameras[0] for name, cameras in read.items() if len(cameras) == 1}
    # Cameras of other names differ by the same words as their images.
    renamed = {name: _of_other_side(name, views.sides) for name in single}
    pairs = two_sides(single) or [pair for pair in renamed.items() if pair[0] != pair[1] in single]
    candidates += [_calibration(pair, [single[name] for name in pair], views) for pair in pairs]
    if not candidates:
        return Calibrations(None, [], unread)
    place = Path(views.left).parent

    def rank(c: FoundCalibration) -> tuple[int, ...]:
        above, beside = [place, *place.parents], Path(c.files[0]).parent
        far = above.index(beside) if beside in above else len(above)
        return c.suits(views.sizes), c.cameras, c.baseline is not None, -far, -len(c.files)

    best = max(candidates, key=rank)
    taken = best.files
    each = [name for name in read if re.sub(r"\d+", "", name) == re.sub(r"\d+", "", taken[0])]
    unlike = [name for name in each if len(each) == views.pairs and str(read[name]) != str(read[taken[0]])]
    remedy = f"unlike {taken[0]}, which is taken for all images; write a manifest for each"
    unread += [line("calibration", unlike, remedy)] if unlike and not taken[1:] else []
    return Calibrations(best, [name for name in read if name not in taken], unread)


def _of_other_side(name: str, sides: tuple[str, str]) -> str:
    """The name of a file of the left camera with the right one's word or number in the place of its own; else as is."""
    left, right = (re.sub(r"\D", "", side) for side in sides)
    words = {sides[0]: sides[1]} | ({left: right} if left and right else {})
    return "".join(words.get(word, word) for word in re.split(r"([^\W_]+)", name))


def _calibration(files: tuple[str, ...], read: list[CalibratedCamera], views: FoundImages) -> FoundCalibration:
    """Of several cameras the two of the images' sizes, or with the numbers in their names (``image_2``: ``P2``), else
    the first two."""
    cameras = of_size(read, views.sizes)
    numbers = [re.search(r"\d+$", side) for side in views.sides]
    by_number = {int(n[0]): c for c in cameras if (n := re.search(r"\d+(?=\D*$)", c.name))}
    chosen = [by_number[int(n[0])] for n in numbers if n and int(n[0]) in by_number]
    both = chosen if len(cameras) > 2 and len(chosen) == 2 else cameras[:2]
    left, right = both[0], both[-1]
    pose = relative_pose(left, right) if both[1:] else None
    baseline = None if pose is None else float(np.linalg.norm(pose.translation))
    names = (left.name, right.name) if len(read) > 2 else None
    among = tuple(camera.name for camera in read) if names else ()
    return FoundCalibration(files, (left.size, right.size), baseline, len(both), names, among, left.mount)
