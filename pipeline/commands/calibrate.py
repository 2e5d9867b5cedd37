"""``rille calibrate``: pictures of a chessboard to a stereo rig, with each view's residual and each parameter's error.

The result is an OpenCV YAML file, which manifests take: ``[cameras] file = "rig.yaml"``.
"""

from __future__ import annotations

import glob
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.datasets.images import chessboard, pairing
from rille.datasets.images.files import SUFFIXES, read_grey
from rille.datasets.text.warning import warning
from rille.pipeline.commands.options import COMPLETE, check_output
from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.plain import warn
from rille.stages.calibration.target import LEAST_VIEWS, MODELS, BoardView, RigCalibration, calibrate_rig
from rille.stages.core.errors import InputError, told
from rille.stages.geometry.geometry import Sizes

ENDINGS = (".yaml", ".yml")
"""Of the name of a rig's file, where it has one."""

LEAST_COVER = 0.5
"""Share of an image that all corners together should span: beyond them, distortion is extrapolated."""

VAGUE_FOCAL = 0.01
"""Relative standard deviation of a focal length that is worth a warning: all depths err by as much."""

MANY_BAD_PX = 1.0
"""Pixels RMS over all views that a chessboard on paper does not explain."""


NO_BOARD = 0.1
"""Residual over the spacing of the corners from which they are not those of a flat board: print errs by hundredths."""


SAME_PX = 1.0
"""RMS distance of all corners, pixels, below which two views show the board at one place: noise moves them by tenths, a
hand by many."""


@dataclass
class Boards:
    """Boards found in the images of two sizes: ``views``, and in ``left_out`` name and reason of pairs of no use."""

    corners: tuple[int, int]
    sizes: Sizes
    views: list[BoardView] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)


def calibrate(
    left: Path,
    right: Path,
    *,
    square: float,
    corners: str | None = None,
    model: str = "radtan",
    output: Path = Path("rig.yaml"),
    keep_bad: bool = False,
) -> int:
    """Calibrate a stereo rig from pairs of pictures of one chessboard, print how well, and write the rig.

    Parameters
    ----------
    left, right : folder or glob of each camera's images; the same folder for both where the names tell the sides.
    square : side of a square, metres.
    corners : inner corners, ``COLUMNSxROWS``; None: found.
    model : distortion model, see :data:`rille.stages.calibration.target.MODELS`.
    output : YAML file to write.
    keep_bad : use also views whose residuals are far above the others'; without it they are left out, and named.

    Raises
    ------
    ConfigError
        An option is not permitted, ``output`` names another kind of file; ``square`` is no length in metres.
    InputError
        Images are missing, unpaired or show no board, or the sides are swapped.
    DegenerateError
        The views do not determine the rig.
    """
    check_output(output, *(ENDINGS if output.suffix else ()))
    given = None if corners is None else chessboard.parse_corners(corners)
    chessboard.board_points((3, 3), square)  # a wrong unit is told before minutes of detection
    boards = find_boards(pairing.pair_up(*_files(left, right)), given)
    points = chessboard.board_points(boards.corners, square)
    found = calibrate_rig(points, boards.views, boards.sizes, model, keep_bad=keep_bad)
    _refuse_clutter(found, boards)
    with reported("RIL-012", f"cannot write {output}", remedy="choose another --output"):
        output.write_text(_yaml(found, boards, square), encoding="utf-8")
    origin = "given" if given else "found"
    print(f"board        {boards.corners[0]} x {boards.corners[1]} inner corners ({origin}), squares of {square:g} m")
    print("\n".join([*_views(found, boards), "", *_parameters(found, model), ""]))
    for line in doubts(found, boards, model):
        warn(line)
    print(f'wrote        {output}\nnext         in the manifest of the sequence:\n\n[cameras]\nfile = "{output.name}"')
    return COMPLETE


def _files(left: Path, right: Path) -> tuple[list[Path], list[Path]]:
    sides = [_images(left), _images(right)]
    if left == right:
        by_side = [[p for p in paths if (pairing.side_of(p.stem) or (0, -1))[1] == k] for k, paths in enumerate(sides)]
        if not all(by_side):
            raise InputError(
                "RIL-010",
                f"the names in {left} do not tell left from right",
                remedy="give two folders, or two globs in quotes",
            )
        return by_side[0], by_side[1]
    return sides[0], sides[1]


def _images(place: Path) -> list[Path]:
    """Image files of a folder, a glob or a single path."""
    found = list(place.iterdir()) if place.is_dir() else [Path(p) for p in glob.glob(str(place.expanduser()))]
    images = sorted(p for p in found if p.suffix.lower() in SUFFIXES)
    if not images:
        raise InputError(
            "RIL-011", f"{place} names no images", remedy="give a folder, or a glob in quotes such as 'left*.jpg'"
        )
    return images


def find_boards(pairs: Sequence[pairing.ImagePair], corners: tuple[int, int] | None) -> Boards:
    """The board in all pairs; its size is found where it is not given.

    Raises
    ------
    InputError
        An image cannot be read, or too few pairs show a board of one size.
    """
    images = {p.name: [chessboard.eight_bit(read_grey(f)) for f in (p.left, p.right)] for p in pairs}
    sizes = {name: (_size(left), _size(right)) for name, (left, right) in images.items()}
    # One picture of another size is a slip; the others still calibrate.
    usual = Counter(sizes.values()).most_common(1)[0][0]
    fit = {name: both for name, both in images.items() if sizes[name] == usual}
    if corners is None:
        corners = chessboard.find_size(image for both in fit.values() for image in both)
    out = Boards(corners, usual)
    for name, both in images.items():
        if name not in fit:
            most = " and ".join(f"{width} x {height}" for width, height in dict.fromkeys(usual))
            out.left_out.append((name, f"its images are not {most} pixels as most are"))
            continue
        points = [chessboard.find_corners(image, corners) for image in both]
        missing = [side for side, p in zip(("left", "right"), points, strict=True) if p is None]
        if points[0] is None or points[1] is None:
            out.left_out.append((name, f"no whole board in the {' nor in the '.join(missing)} image"))
            continue
        view = BoardView(name, points[0], chessboard.same_order(points[0], points[1], corners))
        same = next((other.name for other in out.views if _apart(view, other) < SAME_PX), None)
        if same is not None:
            out.left_out.append((name, f"the board stands as in view {same}"))
            continue
        out.views.append(view)
    if out.left_out and len(out.views) < LEAST_VIEWS:
        raise InputError(
            "RIL-961",
            f"the board of {corners[0]} x {corners[1]} inner corners is of use in {len(out.views)} of {len(images)} "
            f"pairs, {LEAST_VIEWS} are the least ({told(out.left_out, lambda one: f'{one[0]}: {one[1]}')})",
            remedy="move the board between pictures, all of it in view and in focus; "
            "inner corners are one fewer than squares, along each side",
        )
    return out


def _size(image: NDArray[np.uint8]) -> tuple[int, int]:
    """Width and height."""
    return image.shape[1], image.shape[0]


def _apart(a: BoardView, b: BoardView) -> float:
    """RMS distance of the corners of two views, pixels, of the image in which they differ more."""
    return max(float(np.sqrt(((p - q) ** 2).sum(-1).mean())) for p, q in ((a.left, b.left), (a.right, b.right)))


def _refuse_clutter(found: RigCalibration, boards: Boards) -> None:
    grids = [p.reshape(boards.corners[1], boards.corners[0], 2) for v in boards.views for p in (v.left, v.right)]
    spacing = float(np.median([np.linalg.norm(np.diff(g, axis=1), axis=-1) for g in grids]))
    # Relative to the spacing: it holds for any resolution and distance of the board.
    if found.rms > NO_BOARD * spacing:
        columns, rows = boards.corners
        raise InputError(
            "RIL-800",
            f"the corners taken for a board of {columns} x {rows} miss by {found.rms:.1f} px RMS, "
            f"{spacing:.0f} px apart: no flat board, or not the same moment left and right",
            remedy="give pictures of a chessboard, and its inner corners, e.g. --corners 9x6",
        )


def cover(points: Sequence[NDArray[np.float64]], size: tuple[int, int]) -> float:
    """Share of an image within the convex hull of all corners."""
    hull = cv2.convexHull(np.concatenate(points).astype(np.float32))
    return float(cv2.contourArea(hull)) / (size[0] * size[1])


def doubts(found: RigCalibration, boards: Boards, model: str) -> list[str]:
    """List reasons to doubt the result, one line each with its figure."""
    lines = [
        warning("RIL-695", f"view {r.name} is left out: its corners miss by {r.worst:.2f} px RMS; remove or retake it")
        for r in found.residuals
        if not r.used
    ]
    used = [view for view, r in zip(boards.views, found.residuals, strict=True) if r.used]
    if found.rms > MANY_BAD_PX:
        text = f"corners miss by {found.rms:.2f} px RMS: is the board flat, are the images paired rightly?"
        lines.append(warning("RIL-696", text))
    for side, lens, size in zip(("left", "right"), (found.left, found.right), boards.sizes, strict=True):
        share = found.sigma[f"{side} fx"] / lens.camera.fx
        if share > VAGUE_FOCAL:
            text = f"{side} focal length is known to {100 * share:.1f} % only; take views with the board tilted"
            lines.append(warning("RIL-697", text))
        seen = cover([v.left if side == "left" else v.right for v in used], size)
        if seen < LEAST_COVER:
            text = f"the corners span {100 * seen:.0f} % of the {side} image; distortion beyond is a guess"
            lines.append(warning("RIL-698", text))
        vague = [
            name
            for name, value in zip(MODELS[model], lens.coefficients, strict=True)
            if found.sigma[f"{side} {name}"] > max(abs(value), 0.1) and name not in ("p1", "p2")
        ]
        if vague:
            # A model with fewer terms, which these views may determine.
            fewer = "radtan" if model == "rational" else "radtan4"
            text = f"{side} {', '.join(vague)} cannot be told from 0 with these views; try --model {fewer}"
            lines.append(warning("RIL-699", text))
    return lines


def _views(found: RigCalibration, boards: Boards) -> list[str]:
    """Table of residuals."""
    width = max([len("view"), *(len(r.name) for r in found.residuals), *(len(n) for n, _ in boards.left_out)])
    lines = [f"views        {sum(r.used for r in found.residuals)} used, {found.rms:.3f} px RMS over all corners", ""]
    lines += [f"{'view':{width}s}  left px  right px  epipolar px"]
    for r in found.residuals:
        row = f"{r.name:{width}s}  {r.left:7.3f}  {r.right:8.3f}  {r.epipolar:11.3f}"
        lines.append(row if r.used else f"{row}  left out: far above the others")
    return lines + [f"{name:{width}s}  left out: {reason}" for name, reason in boards.left_out]


def _parameters(found: RigCalibration, model: str) -> list[str]:
    """Table of what was determined, each with its standard deviation."""
    lines = [f"{'':13s}{'left':>24s}{'right':>26s}"]
    for name in ("fx", "fy", "cx", "cy", *MODELS[model]):
        unit, digits = ("px", 2) if name[0] in "fc" else ("", 4)
        cells = []
        for side, lens in (("left", found.left), ("right", found.right)):
            value = _value(lens, name, model)
            cells.append(f"{value:12.{digits}f} +- {found.sigma[f'{side} {name}']:.{digits}f} {unit:2s}")
        lines.append(f"{name:13s}{cells[0]:>24s}{cells[1]:>26s}")
    T = found.T_right_left
    lines.append(f"baseline     {np.linalg.norm(T.translation):.5f} +- {found.sigma['baseline']:.5f} m")
    turn = np.degrees(cv2.Rodrigues(T.rotation)[0].ravel())
    angles = [
        f"{a} {t:+.3f} +- {math.degrees(found.sigma[f'rotation {a}']):.3f}" for a, t in zip("xyz", turn, strict=True)
    ]
    return [*lines, f"rotation     {', '.join(angles)} degrees, right camera from left"]


def _value(lens: Any, name: str, model: str) -> float:
    names = MODELS[model]
    return float(lens.coefficients[names.index(name)] if name in names else getattr(lens.camera, name))


def _yaml(found: RigCalibration, boards: Boards, square: float) -> str:
    """The file's text: keys as OpenCV's stereo samples have them, then how it was found."""
    # In memory: the file is written by Python, whose errors say what is wrong.
    file = cv2.FileStorage("rig.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    left, right = boards.sizes
    if left == right:
        file.write("image_width", left[0])
        file.write("image_height", left[1])
    else:
        file.write("image_size1", np.array(left))
        file.write("image_size2", np.array(right))
    file.write("distortion_model", found.left.model)
    for k, lens in ((1, found.left), (2, found.right)):
        file.write(f"M{k}", lens.camera.matrix)
        file.write(f"D{k}", np.array([lens.coefficients]))
    file.writeComment("x_right = R x_left + T, metres")
    file.write("R", found.T_right_left.rotation)
    file.write("T", found.T_right_left.translation.reshape(3, 1))
    file.writeComment("how it was found: board in inner corners, square in metres, residuals in pixels RMS")
    file.write("board_width", boards.corners[0])
    file.write("board_height", boards.corners[1])
    file.write("square_size", square)
    file.write("avg_reprojection_error", found.rms)
    for name, used in (("views", True), ("views_left_out", False)):
        chosen = [r for r in found.residuals if r.used == used]
        file.startWriteStruct(name, cv2.FILE_NODE_MAP)
        for k, r in enumerate(chosen):
            file.startWriteStruct(f"view_{k}", cv2.FILE_NODE_MAP)
            file.write("name", r.name)
            for what in ("left", "right", "epipolar"):
                file.write(what, getattr(r, what))
            file.endWriteStruct()
        file.endWriteStruct()
    file.startWriteStruct("standard_deviations", cv2.FILE_NODE_MAP)
    for key, value in found.sigma.items():
        file.write(key.replace(" ", "_"), value)
    file.endWriteStruct()
    return str(file.releaseAndGetString())
