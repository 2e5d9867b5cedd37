"""Read calibration files of other programs: intrinsics, lens and pose of each camera. The content tells the format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rille.datasets.cameras import boofcv, colmap, kitti, makers, middlebury, opencv, pds, slam, tsai
from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import UNKNOWN_SIZE, CalibratedCamera
from rille.datasets.cameras.pair import rig_of
from rille.datasets.cameras.text import parse_nested
from rille.datasets.text.reading import read_text, refuse_decimal_commas
from rille.stages.core.errors import InputError

__all__ = ["UNKNOWN_SIZE", "CalibratedCamera", "read_cameras", "rig_of"]

KNOWN = (
    "OpenCV (YAML, XML), ROS camera_info, Kalibr, EuRoC sensor.yaml, ORB-SLAM, camodocal and VINS, BoofCV, "
    "ZED .conf, DepthAI, COLMAP, Middlebury calib.txt, KITTI, K.txt, ASP .tsai and PDS3 or VICAR labels (CAHV, CAHVOR, "
    "CAHVORE) are read"
)

PLAIN: tuple[tuple[Callable[[str], bool], Callable[[str, Path], list[CalibratedCamera]]], ...] = (
    (pds.is_label, pds.label),
    (tsai.is_tsai, tsai.tsai),
    (middlebury.is_middlebury, middlebury.middlebury),
    (colmap.is_colmap, colmap.colmap),
    (kitti.is_kitti, kitti.kitti),
    (makers.is_zed, makers.zed),
    (makers.is_matrix, makers.matrix),
)
"""Text formats: how each is recognised, and its reader."""

NESTED: tuple[tuple[Callable[[Fields], bool], Callable[[Fields, Path], list[CalibratedCamera]]], ...] = (
    (opencv.is_stereo, opencv.stereo),
    (slam.is_orbslam, slam.orbslam),
    (slam.is_kalibr, slam.kalibr),
    (slam.is_sensor, slam.sensor),
    (slam.is_camodocal, slam.camodocal),
    (slam.is_vins, slam.vins),
    (makers.is_depthai, makers.depthai),
    (boofcv.is_boofcv, boofcv.boofcv),
    (opencv.is_message, opencv.message),
    (opencv.is_single, opencv.single),
)
"""Formats of nested entries. ORB-SLAM2 files that also hold unrectified cameras are read as those: the images are."""


def read_cameras(path: Path) -> list[CalibratedCamera]:
    """Cameras of a calibration file, whatever program wrote it: it is recognised by its content.

    Returns
    -------
    In the order of the file; of a stereo calibration ``left`` and ``right``.

    Raises
    ------
    InputError
        The file cannot be read or holds no camera, or an entry is missing or wrong; then the line names the key.
    """
    # An image with its label in front is too large for a calibration and no text: of it, the label alone is read.
    text = pds.attached(path) or read_text(path, "calibration")
    try:
        return _read(text, path)
    except InputError as error:
        refuse_decimal_commas(text.splitlines(), path, error)
        raise


def _read(text: str, path: Path) -> list[CalibratedCamera]:
    # Before YAML, for which KITTI's `P0: 7.1 0 ...` is an entry, too: one word where twelve numbers belong.
    for recognises, read in PLAIN:
        if recognises(text):
            return read(text, path)
    fields = Fields(parse_nested(text, str(path)), str(path))
    for knows, read_fields in NESTED:
        if knows(fields):
            found = read_fields(fields, path)
            fields.check_lens()
            return found
    raise InputError("RIL-100", f"{path} holds no camera that is known", remedy=KNOWN)
