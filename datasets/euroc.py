"""Visual-inertial recordings in the layout of EuRoC (Burri et al. 2016, doi:10.1177/0278364915620033).

``mav0/`` holds a folder for each sensor: ``cam0`` (left) and ``cam1`` (right) with ``sensor.yaml``, perhaps
``data.csv`` (time stamp, file name), and ``data/``, whose files are named by their time stamps; perhaps ``imu0``, and
truth. ``T_BS`` in each ``sensor.yaml`` is the pose of its sensor in the body. The folder is opened by a manifest
(:mod:`rille.datasets.manifest`).

Truth serves for comparison alone. The IMU gives the rotation between frames and, while the body rests or moves
unaccelerated, the vertical; both are optional start values.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rille.datasets.cameras import read_cameras
from rille.datasets.cameras.fields import Fields
from rille.datasets.images.files import Digests
from rille.datasets.manifest.model import Cameras, Images, Imu, Manifest, Times, Truth
from rille.datasets.manifest.opening import open_folder
from rille.datasets.protocol import Sequence
from rille.datasets.text.names import derived_name
from rille.datasets.text.order import stamp_of
from rille.stages.core.errors import InputError, warning
from rille.stages.geometry.geometry import RigidTransform

OF_BODY = ("state_groundtruth_estimate0", "gt", "mocap0")
"""Folders of true poses, the best first, which are the body's if no ``T_BS`` is stated."""

TRUTH = (*OF_BODY, "vicon0", "leica0")
"""All folders of true poses (the last: positions), the best first."""

IMU = "imu0"
"""Folder of the IMU."""

FORMS = (("FOLDER", "EuRoC: mav0/cam0, mav0/cam1, each with sensor.yaml and data; imu0, state_groundtruth_estimate0"),)


def open_layout(path: Path, number: str | None, digests: Digests) -> Sequence | None:
    """The sequence of a folder (that of ``mav0``, or ``mav0`` itself); None if it has another layout.

    Raises
    ------
    InputError
        The files cannot be used.
    """
    path = path.resolve()
    folder = path / "mav0" if (path / "mav0").is_dir() else path
    if number is not None or not all((folder / name / "data").is_dir() for name in ("cam0", "cam1")):
        return None
    for place in (folder / name / "sensor.yaml" for name in ("cam0", "cam1")):
        if not place.is_file():
            remedy = "put it there (T_BS, resolution, intrinsics, distortion), or write a manifest: `rille init`"
            raise InputError("RIL-161", f"{place} is missing: {place.parent.name} has no calibration", remedy=remedy)
    truth, imu, warnings = sensors(folder)
    listed = (folder / "cam0" / "data.csv").is_file()
    stamped = all(stamp_of(image.stem) for image in (folder / "cam0" / "data").iterdir())
    # Baselines are short, in rooms and halls: 3 m away, 0.2 px of disparity are 4 cm of depth with 0.11 m, so that
    # finer cells stay empty. There is no vehicle, nor a rule for the choice of pairs, for all of them.
    manifest = Manifest(
        name=derived_name(folder.parent.name if folder.name == "mav0" else folder.name),
        images=Images(left="cam0/data/*", right="cam1/data/*", pair="nearest" if stamped else "auto"),
        cameras=Cameras(left="cam0/sensor.yaml", right="cam1/sensor.yaml"),
        times=Times(file="cam0/data.csv") if listed else Times(names=True),
        truth=truth,
        imu=imu,
        defaults={"locus.cell_size": 0.05},
    )
    sequence = open_folder(manifest, folder, digests, [folder / name for name in (*TRUTH, IMU)])
    return replace(sequence, warnings=(*sequence.warnings, *warnings))


def sensors(folder: Path) -> tuple[Truth | None, Imu | None, list[str]]:
    """Truth and IMU with the left camera's pose in their frames, and warnings about those of unknown pose."""
    left = read_cameras(folder / "cam0" / "sensor.yaml")[0]
    if left.T_camera_reference is None:
        text = f"{folder / 'cam0'} does not say where the camera stands in the body (T_BS): truth and IMU are not used"
        return None, None, [warning("RIL-682", text)]
    T_body_left, truth, imu, warnings = left.T_camera_reference.inverse(), None, None, []
    recorded = [name for name in (*TRUTH, IMU) if (folder / name / "data.csv").is_file()]
    best = next((name for name in recorded if name in TRUTH), None)
    for name in (name for name in recorded if name in (best, IMU)):
        T_body_sensor = body_pose(folder / name) or (RigidTransform.identity() if name in OF_BODY else None)
        if T_body_sensor is None:
            text = f"{folder / name} does not say how it stands in the body (T_BS): it is not used"
            warnings.append(warning("RIL-683", text))
            continue
        file, pose = f"{name}/data.csv", T_body_sensor.inverse() @ T_body_left
        if name == IMU:
            imu = Imu(file=file, T_imu_left=pose)
        else:
            # 0.15 s: longest gap over which truth is interpolated; at 5 m/s^2 a straight line errs by at most 1.4 cm.
            source = f"{name}, interpolated to the images' times"
            truth = Truth(file=file, T_body_left=pose, max_gap=0.15, source=source)
    return truth, imu, warnings


def body_pose(folder: Path) -> RigidTransform | None:
    """``T_BS`` of a sensor: its pose in the body; None if its folder does not state it."""
    path = folder / "sensor.yaml"
    fields = Fields.read(path) if path.is_file() else Fields({}, str(path))
    return fields.pose("T_BS") if "T_BS" in fields else None
