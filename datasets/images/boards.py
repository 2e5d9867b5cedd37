"""Views of a chessboard in the images of a stereo rig, for its calibration."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.images import chessboard, pairing
from rille.datasets.images.files import SUFFIXES, read_grey
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.sides import side_of
from rille.stages.calibration.target import LEAST_VIEWS, BoardView
from rille.stages.core.errors import InputError, told
from rille.stages.geometry.geometry import Sizes

Image = NDArray[Any]


@dataclass
class Boards:
    """Boards in the images of two sizes: ``views``, and in ``left_out`` name and reason of unusable pairs."""

    corners: tuple[int, int]
    sizes: Sizes
    views: list[BoardView] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)

    def take(self, name: str, images: Sequence[Image]) -> str:
        """Add the view of a pair of images; return why it is unusable, if it is."""
        if tuple(image.shape[::-1] for image in images) != self.sizes:
            most = " and ".join(f"{width} x {height}" for width, height in dict.fromkeys(self.sizes))
            return f"its images are not {most} pixels as most are"
        left, right = (chessboard.find_corners(image, self.corners) for image in images)
        if left is None or right is None:
            missing = [side for side, points in zip(CAMERAS, (left, right), strict=True) if points is None]
            return f"no whole board in the {' nor in the '.join(missing)} image"
        view = BoardView(name, left, chessboard.same_order(left, right, self.corners))
        # Below 1 pixel the board has not moved: noise moves corners by tenths of a pixel, a hand by many pixels.
        same = next((other.name for other in self.views if _distance(view, other) < 1.0), None)
        if same is not None:
            return f"the board stands as in view {same}"
        self.views.append(view)
        return ""


def image_files(left: Path, right: Path) -> tuple[list[Path], list[Path]]:
    """Image files of both sides; one folder may serve both if the names tell the sides."""
    lefts, rights = images_of(left), images_of(right)
    if left == right:
        sides = {path: (side_of(path.stem) or (0, -1))[1] for path in lefts}
        lefts, rights = ([path for path in lefts if sides[path] == side] for side in (0, 1))
        if not (lefts and rights):
            text = f"the names in {left} do not tell left from right"
            raise InputError("RIL-010", text, remedy="give two folders, or two globs in quotes")
    return lefts, rights


def images_of(place: Path) -> list[Path]:
    """Image files of a folder, a glob or a single path."""
    # glob skips hidden files, which macOS adds to archives.
    pattern = f"{glob.escape(str(place))}/*" if place.is_dir() else str(place.expanduser())
    images = sorted(Path(path) for path in glob.glob(pattern) if path.lower().endswith(SUFFIXES))
    if not images:
        remedy = "give a folder, or a glob in quotes such as 'left*.jpg'"
        raise InputError("RIL-011", f"{place} names no images", remedy=remedy)
    return images


def find_boards(pairs: Sequence[pairing.ImagePair], corners: tuple[int, int] | None) -> Boards:
    """The board in all pairs; its size is detected if it is not given.

    Raises
    ------
    InputError
        An image cannot be read, or too few pairs show a board of one size.
    """
    whole = [p for p in pairs if not p.absent]
    images = {p.name: [chessboard.eight_bit(read_grey(path)) for path in (p.left, p.right)] for p in whole}
    sizes = {name: tuple(image.shape[::-1] for image in both) for name, both in images.items()}
    # A few images may have another size by mistake; the others still calibrate.
    usual: Any = Counter(sizes.values()).most_common(1)[0][0]
    if corners is None:
        corners = chessboard.find_size(image for name in images if sizes[name] == usual for image in images[name])
    out = Boards(corners, usual)
    alone = [(p.name, p.absent) for p in pairs if p.left.exists() != p.right.exists()]
    out.left_out = alone + [(name, why) for name, both in images.items() if (why := out.take(name, both))]
    if out.left_out and len(out.views) < LEAST_VIEWS:
        of_use = f"{len(out.views)} of {len(images)} pairs, {LEAST_VIEWS} are the least"
        text = f"the board of {corners[0]} x {corners[1]} inner corners is of use in {of_use}"
        remedy = "move the board between pictures, all of it in view and in focus"
        more = "inner corners are one fewer than squares, along each side"
        raise InputError("RIL-961", f"{text} ({told(out.left_out, ': '.join)})", remedy=f"{remedy}; {more}")
    return out


def _distance(a: BoardView, b: BoardView) -> float:
    """RMS distance of the corners of two views, pixels, of the image in which they differ more."""
    return max(float(np.sqrt(((p - q) ** 2).sum(-1).mean())) for p, q in ((a.left, b.left), (a.right, b.right)))
