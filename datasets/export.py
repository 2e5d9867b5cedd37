"""Export a sequence as plain files for other tools; Rille reads the folder back as a sequence."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from rille.datasets.manifest.model import VEHICLE_FILE
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Camera, RigidTransform, level_rotation
from rille.stages.geometry.lattice import Lattice

Materialise = Callable[[Source], Bundle]

EXACT = "%.17g"
"""Format of numbers: 17 digits keep every float64 to the bit."""

README = "export_readme.txt"
"""File beside this module: text of the folder's readme, with fields for the sequence's name, size and notes."""


def export(sequence: Sequence, folder: Path, materialise: Materialise) -> None:
    """Write a sequence to a folder, which is made; frames without a pair of images are left out.

    Parameters
    ----------
    materialise : returns the arrays of a source (from a cache, or by running its stage); also true disparity and DEM of
        the basic pairs by the sequence's own stride, if it has them.

    Raises
    ------
    InputError
        The images have lens distortion, which the files cannot hold.
    """
    if sequence.lenses:
        text = f"the images of {sequence.name} have lens distortion, which calib.txt cannot say"
        raise InputError("RIL-184", text, remedy="export a sequence without; this one is plain files already")
    frames = [k for k in range(sequence.frames) if k not in sequence.lost]
    for camera in CAMERAS:
        for k in frames:
            _write_image(folder, camera, sequence.frame_names[k], materialise(sequence.image(k, camera)))
    _write_rig(sequence, folder)
    if sequence.truth is not None:
        poses = (sequence.truth[k] for k in frames)
        # Twelve numbers, rows of [R | t]; NaN for a gap.
        rows = [[math.nan] * 12 if pose is None else pose.to_list() for pose in poses]
        np.savetxt(folder / "poses.txt", rows, EXACT)
    if sequence.times is not None:
        np.savetxt(folder / "times.txt", [sequence.times[k] for k in frames], EXACT)
    if sequence.vehicle is not None:
        (folder / VEHICLE_FILE).write_text(tomli_w.dumps({"vehicle": sequence.vehicle.model_dump()}), "utf-8")
    basic = range(0, sequence.frames, int(sequence.defaults.get("keyframes.stride", 1)))
    for frame in sorted({*basic} - {*sequence.lost}):
        if sequence.truth_disparity is not None and (exact := sequence.truth_disparity(frame)) is not None:
            _write_disparity(folder, sequence.frame_names[frame], materialise(exact))
        _write_dem(sequence, folder, frame, materialise)
    sizes = [f"{camera.width} x {camera.height}" for camera in (sequence.rig.left, sequence.rig.right)]
    text = Path(__file__).with_name(README).read_text(encoding="utf-8")
    text = text.format(
        name=sequence.name,
        frames=len(frames),
        size=sizes[0] if sizes[0] == sizes[1] else f"left {sizes[0]}, right {sizes[1]}",
        notes="\n".join(sequence.notes),
        truth_source=sequence.truth_source or "no truth is known",
    )
    (folder / "README.txt").write_text(text, encoding="utf-8")


def _write_image(folder: Path, camera: str, name: str, bundle: Bundle) -> None:
    _write_png(folder / camera / f"{name}.png", np.asarray(bundle["image"][:]))
    valid = np.asarray(bundle["valid"][:])
    if not valid.all():
        _write_png(folder / "valid" / camera / f"{name}.png", (valid * 255).astype(np.uint8))


def _write_png(path: Path, image: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def projection(camera: Camera, T_camera_reference: RigidTransform) -> list[float]:
    """Twelve numbers of P = K [R | t], row-major."""
    return [float(v) for v in (camera.matrix @ T_camera_reference.matrix34).reshape(-1)]


def _write_rig(sequence: Sequence, folder: Path) -> None:
    rig = sequence.rig
    (folder / "rig.json").write_text(json.dumps(rig.to_dict(), indent=1) + "\n", encoding="utf-8")
    rows = [projection(rig.left, RigidTransform.identity()), projection(rig.right, rig.T_right_left)]
    np.savetxt(folder / "calib.txt", rows, EXACT)


def _write_disparity(folder: Path, name: str, truth: Bundle) -> None:
    path = folder / "disparity" / f"{name}.npz"
    path.parent.mkdir(exist_ok=True)
    names = {"column": "column_disparity", "row": "row_disparity", "occluded": "occluded", "depth": "depth"}
    np.savez_compressed(path, **{k: np.asarray(truth[name][:]) for k, name in names.items() if name in truth.arrays})  # type: ignore[arg-type]


def _write_dem(sequence: Sequence, folder: Path, frame: int, materialise: Materialise) -> None:
    """Write the exact DEM of the evaluation window, on cells at integer multiples of the cell size, if it is known."""
    T_truth_left = None if sequence.truth is None else sequence.truth[frame]
    if sequence.truth_dem is None or T_truth_left is None or sequence.evaluation_window is None:
        return
    cell = float(sequence.defaults.get("locus.cell_size", 0.001))
    x_min, y_min, x_max, y_max = (round(v / cell) for v in sequence.evaluation_window)
    lattice = Lattice.at(x_min, y_max, cell, y_max - y_min + 1, x_max - x_min + 1).to_dict()
    local = RigidTransform(level_rotation(T_truth_left.rotation[2]), np.zeros(3))
    T_truth_local = T_truth_left @ local.inverse()
    truth = materialise(sequence.truth_dem(lattice, T_truth_local, (frame,)))
    path = folder / "dem" / f"{sequence.frame_names[frame]}.npz"
    path.parent.mkdir(exist_ok=True)
    arrays: dict[str, Any] = {name: np.asarray(truth[name][:]) for name in ("elevation", "seen")}
    np.savez_compressed(path, T_truth_local=T_truth_local.matrix34, **arrays, **lattice)
