"""Visual-inertial recordings in the layout of EuRoC (Burri et al. 2016, doi:10.1177/0278364915620033).

``mav0/`` holds a folder a sensor: ``cam0`` (left) and ``cam1`` (right) with ``sensor.yaml``, ``data.csv`` (time stamp,
file name) and ``data/``; perhaps ``imu0``, and truth. Each ``sensor.yaml`` says by ``T_BS`` how its sensor stands in
the body. Images are raw: a rig with ideal cameras is given together with the real lenses.

Truth is only assessed. The IMU gives the rotation between frames and, where the body rests or moves unaccelerated, the
vertical; both start values that a reconstruction can do without, so that a recording without it is fine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rille.datasets.cameras import CalibratedCamera, read_cameras, rig_of
from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.text import parse_yaml
from rille.datasets.images import files
from rille.datasets.images.headers import sizes_of
from rille.datasets.images.pairing import ImagePair, common_headers
from rille.datasets.imu import Inertial, at_frames, read_imu
from rille.datasets.manifest.rig import unusual_cameras
from rille.datasets.poses import coverage, interpolate, read_poses
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.datasets.text.names import derived_name
from rille.datasets.text.reading import read_text
from rille.datasets.text.tables import read_table
from rille.datasets.text.times import seconds
from rille.datasets.text.warning import warning
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import RigidTransform

FOLDERS = {"left": "cam0", "right": "cam1"}

TRUTH: Mapping[str, bool] = {"state_groundtruth_estimate0": True, "gt": True, "mocap0": True, "vicon0": False}
"""Folders of true poses, the best first, and whether they are those of the body where no ``T_BS`` is stated."""

TRUTH_GAP = 0.15
"""s; truth is interpolated over no longer gap: at 5 m/s^2 the straight line is then 1.4 cm off at most."""


ROOM = {"locus.cell_size": 0.05}
"""Drones and hands carry short baselines through rooms and halls: 3 m away, 0.2 px of disparity are 4 cm of depth at
0.11 m, so that finer cells stay empty. No vehicle, and no rule for the choice of pairs, suits them all."""


FORMS = (("FOLDER", "EuRoC: mav0/cam0, mav0/cam1, each with sensor.yaml and data; imu0, state_groundtruth_estimate0"),)
"""What a user may give."""


@dataclass(frozen=True)
class EurocLayout:
    """Where the parts of a recording lie; ``truth`` is a folder with ``data.csv``, ``imu`` likewise."""

    name: str
    folder: Path
    truth: Path | None
    imu: Path | None


@dataclass(frozen=True)
class Frames:
    """The pairs of a recording: files, times in seconds, and what was left out, one line each."""

    pairs: tuple[ImagePair, ...]
    times: tuple[float, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Movement:
    """What is known of the movement, one entry a frame."""

    truth: tuple[RigidTransform | None, ...] | None = None
    truth_source: str = ""
    inertial: Inertial = field(default_factory=Inertial)
    warnings: tuple[str, ...] = ()


def recognise(path: Path) -> EurocLayout | None:
    """Layout of a folder (that of ``mav0``, or ``mav0`` itself), or None where it is not of this kind."""
    path = path.resolve()
    folder = path / "mav0" if (path / "mav0").is_dir() else path
    if not all((folder / name / "data").is_dir() for name in FOLDERS.values()):
        return None
    truth = next((folder / name for name in TRUTH if (folder / name / "data.csv").is_file()), None)
    imu = folder / "imu0"
    name = folder.parent.name if folder.name == "mav0" else folder.name
    return EurocLayout(derived_name(name), folder, truth, imu if (imu / "data.csv").is_file() else None)


def open_layout(path: Path, number: str | None, digests: files.Digests) -> Sequence | None:
    """The sequence of a folder, or None where it has not this layout.

    Raises
    ------
    InputError
        What is there cannot be used.
    """
    layout = recognise(path) if number is None else None
    return None if layout is None else open_euroc(layout, digests)


def open_euroc(layout: EurocLayout, digests: files.Digests) -> Sequence:
    """The sequence in a folder.

    Raises
    ------
    InputError
        Cameras have no calibration, no image of one has a partner of the same time, a table does not parse, or truth
        or IMU have no time in common with the images.
    """
    frames = list_frames(layout)
    headers = common_headers(frames.pairs)
    cameras = {camera: _camera(layout.folder / name) for camera, name in FOLDERS.items()}
    rig, lenses = rig_of(cameras["left"], cameras["right"], sizes_of(headers))
    known = _movement(layout, frames.times, cameras["left"])

    def image(frame: int, camera: str) -> Source:
        pair = frames.pairs[frame]
        path, header = (pair.left, headers[0]) if camera == "left" else (pair.right, headers[1])
        return files.image_source(path, frame, camera, header, digests)

    inertial = known.inertial
    return Sequence(
        name=layout.name,
        rig=rig,
        frames=len(frames.pairs),
        image=image,
        frame_names=tuple(pair.name for pair in frames.pairs),
        lenses=lenses,
        times=frames.times,
        truth=known.truth,
        truth_source=known.truth_source,
        up=inertial.up if any(inertial.up) else None,
        attitude=inertial.attitude if any(inertial.attitude) else None,
        imu_axes=inertial.axes,
        defaults=ROOM,
        notes=inertial.notes,
        warnings=(*frames.warnings, *unusual_cameras(cameras.values(), sizes_of(headers)), *known.warnings),
    )


# -- images ------------------------------------------------------------------------------------------------------------


def list_frames(layout: EurocLayout) -> Frames:
    """Pairs of images that both cameras took at one time, in order.

    Raises
    ------
    InputError
        There is no such pair, or a list of images does not parse or is not in order of time.
    """
    warnings: list[str] = []
    taken = {camera: _images(layout.folder / FOLDERS[camera], warnings) for camera in CAMERAS}
    common = [stamp for stamp in taken["left"] if stamp in taken["right"]]
    left_out = [len(taken[camera]) - len(common) for camera in CAMERAS]
    if not common:
        raise InputError(
            "RIL-156",
            f"{layout.folder}: no time stamp of {len(taken['left'])} images in cam0 is also one of "
            f"{len(taken['right'])} in cam1",
            remedy="give both cameras of one recording, or a manifest: `rille init` pairs the nearest stamps",
        )
    if any(left_out):
        apart = f"{left_out[0]} of cam0, {left_out[1]} of cam1"
        warnings.append(warning("RIL-680", f"images without a partner of the same time are left out: {apart}"))
    pairs = tuple(ImagePair(taken["left"][s][0].stem, taken["left"][s][0], taken["right"][s][0]) for s in common)
    lines = [taken["left"][s][1] for s in common]
    times, more = seconds(common, str(layout.folder / "cam0" / "data.csv"), lines=lines)
    return Frames(pairs, times, (*warnings, *more))


def _images(folder: Path, warnings: list[str]) -> dict[str, tuple[Path, int]]:
    """File and line of each image by its time stamp as written; by file names where there is no list."""
    there = {path.name: path for path in sorted((folder / "data").iterdir()) if path.suffix.lower() in files.SUFFIXES}
    if not there:
        raise InputError(
            "RIL-157", f"{folder / 'data'} holds no images", remedy=f"put files there: {', '.join(files.SUFFIXES)}"
        )
    listed = folder / "data.csv"
    if not listed.is_file():
        # Stamps are numbers without leading zeros: fewer digits come first.
        names = sorted(there, key=lambda name: (len(Path(name).stem), name))
        return {Path(name).stem: (there[name], k) for k, name in enumerate(names, start=1)}
    table = read_table(listed, "list of images")
    if table.columns < 2:
        raise InputError("RIL-158", f"{listed} has no file names", remedy="give a time stamp and a file name a line")
    out: dict[str, tuple[Path, int]] = {}
    for row, line in zip(table.rows, table.lines, strict=True):
        if row[1] not in there:
            continue
        if row[0] in out:
            raise InputError(
                "RIL-159", f"{listed}, line {line}: time {row[0]} is there twice", remedy="remove one of the lines"
            )
        out[row[0]] = (there[row[1]], line)
    lost = len(table.rows) - len(out)
    if not out:
        raise InputError(
            "RIL-160", f"none of the {lost} images that {listed} lists is there", remedy=f"check {folder / 'data'}"
        )
    if lost:
        warnings.append(
            warning("RIL-681", f"{lost} of {len(table.rows)} images that {listed} lists are not there: left out")
        )
    return out


def _camera(folder: Path) -> CalibratedCamera:
    path = folder / "sensor.yaml"
    if not path.is_file():
        raise InputError(
            "RIL-161",
            f"{path} is missing: {folder.name} has no calibration",
            remedy="put it there (T_BS, resolution, intrinsics, distortion), or name another calibration in a manifest",
        )
    camera, *others = read_cameras(path)
    if others:
        raise InputError(
            "RIL-162", f"{path} describes {len(others) + 1} cameras", remedy="give each camera its own sensor.yaml"
        )
    return camera


# -- movement ----------------------------------------------------------------------------------------------------------


def body_pose(folder: Path) -> RigidTransform | None:
    """``T_BS`` of a sensor: its pose in the body; None where its folder does not say."""
    path = folder / "sensor.yaml"
    if not path.is_file():
        return None
    fields = Fields(parse_yaml(read_text(path, "calibration"), str(path)), str(path))
    return fields.pose("T_BS") if "T_BS" in fields else None


def _movement(layout: EurocLayout, times: tuple[float, ...], left: CalibratedCamera) -> Movement:
    """Truth and IMU, brought to the left camera by the sensors' places in the body."""
    if left.T_camera_reference is None:
        path = layout.folder / "cam0" / "sensor.yaml"
        text = f"{path} does not say where the camera stands in the body (T_BS): truth and IMU are not used"
        return Movement(warnings=(warning("RIL-682", text),))
    T_body_left = left.T_camera_reference.inverse()
    warnings: list[str] = []
    truth, source = _truth(layout, times, T_body_left, warnings)
    inertial = Inertial()
    if layout.imu is not None:
        T_body_imu = body_pose(layout.imu)
        if T_body_imu is None:
            text = f"{layout.imu} does not say how the IMU stands in the body (T_BS): it is not used"
            warnings.append(warning("RIL-683", text))
        else:
            imu = read_imu(layout.imu / "data.csv")
            inertial = at_frames(imu, times, T_body_imu.inverse() @ T_body_left)
            warnings += [*imu.warnings, *inertial.warnings]
    return Movement(truth, source, inertial, tuple(warnings))


def _truth(
    layout: EurocLayout, times: tuple[float, ...], T_body_left: RigidTransform, warnings: list[str]
) -> tuple[tuple[RigidTransform | None, ...] | None, str]:
    """T_truth_left of each frame, and what it is."""
    if layout.truth is None:
        if (layout.folder / "leica0").is_dir():
            text = "leica0 tracks a point without its rotation: it is not used as truth"
            warnings.append(warning("RIL-684", text))
        return None, ""
    folder = layout.truth
    T_body_marker = body_pose(folder)
    if T_body_marker is None and not TRUTH[folder.name]:
        text = f"{folder} does not say how its markers stand in the body (T_BS): it is not used as truth"
        warnings.append(warning("RIL-685", text))
        return None, ""
    T_marker_left = T_body_left if T_body_marker is None else T_body_marker.inverse() @ T_body_left
    timed = read_poses(folder / "data.csv", "auto")
    found = interpolate(timed, times, TRUTH_GAP)
    warnings += [*timed.warnings, *coverage(found, times, f"truth in {folder.name}")]
    truth = tuple(None if pose is None else pose @ T_marker_left for pose in found)
    return truth, f"{folder.name}, interpolated to the images' times"
