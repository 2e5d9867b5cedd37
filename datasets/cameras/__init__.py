"""Read calibration files of other programs: intrinsics, lens and pose of each camera; the content tells the format."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from yaml import YAMLError

from rille.datasets.cameras import boofcv, colmap, kitti, makers, opencv, pds, slam, tsai
from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import UNKNOWN_SIZE, CalibratedCamera
from rille.datasets.cameras.pair import rig_of
from rille.datasets.cameras.text import parse_nested
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.reading import read_text, refuse_decimal_commas
from rille.datasets.text.sides import side_of
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import RigidTransform

__all__ = ["UNKNOWN_SIZE", "CalibratedCamera", "read_cameras", "rig_of"]

KNOWN = (
    "OpenCV (YAML, XML; Metashape exports it, too), ROS camera_info and ost.txt, Kalibr's camchain, EuRoC sensor.yaml, "
    "OKVIS, SVO, ORB-SLAM, stella_vslam, camodocal, VINS, Basalt, mrcal, DSO, MRPT, DSEC, BoofCV, ZED .conf, DepthAI, "
    "RealSense (rs-enumerate-devices -c), COLMAP, Middlebury calib.txt, KITTI, K.txt, ASP .tsai, PDS3 or VICAR labels "
    "and .cahvor (CAHV, CAHVOR, CAHVORE) are read; of another program write fx, fy, cx, cy and baseline (m), or K1, "
    "D1, K2, D2, R and T (metres; MATLAB's K and R transposed), as OpenCV's YAML; of a simulator fx = fy = width / 2 / "
    "tan(horizontal angle of view / 2)"
)

Text: TypeAlias = Callable[[str], bool]


def states(entry: str) -> Text:
    """Whether a line of a text begins with ``entry``, a pattern."""
    return lambda text: re.search(rf"^[ \t]*{entry}", text, re.MULTILINE) is not None


OTHERS = (
    (
        "^Calibration results",
        "is Kalibr's report",
        "give camchain.yaml (or NAME-camchain.yaml), which stands beside it",
    ),
    ('"disto"', "is of ZED's SDK", "give SN...conf; for rectified images fx, fy, cx, cy and baseline (m)"),
    (
        '"(CameraParameters1|TranslationOfCamera2)"',
        "holds MATLAB's stereoParams",
        "write K1, D1, K2, D2, R and T (m) of [K1, D1, K2, D2, R, T] = stereoParametersToOpenCV(stereoParams)",
    ),
    ("Camera[.]fxl", "holds OV2SLAM's settings", "write M1, D1 (k1 k2 p1 p2), M2, D2, R, T (m), as OpenCV does"),
    ('"SettingsVersion"', "is AirSim's", "write fx = fy = Width / 2 / tan(FOV_Degrees / 2), cx, cy and baseline (m)"),
    ('"camera_data_"', "is Argoverse's", "write fx, fy, cx, cy of stereo_front_left and baseline (m) of both"),
)
"""Files that are not read: a pattern, what they are, and what to give in their place."""

PLAIN: tuple[tuple[Text, Callable[[str, Path], list[CalibratedCamera]]], ...] = (
    (pds.is_label, pds.label),
    (states(r"fu[ \t]*="), tsai.tsai),
    (states(r"cam0[ \t]*=[ \t]*\["), makers.middlebury),
    (colmap.is_colmap, colmap.colmap),
    (kitti.is_kitti, kitti.kitti),
    (lambda text: "[LEFT_CAM_" in text, makers.zed),
    (lambda text: f"{makers.MRPT_POSE}]" in text, makers.mrpt),
    (lambda text: slam.DSO.search(text) is not None, slam.dso),
    (states(r"'lensmodel'"), slam.mrcal),
    (lambda text: makers.LISTED.search(text) is not None, makers.realsense),
    (lambda text: "[image]" in text and states(r"camera matrix[ \t]*$")(text), opencv.ost),
    (lambda text: bool(makers.numbers_of_matrix(text)), makers.matrix),
)
"""Text formats: test and reader of each."""

NESTED: tuple[tuple[Callable[[Fields], bool], Callable[[Fields, Path], list[CalibratedCamera]]], ...] = (
    (lambda f: bool(opencv.sides(f)), opencv.stereo),
    (lambda f: f.with_parts({"Camera": "Camera."}).has("Camera.fx", "Camera1.fx"), slam.orbslam),
    (lambda f: isinstance(f.values.get("cameras"), list), slam.camera_list),
    (lambda f: bool(slam.chain(f)), slam.kalibr),
    (lambda f: "intrinsics" in f and f.has("T_BS", "distortion_coefficients"), slam.sensor),
    (lambda f: "model_type" in f, slam.camodocal),
    (lambda f: "cam0_calib" in f, slam.vins),
    (lambda f: "cameraData" in f, makers.depthai),
    (lambda f: "pinhole" in f or ("rightToLeft" in f and "left" in f), boofcv.boofcv),
    (opencv.is_message, opencv.message),
    (lambda f: f.has(*opencv.SINGLE), opencv.single),
    (opencv.projections_alone, opencv.projections),
    (lambda f: f.values.keys() == {"Q"}, opencv.reprojection),
    (lambda f: bool(opencv.sides(opencv.by_side(f))), opencv.stereo_by_side),
    (lambda f: "value0" in f, slam.basalt),
    (lambda f: "intrinsics" in f and "camRect0" in f.sub("intrinsics"), slam.dsec),
    (makers.has_figures, makers.figures),
)
"""Formats of nested entries. ORB-SLAM2 files with unrectified cameras are read as OpenCV's, as their images are
unrectified."""


def read_cameras(path: Path) -> list[CalibratedCamera]:
    """Cameras of a calibration file, whose format is detected by its content.

    Returns
    -------
    In the order of the file; of a stereo calibration ``left`` and ``right``.

    Raises
    ------
    InputError
        The file cannot be read or holds no camera, or an entry (named in the message) is missing or wrong.
    """
    # Of an image with a label in front only the label is read.
    text = pds.attached(path) or read_text(path, "calibration")
    try:
        return _read(text, path)
    except InputError as error:
        refuse_decimal_commas(text.splitlines(), path, error)
        raise


def _read(text: str, path: Path) -> list[CalibratedCamera]:
    for pattern, what, remedy in OTHERS:
        if re.search(pattern, text, re.MULTILINE):
            raise InputError("RIL-727", f"{path} {what}: this is not read", remedy=remedy)
    # Before YAML, to which KITTI's `P0: 7.1 0 ...` is an entry of one word.
    plain = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    for recognises, read in PLAIN:
        if recognises(plain):
            return read(plain, path)
    try:
        fields = Fields(parse_nested(text, str(path)), str(path))
    except InputError as error:
        # Only of a file that should be YAML a parser's words help.
        if not isinstance(error.__cause__, YAMLError) or path.suffix.lower() in (".yaml", ".yml", ".json"):
            raise
        fields = Fields({}, str(path))
    parts = [key for key, value in fields.values.items() if isinstance(value, dict)]
    # All of it may stand in one part, as in {"calibration": {...}, "date": ...}.
    for whole in (fields, fields.with_parts({parts[0]: ""})) if len(parts) == 1 else (fields,):
        if found := _nested(whole, path):
            return found
    raise InputError("RIL-100", f"{path} holds no camera that is known", remedy=KNOWN)


def _nested(fields: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of nested entries; empty if these are of no known format."""
    for knows, read_fields in NESTED:
        if knows(fields) and (found := read_fields(fields, path)):
            fields.check_lens()
            if any(camera.T_camera_reference is None for camera in found):
                fields.check_turn()
                found = _parallel(found, fields, path)
            return found
    return []


def _parallel(found: list[CalibratedCamera], fields: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras without a pose that a ``baseline`` in their file makes a rig; as they are if there is none."""
    T_right_left = makers.beside(fields)
    # A file of one side may state it, too.
    if T_right_left is None or len(found) > 2 or side_of(f"{path.parent.name}/{path.stem}") is not None:
        return found
    poses = RigidTransform.identity(), T_right_left
    sides = zip(CAMERAS, (found[0], found[-1]), poses, strict=True)
    return [replace(camera, name=name, T_camera_reference=T) for name, camera, T in sides]
