"""Commands on files: manifests, calibration, two images, elevation models, and what other programs read."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rille.pipeline.commands.options import (
    COMPLETE,
    RUNS,
    Assignments,
    CacheFolder,
    Debug,
    Output,
    Run,
    Runs,
    cache_folder,
    check_output,
    flag,
    prepare,
)


def init(
    directory: Path,
    *,
    output: Annotated[Path | None, Output] = None,
    force: Annotated[bool, flag("Replace a manifest that is there.")] = False,
    debug: Debug = False,
) -> int:
    """Write a commented manifest of a folder of stereo images: what was found, and what is still needed.

    Parameters
    ----------
    directory
        Folder with the images, and with whatever is known of the cameras.
    output
        Manifest to write; by default DIRECTORY's name with .rille.toml, in the present folder.
    """
    from rille.pipeline.commands import init as command

    return command.init(directory, output, force)


@Parameter(name="*")
@dataclass(frozen=True)
class Board:
    """The chessboard of a calibration.

    Parameters
    ----------
    square
        Side of a square, metres.
    corners
        Inner corners, COLUMNSxROWS, for example 9x6; detected by default.
    """

    square: float
    corners: str | None = None


def calibrate(
    left: Path,
    right: Path,
    *,
    board: Board,
    model: Literal["radtan", "radtan4", "rational", "fisheye"] = "radtan",
    output: Annotated[Path, Output] = Path("rig.yaml"),
    keep_bad: Annotated[bool, flag("Keep views whose residuals are far above the others'.")] = False,
    debug: Debug = False,
) -> int:
    """Calibrate a stereo rig from pictures of a chessboard; prints the residual of each view.

    Parameters
    ----------
    left
        Folder or glob of the left camera's images.
    right
        The same of the right camera; views are paired by number.
    model
        Distortion model.
    output
        YAML file to write.
    """
    from rille.pipeline.commands import calibrate as command

    return command.calibrate(
        left, right, square=board.square, corners=board.corners, model=model, output=output, keep_bad=keep_bad
    )


@Parameter(name="*")
@dataclass(frozen=True)
class Matcher:
    """How two images are matched.

    Parameters
    ----------
    preset
        Parameter set of the matcher: fast matches at half the resolution, accurate takes several times as long, paper
        follows the publication to the letter.
    prior_disparity
        Disparity TIFF of this left image to start from, as this command writes it; where it is undefined the search
        starts as without it. It may err by some pixels: three and a few more from neighbours.
    """

    preset: Literal["default", "fast", "accurate", "paper"] | None = None
    prior_disparity: Path | None = None
    assignments: Assignments = None


_MATCHER = Matcher()


def match(
    left: Path,
    right: Path,
    *,
    output: Annotated[Path, Output] = Path("disparity.tif"),
    matcher: Matcher = _MATCHER,
    dense: Annotated[bool, flag("Fill undefined disparities by interpolation.")] = False,
    confidence: Path | None = None,
    debug: Debug = False,
) -> int:
    """Match any two images, without calibration or rectification, to a two-band disparity TIFF.

    Band 1 is column_disparity and band 2 row_disparity, float32 pixels, right minus left (negative columns on a
    rectified pair), NaN where undefined.

    Parameters
    ----------
    left
        Reference image.
    right
        Search image.
    output
        TIFF to write.
    confidence
        TIFF to write with the bands disparity_std (pixels, standard deviation of the column), validity (bits) and
        backmatch_error (pixels).
    """
    prepare()
    from rille.pipeline.commands import match as command

    return command.match_files(
        left,
        right,
        output,
        command.matcher_params(matcher.preset, tuple(matcher.assignments or ())),
        dense=dense,
        prior=matcher.prior_disparity,
        confidence=confidence,
    )


Form = Literal["laz", "ply", "glb", "colmap", "nav2", "grid_map"]
"""What ``rille export`` writes."""


def export(
    run: Run,
    *,
    to: Annotated[list[Form], Parameter(negative="")],
    output: Annotated[Path | None, Output] = None,
    runs: Runs = RUNS,
    cache: CacheFolder = None,
    debug: Debug = False,
) -> int:
    """Write a run for other programs: cloud.laz or cloud.ply (points), terrain.glb (mesh), models, maps.

    Parameters
    ----------
    to
        laz: CloudCompare, PDAL, QGIS; ply: CloudCompare, MeshLab; glb: any glTF viewer, Blender; colmap: cameras, rig,
        poses and tracked points; nav2: map, keepout and speed mask, and path of ROS 2's navigation; grid_map: a bag
        with one GridMap. May be repeated.
    output
        What to write, for one form only; by default cloud.laz, cloud.ply, terrain.glb or a folder of the form's name in
        the run's folder.
    """
    from rille.stages.core.errors import ConfigError

    if output is not None and len(to) > 1:
        raise ConfigError(
            "RIL-020", f"--output names one place for {len(to)} forms", remedy="give one --to, or leave --output out"
        )
    prepare()
    from rille.pipeline.runs import lookup

    folder = lookup.find(run, runs)
    for kind in to:
        print(_export(folder, kind, output, cache))
    return COMPLETE


def _export(run: Path, kind: Form, output: Path | None, cache: str | None) -> str:
    """Write one form; what was written, in words."""
    if kind in ("colmap", "nav2", "grid_map"):
        from rille.pipeline.engine.store.base import Store
        from rille.pipeline.runs import lookup

        write, store = import_module(f"rille.pipeline.export.programs.{kind}").export_run, Store(cache_folder(cache))
        with lookup.reading(run):
            return str(write(run, output or run / kind, store))
    from rille.pipeline.export.programs import point_cloud

    if output is not None:
        check_output(output, f".{kind}")
    path, words = point_cloud.export(run, kind, output)
    return f"{path}  {words}"


def compare_dem(
    a: str,
    b: str,
    *,
    align: Literal["none", "shift", "tilt", "rigid"] = "none",
    output: Annotated[Path, Output] = Path("dem_comparison"),
    runs: Runs = RUNS,
    debug: Debug = False,
) -> int:
    """Compare elevation model A with reference B: errors, completeness, error against range and slope.

    The finer one is brought to the coarser one's cells (means of the known cells inside, or bilinear between four known
    ones); only cells that both know are compared. Prints the figures; writes OUTPUT.png and OUTPUT.json.

    Parameters
    ----------
    a
        GeoTIFF, ESRI ASCII grid (.asc), zarr group with elevation, x and y, or a run: its folder or name (mockup,
        latest).
    b
        Reference, likewise.
    align
        Move A onto B first: shift (x, y, z), tilt (z and two inclinations) or rigid (all six); the motion is printed.
    output
        Files to write, without ending.
    """
    prepare()
    from rille.pipeline.commands import compare_dem as command
    from rille.pipeline.runs import lookup

    return command.compare(*(lookup.elevation(text, runs) for text in (a, b)), align=align, output=output)
