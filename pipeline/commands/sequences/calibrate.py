"""``rille calibrate``: a stereo rig from images of a chessboard, with residuals of views and errors of parameters.

The result is an OpenCV YAML file, which manifests take: ``[cameras] file = "rig.yaml"``.
"""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.datasets.images import chessboard, pairing
from rille.datasets.images.files import SUFFIXES, read_grey
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.reading import read_text
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.runs.options import FLAG, Output, check_new, check_output
from rille.stages.calibration.target import (
    LEAST_VIEWS,
    BoardView,
    RigCalibration,
    calibrate_rig,
    doubts,
    refuse_clutter,
    refuse_one_place,
)
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


def calibrate(
    left: Path,
    right: Path,
    *,
    square: float,
    corners: str | None = None,
    model: Literal["radtan", "radtan4", "rational", "fisheye"] = "radtan",
    output: Annotated[Path, Output] = Path("rig.yaml"),
    keep_bad: Annotated[bool, FLAG] = False,
) -> None:
    """Calibrate a stereo rig from pictures of a chessboard; prints the residual of each view.

    Parameters
    ----------
    left
        Folder or glob of the left camera's images.
    right
        The same of the right camera; views are paired by number.
    square
        Side of a square, metres.
    corners
        Inner corners, COLUMNSxROWS, for example 9x6; detected by default.
    model
        Distortion model.
    output
        YAML file to write.
    keep_bad
        Keep views whose residuals are far above the others'.
    """
    check_output(output, *((".yaml", ".yml") if output.suffix else ()))
    if output.exists() and "avg_reprojection_error:" not in read_text(output, "calibration"):
        check_new(output, ", and is no rig of this command")
    given = None if corners is None else chessboard.parse_corners(corners)
    chessboard.board_points((3, 3), square)  # refuses a wrong unit before minutes of detection
    pictures = _files(left, right)
    try:
        pairs = pairing.pair_up(*pictures)
    except InputError as error:  # its remedy is for manifests
        remedy = "give both pictures of a pair one name or number, each side in a folder or glob of its own"
        raise InputError(error.code, error.message, remedy=remedy) from error
    boards = find_boards(pairs, given)
    points = chessboard.board_points(boards.corners, square)
    rig = calibrate_rig(points, boards.views, boards.sizes, model, keep_bad=keep_bad)
    refuse_clutter(rig, boards.views, boards.corners)
    refuse_one_place(rig)
    atomic.write(output, _yaml(rig, boards, square))
    origin, size = "given" if given else "found", " x ".join(map(str, boards.corners))
    print(f"board        {size} inner corners ({origin}), squares of {square:g} m")
    print("\n".join([*_views(rig, boards), "", *_parameters(rig), ""]))
    for line in doubts(rig, boards.views, boards.sizes, model):
        warn(line)
    print(f'wrote        {output}\nnext         in the manifest of the sequence:\n\n[cameras]\nfile = "{output.name}"')


def _files(left: Path, right: Path) -> tuple[list[Path], list[Path]]:
    """Image files of both sides; one folder may serve both if the names tell the sides."""
    lefts, rights = _images(left), _images(right)
    if left == right:
        sides = {path: (pairing.side_of(path.stem) or (0, -1))[1] for path in lefts}
        lefts, rights = ([path for path in lefts if sides[path] == side] for side in (0, 1))
        if not (lefts and rights):
            text = f"the names in {left} do not tell left from right"
            raise InputError("RIL-010", text, remedy="give two folders, or two globs in quotes")
    return lefts, rights


def _images(place: Path) -> list[Path]:
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


def _views(rig: RigCalibration, boards: Boards) -> Iterator[str]:
    """Table of residuals."""
    width = max([len("view"), *(len(r.name) for r in rig.residuals), *(len(name) for name, _ in boards.left_out)])
    yield f"views        {sum(r.used for r in rig.residuals)} used, {rig.rms:.3f} px RMS over all corners\n"
    yield f"{'view':{width}s}  left px  right px  epipolar px"
    for r in rig.residuals:
        row = f"{r.name:{width}s}  {r.left:7.3f}  {r.right:8.3f}  {r.epipolar:11.3f}"
        yield row if r.used else f"{row}  left out: far above the others; remove or retake it"
    yield from (f"{name:{width}s}  left out: {reason}" for name, reason in boards.left_out)


def _parameters(rig: RigCalibration) -> Iterator[str]:
    """Table of parameters, each with its standard deviation."""
    units = {"baseline": "m", "rotation": "rad", **dict.fromkeys(("fx", "fy", "cx", "cy"), "px")}
    for name, value in rig.values.items():
        whole, _, part = name.partition(" ")
        if whole != "translation":  # the baseline is its length
            unit = units.get(whole, units.get(part, ""))
            yield f"{name:13s}{value:12.5f} +- {rig.sigma[name]:.5f} {unit}".rstrip()


def _yaml(rig: RigCalibration, boards: Boards, square: float) -> str:
    """The file's text: keys of OpenCV's stereo samples, then board and residuals (pixels RMS)."""
    left, right = boards.sizes
    sizes = {"image_width": left[0], "image_height": left[1]}
    unlike = {"image_size1": np.array(left), "image_size2": np.array(right)}
    lenses = {"1": rig.left, "2": rig.right}
    content: dict[str, Any] = {
        **(sizes if left == right else unlike),
        "distortion_model": rig.left.model,
        **{f"M{k}": lens.camera.matrix for k, lens in lenses.items()},
        **{f"D{k}": np.array([lens.coefficients]) for k, lens in lenses.items()},
        "R": rig.T_right_left.rotation,
        "T": rig.T_right_left.translation.reshape(3, 1),
        "board_width": boards.corners[0],  # inner corners
        "board_height": boards.corners[1],
        "square_size": square,  # metres
        "avg_reprojection_error": rig.rms,
    }
    for name, used in (("views", True), ("views_left_out", False)):
        # OpenCV escapes an apostrophe in a way that is not YAML.
        views = [vars(r) | {"name": r.name.replace("'", "_")} for r in rig.residuals if r.used == used]
        content[name] = {f"view_{k}": {n: v for n, v in view.items() if n != "used"} for k, view in enumerate(views)}
    content["standard_deviations"] = {name.replace(" ", "_"): value for name, value in rig.sigma.items()}
    # In memory, since errors of Python's writing say what is wrong.
    file = cv2.FileStorage("rig.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.writeComment("x_right = R x_left + T, square in metres; board in inner corners; residuals in pixels RMS")
    _store(file, content)
    return str(file.releaseAndGetString())


def _store(file: cv2.FileStorage, content: Mapping[str, Any]) -> None:
    for name, value in content.items():
        if isinstance(value, Mapping):
            file.startWriteStruct(name, cv2.FILE_NODE_MAP)
            _store(file, value)
            file.endWriteStruct()
        else:
            file.write(name, value)
