"""``rille calibrate``: a stereo rig from images of a chessboard, with residuals of views and errors of parameters.

The result is an OpenCV YAML file, which manifests take: ``[cameras] file = "rig.yaml"``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np

from rille.datasets.images import chessboard, pairing
from rille.datasets.images.boards import Boards, find_boards, image_files
from rille.datasets.text.reading import read_text
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.runs.options import FLAG, Output, check_new, check_output
from rille.stages.calibration.target import RigCalibration, calibrate_rig, doubts, refuse_clutter, refuse_one_place
from rille.stages.core.errors import InputError


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
    pictures = image_files(left, right)
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
