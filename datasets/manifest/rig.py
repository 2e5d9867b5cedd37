"""The rig of a manifest: from calibration files, from figures in the manifest, or from both; with warnings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rille.datasets.cameras import CalibratedCamera, read_cameras, rig_of
from rille.datasets.cameras.model import UNKNOWN_SIZE, of_size, parallel, relative_pose
from rille.datasets.cameras.pair import MAX_OFF_CENTRE
from rille.datasets.manifest.model import Cameras, Manifest, PinholeLens, RigSection
from rille.datasets.protocol import Vector, vector_of
from rille.datasets.text.reading import read_toml
from rille.stages.core.errors import InputError, warning, within
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, Sizes
from rille.stages.geometry.lens import Lens

USUAL_BASELINE = 1.5
"""m; few vehicles have a longer one; squares of a chessboard, or centimetres, are common mistakes."""

LONGEST_BASELINE = 20.0
"""m; no vehicle has a longer one; millimetres are a common mistake."""

USUAL_VIEW_DEG = (5.0, 150.0)
"""degrees; horizontal angle of view."""


def street_defaults(rig: Rig) -> dict[str, float]:
    """Parameters for a rig on a car, by its baseline; of others the cell size follows from the resolution of pixels."""
    # 0.1 m resolves kerbs as far as the disparity does.
    return {"locus.cell_size": 0.1} if rig.baseline >= 0.3 else {}


@dataclass(frozen=True)
class Optics:
    """The cameras for a reconstruction.

    ``up`` is the stated direction of up in the left camera's frame; ``warnings`` are lines on unusual properties.
    """

    rig: Rig
    lenses: dict[str, Lens] | None
    up: Vector | None
    warnings: tuple[str, ...]


def read_optics(manifest: Manifest, root: Path, sizes: Sizes, rectified: bool = False) -> Optics:
    """Rig and lenses of a manifest.

    Parameters
    ----------
    root : folder that calibration files are relative to.
    sizes : of the images.
    rectified : whether the images are; their cameras are then those of the rectification.

    Raises
    ------
    InputError
        The cameras or their relative pose are not stated, contradict the images, or are impossible.
    """
    raw, chosen = _cameras(manifest.cameras, root, sizes)
    left, right = (_rectified(camera) if rectified else camera for camera in raw)
    # Before lengths are compared: those of the manifest are metres.
    left, right = (_scaled(camera, manifest.rig.unit) for camera in (left, right))
    above = manifest.world.up
    up = None if above is None else direction(above, left.T_camera_reference)
    pinned = None if manifest.rig.file is None else _pinned(root / manifest.rig.file)
    left, right, lines = placed(left, right, manifest.rig, pinned)
    rig, lenses = rig_of(left, right, sizes)
    if pinned is not None and (pinned.left, pinned.right) != (rig.left, rig.right):
        text = f"rig.file: {manifest.rig.file} was estimated with other cameras, or images of another size"
        raise InputError("RIL-021", text, remedy="estimate it from runs with this calibration")
    lines += check_baseline(rig.baseline, manifest.rig)
    if left.lens != raw[0].lens and manifest.images.rectified is None:
        text = "the images are rectified by their name: their camera is P, without the distortion"
        lines.append(warning("RIL-817", f"{text} (state images.rectified = false in a manifest if they are raw)"))
    return Optics(rig, lenses, up, (*chosen, *lines, *unusual_cameras((left, right), sizes)))


def _cameras(section: Cameras, root: Path, sizes: Sizes) -> tuple[tuple[CalibratedCamera, ...], tuple[str, ...]]:
    """Left and right camera, and a warning if they were chosen among several."""
    if section.left is not None and section.right is not None:
        stated = ("left", section.left, sizes[0]), ("right", section.right, sizes[1])
        return tuple(_one(value, side, root, size) for side, value, size in stated), ()
    found, chosen = tuple[CalibratedCamera, ...](), tuple[str, ...]()
    if section.file is not None:
        found, chosen = _of_file(section, root / section.file, sizes)
    elif section.stated:
        found = tuple(_one(section, side, root, sizes[0]) for side in ("left", "right"))
    if found and found[0].lens == found[1].lens and sizes[0] != sizes[1]:
        left, right = (f"{width} x {height}" for width, height in sizes)
        text = f"left images have {left} pixels, right ones {right}, and one camera is stated for both"
        raise InputError("RIL-960", text, remedy="give cameras.left and cameras.right")
    if found:
        return found, chosen
    text = "the cameras are not known"
    remedy = "give cameras.file, cameras.left and cameras.right, or cameras.fx, cx and cy (px)"
    raise InputError("RIL-235", text, remedy=remedy)


def _rectified(camera: CalibratedCamera) -> CalibratedCamera:
    """The camera of rectified images; the camera itself if it has no distortion."""
    if camera.rectified is None and not camera.lens.ideal:
        text = f"the images are taken as rectified, and the calibration of camera {camera.name} has a distortion"
        remedy = "give the calibration of the rectified images (P), or images.rectified = false if they are raw"
        raise InputError("RIL-816", f"{text}, which would be taken off twice", remedy=remedy)
    return camera.rectified or camera


def _one(value: str | PinholeLens, side: str, root: Path, size: tuple[int, int]) -> CalibratedCamera:
    """The camera of one side: from a file with one camera, or from figures."""
    if isinstance(value, str):
        found = read_cameras(root / value)
        if len(found) != 1:
            text = f"cameras.{side}: {root / value} has {len(found)} cameras"
            raise InputError("RIL-236", text, remedy="give it as cameras.file, and name the two by cameras.names")
        return found[0]
    assert value.fx is not None
    assert value.cx is not None
    assert value.cy is not None
    stated = value.width is not None or value.height is not None
    width, height = (value.width or size[0], value.height or size[1]) if stated else UNKNOWN_SIZE
    camera = Camera(value.fx, value.fy or value.fx, value.cx, value.cy, width, height)
    model = value.model or ("radtan" if value.distortion else "none")
    with within("cameras"):
        return CalibratedCamera(side, Lens(camera, model, value.distortion), None)


def _of_file(section: Cameras, path: Path, sizes: Sizes) -> tuple[tuple[CalibratedCamera, ...], tuple[str, ...]]:
    """Left and right camera of one file, and a warning if nobody has named them; a single camera is used for both."""
    read = read_cameras(path)
    if section.names is not None:
        by_name = {camera.name: camera for camera in read}
        missing = [wanted for wanted in section.names if wanted not in by_name]
        if missing:
            text = f"cameras.names: {path} has no camera {missing[0]!r}"
            raise InputError("RIL-237", text, remedy=f"it has {', '.join(by_name)}")
        return tuple(by_name[wanted] for wanted in section.names), ()
    found = of_size(read, sizes)
    if len(found) > 2:
        text = f"{path} has {len(found)} cameras: {', '.join(camera.name for camera in found)}"
        raise InputError("RIL-238", text, remedy="say which two by cameras.names = [left, right]")
    if len(found) == 1:
        # Its pose, if any, is that of one camera: the manifest has to state the other.
        return (found[0], replace(found[0], name="right", T_camera_reference=None)), ()
    if len(read) == 2:
        return tuple(found), ()
    text = f"{path} has {len(read)} cameras ({', '.join(camera.name for camera in read)}): by the size of the images"
    text += f" {found[0].name} is taken as the left and {found[1].name} as the right one; cameras.names chooses others"
    return tuple(found), (warning("RIL-719", text),)


def _scaled(camera: CalibratedCamera, unit: float) -> CalibratedCamera:
    """The camera with lengths in metres."""
    pose = camera.T_camera_reference
    if pose is None or unit == 1.0:
        return camera
    return replace(camera, T_camera_reference=RigidTransform(pose.rotation, pose.translation * unit))


def direction(stated: Vector, T_camera_reference: RigidTransform | None) -> Vector:
    """A unit direction of the reference frame in the camera's frame."""
    return stated if T_camera_reference is None else vector_of(T_camera_reference.rotation @ stated)


def placed(
    left: CalibratedCamera, right: CalibratedCamera, section: RigSection, pinned: Rig | None = None
) -> tuple[CalibratedCamera, CalibratedCamera, list[str]]:
    """Both cameras with poses in the left camera's frame, by the manifest, else by the files; and warnings."""
    of_files = relative_pose(left, right)
    stated = _stated(section, of_files) if pinned is None else pinned.T_right_left
    if stated is None and of_files is None:
        text = "the rig is not known: nothing says where the right camera stands"
        remedy = "give rig.baseline (m; parallel cameras) or rig.T_right_left, or calibration files that have it"
        raise InputError("RIL-241", text, remedy=remedy)
    chosen = stated if stated is not None else of_files
    lines = []
    if stated is not None and of_files is not None:
        ours, theirs = (float(np.linalg.norm(T.translation)) for T in (stated, of_files))
        # 0.01: largest relative difference of two stated baselines without a contradiction.
        if theirs > 0 and abs(ours - theirs) > 0.01 * theirs:
            text = f"baseline {ours:g} m of the manifest is used; the calibration file says {theirs:g} m"
            lines.append(warning("RIL-693", text))
    return replace(left, T_camera_reference=RigidTransform.identity()), replace(right, T_camera_reference=chosen), lines


def _pinned(path: Path) -> Rig:
    """The rig of a file by ``rille rig``."""
    content = read_toml(path, "rig")
    try:
        return Rig.from_dict(content["rig"])
    except (KeyError, TypeError, ValueError) as error:
        text = f"{path} is no rig ({type(error).__name__}: {error})"
        raise InputError("RIL-022", text, remedy="`rille rig RUN ... -o rig.toml` writes one") from error


def _stated(section: RigSection, of_files: RigidTransform | None) -> RigidTransform | None:
    """T_right_left of the manifest, whose baseline replaces the length of that of the files alone."""
    if section.T_right_left is not None:
        return section.T_right_left
    if section.baseline is None:
        return None
    if of_files is None or not of_files.translation.any():
        return parallel(section.baseline)
    length = float(np.linalg.norm(of_files.translation))
    return RigidTransform(of_files.rotation, of_files.translation * (section.baseline / length))


def check_baseline(baseline: float, section: RigSection) -> list[str]:
    """Refuse a length (m) that looks like one in another unit, or warn about it, unless the unit is stated."""
    from_files = section.baseline is None and section.T_right_left is None
    # 1e-3 m: cameras stand no closer, but a unit that the file states counts twice.
    if baseline < 1e-3 and from_files and section.unit < 1.0:
        text = (
            f"the baseline is {baseline:g} m by rig.unit = {section.unit:g}, and {baseline / section.unit:g} m without"
        )
        remedy = "leave rig.unit out: the calibration states its unit, or its format defines it"
        raise InputError("RIL-856", text, remedy=remedy)
    if baseline <= USUAL_BASELINE or "unit" in section.model_fields_set:
        return []
    if baseline > LONGEST_BASELINE:
        hint = "a manifest's rig.unit = 0.001 or 0.01 reads a calibration in these" if from_files else "give metres"
        text = f"the baseline is {baseline:g} m, which looks like millimetres or centimetres"
        remedy = f"did you mean {baseline / 1000:g} or {baseline / 100:g}? {hint}; rig.unit = 1 keeps it"
        raise InputError("RIL-244", text, remedy=remedy)
    doubt = "is the calibration's unit the metre, not a centimetre or a square of the chessboard?"
    remedy = "A manifest's rig.unit states its length in metres, 1 keeps it"
    return [warning("RIL-716", f"the baseline is {baseline:g} m: {doubt} {remedy}")] if from_files else []


def unusual_cameras(cameras: tuple[CalibratedCamera, CalibratedCamera], sizes: Sizes) -> tuple[str, ...]:
    """Warnings about a left and a right camera that are possible but unusual for images of these sizes."""
    lines = []
    bare = [side for side, camera in zip(("left", "right"), cameras, strict=True) if camera.lens.model == "none"]
    if len(bare) == 1 and not all(camera.lens.ideal for camera in cameras):
        text = f"of the {bare[0]} camera no distortion is stated, of the other one it is: it is taken as free of it"
        lines.append(warning("RIL-105", f"{text}; state its coefficients, or zeros if that is so"))
    for side, calibrated, (width, height) in zip(("left", "right"), cameras, sizes, strict=True):
        c = calibrated.lens.camera
        view = math.degrees(2 * math.atan(width / 2 / c.fx))
        if not USUAL_VIEW_DEG[0] <= view <= USUAL_VIEW_DEG[1]:
            text = f"{side} camera: fx = {c.fx:g} px gives an angle of view of {view:.3g} degrees; is it in pixels?"
            lines.append(warning("RIL-690", text))
        off = max(abs(c.cx - width / 2), abs(c.cy - height / 2)) / width
        # 0.04: limit for a calibration without a size, since cropped images show by nothing else.
        if off > (0.04 if calibrated.size is None else MAX_OFF_CENTRE):
            place = f"({c.cx:g}, {c.cy:g}) px is {100 * off:.3g} % of the width off the centre of {width} x {height}"
            line = f"{side} camera: principal point {place} images: were they cut or scaled?"
            lines.append(warning("RIL-689", line))
        if not 0.8 < c.fx / c.fy < 1.25:
            text = f"{side} camera: fx = {c.fx:g} and fy = {c.fy:g} px differ much: no square pixels"
            lines.append(warning("RIL-691", text))
    return tuple(lines)
