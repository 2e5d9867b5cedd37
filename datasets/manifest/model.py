"""What a manifest may say: one model a table, strictly read, so that a misspelt key is named with its neighbour."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, PlainValidator, Tag, model_validator

from rille.datasets.georeference import Georeference, are_degrees, metric_crs, scale_at
from rille.datasets.protocol import Vector
from rille.datasets.text.reading import read_toml
from rille.datasets.text.validation import TAG, validated
from rille.stages.core.declare import Params
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.hazard.vehicle import Vehicle


def _pose(value: Any) -> RigidTransform:
    """A pose, which may be a 3 x 4 or 4 x 4 matrix, flat or in rows."""
    if isinstance(value, RigidTransform):
        return value
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.size not in (12, 16):
        raise ValueError("give rows of [R | t], 3 x 4 numbers")
    return RigidTransform.from_matrix(matrix)


Pose = Annotated[RigidTransform, PlainValidator(_pose)]


def _direction(value: Vector) -> Vector:
    """A unit vector."""
    length = math.hypot(*value)
    if not length > 0:
        raise ValueError("it has no direction: give e.g. [0, 0, 1] where z is up")
    return value[0] / length, value[1] / length, value[2] / length


Direction = Annotated[Vector, AfterValidator(_direction)]
PoseFormat = Literal["auto", "kitti", "tum", "euroc", "csv", "colmap"]
Columns = dict[Literal["time", "x", "y", "z"], str | int]
Deviation = Annotated[float, Field(ge=1e-6)]
"""A standard deviation: no sensor is as good, and 1e-300 would make every equation singular."""
TimeUnit = Literal["auto", "s", "ms", "us", "ns"]


class Table(Params):
    """A table of the manifest, whose keys are its attributes."""


class Images(Table):
    """``[images]``: which files are the pairs.

    Attributes
    ----------
    left : folder of the left images below the root, or their pattern, e.g. left/*.png; ** is any folder; or BAG, or
        BAG:TOPIC.
    right : that of the right images, or the same bag.
    pair : how images are paired: by name (left/right aside), by that of their folder, by the last number in the name,
        by the nearest time stamp in it, or by order; auto: by folder where each frame has its own, by name, by time
        stamps where these differ, else by number.
    tolerance : s; time between the images of a pair at most, by the stamps in their names; by default a quarter of the
        usual interval, at most 0.01.
    rectified : whether the images are rectified; by default they are where a word of their folders' or files' names
        begins with rect.
    """

    left: str
    right: str
    pair: Literal["auto", "name", "folder", "number", "nearest", "order"] = "auto"
    tolerance: float | None = Field(default=None, gt=0)
    rectified: bool | None = None


class PinholeLens(Table):
    """One camera stated in the manifest.

    Attributes
    ----------
    fx : px, focal length in columns.
    fy : px, focal length in rows; that in columns where it is not given.
    cx : px, column of the principal point; centre of the first pixel is 0.
    cy : px, row of the principal point.
    width : px, of the images that were calibrated; those given by default.
    height : px, of the images that were calibrated.
    model : distortion model; radtan where there are coefficients.
    distortion : coefficients in OpenCV's order, e.g. k1 k2 p1 p2 [k3].
    """

    fx: float | None = Field(default=None, gt=0)
    fy: float | None = Field(default=None, gt=0)
    cx: float | None = None
    cy: float | None = None
    width: int | None = Field(default=None, ge=1)
    height: int | None = Field(default=None, ge=1)
    model: Literal["none", "radtan", "rational", "fisheye"] | None = None
    distortion: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> PinholeLens:
        given = [name for name in PinholeLens.model_fields if getattr(self, name) not in (None, ())]
        missing = [name for name in ("fx", "cx", "cy") if getattr(self, name) is None]
        if given and missing:
            raise ValueError(f"{', '.join(missing)} is missing (px); {', '.join(given)} alone make no camera")
        return self

    @property
    def stated(self) -> bool:
        """Whether there is a camera at all."""
        return self.fx is not None


def _kind(value: Any) -> str:
    return FILE if isinstance(value, str) else FIGURES


FILE, FIGURES = f"{TAG}file)", f"{TAG}figures)"
OneCamera = Annotated[Annotated[str, Tag(FILE)] | Annotated[PinholeLens, Tag(FIGURES)], Discriminator(_kind)]


class Cameras(PinholeLens):
    """``[cameras]``: one file, a file or a table each, or figures that hold for both cameras.

    Attributes
    ----------
    file : calibration file of both cameras.
    left : calibration file of the left camera, or its figures.
    right : calibration file of the right camera, or its figures.
    names : names of the left and the right camera within the file, where it has more or other ones.
    """

    file: str | None = None
    left: OneCamera | None = None
    right: OneCamera | None = None
    names: tuple[str, str] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Cameras:
        forms = [self.stated, self.file is not None, self.left is not None or self.right is not None]
        if sum(forms) > 1:
            raise ValueError("give fx, fy ... for both, or file, or left and right; not several of them")
        if (self.left is None) != (self.right is None):
            raise ValueError(f"{'right' if self.right is None else 'left'} is missing")
        for one in (self.left, self.right):
            if isinstance(one, PinholeLens) and not one.stated:
                raise ValueError("left and right need fx, cx and cy (px), or a file each")
        return self


class RigSection(Table):
    """``[rig]``: where the right camera stands, unless the calibration files say it.

    Attributes
    ----------
    baseline : m; distance of the cameras. Beside calibration files that say how the cameras stand to each other it
        replaces the distance alone; otherwise the right camera stands that far along the left one's x axis.
    T_right_left : rows of [R | t], m: x_right = R x_left + t.
    file : rig that `rille rig` has estimated; its relative orientation is used as it is, with rig.mode fixed.
    unit : m; length of one unit of the calibration files, 0.001 where they say mm; 1 lets a baseline exceed 20 m.
    """

    baseline: float | None = None
    T_right_left: Pose | None = None
    file: str | None = None
    unit: float = Field(default=1.0, gt=0)

    @model_validator(mode="after")
    def _one_baseline(self) -> RigSection:
        stated = [name for name in ("baseline", "T_right_left", "file") if getattr(self, name) is not None]
        if len(stated) > 1:
            raise ValueError(f"{' and '.join(stated)} both state the baseline: remove one of them")
        if self.baseline is not None and self.baseline <= 0:
            swapped = "where the right camera stands to the left, exchange images.left and images.right"
            raise ValueError(f"baseline = {self.baseline:g} m is not positive: give the distance; {swapped}")
        return self


class DisparityMaps(Table):
    """``[truth_disparity]``: true disparities of the left images, only to judge the matcher's.

    Attributes
    ----------
    left : pattern of the maps, one a pair, named or numbered as the left images are: .pfm, .tif or .npy of floating
        point (px; 0, infinite or NaN: unknown), 16-bit .png (256 a pixel, 0 unknown), or other integers.
    scale : values for a pixel; by default by the kind of file (1, 256), none of other integers.
    sign : left-right: values are the column in the left image minus that in the right one, the usual; right-left: the
        reverse.
    """

    left: str
    scale: float | None = Field(default=None, gt=0, le=1e6)
    sign: Literal["left-right", "right-left"] = "left-right"


class Disparity(DisparityMaps):
    """``[disparity]``: maps that another program made of the left images, in the place of the matcher's.

    Attributes
    ----------
    sigma : px; standard deviation of all values, or pattern of maps of it; estimated by default.
    """

    sigma: Annotated[float, Field(gt=0)] | str | None = None


class Masks(Table):
    """``[masks]``: parts of the images that never show the scene, such as the vehicle's own body.

    Attributes
    ----------
    left : grey image of the left camera's size, as it takes them: bright where a pixel is used, dark where it is not.
    right : the same of the right camera.
    """

    left: str | None = None
    right: str | None = None


class Times(Table):
    """``[times]``: when the pairs were taken.

    Attributes
    ----------
    file : one time a line for each pair, or a table of time and file name.
    names : the left images' names are time stamps.
    rate_hz : 1/s; pairs at a constant rate.
    unit : unit of file or names; auto: by magnitude.
    """

    file: str | None = None
    names: bool = False
    rate_hz: float | None = Field(default=None, ge=1e-6, le=1e6)
    unit: TimeUnit = "auto"

    @model_validator(mode="after")
    def _one_source(self) -> Times:
        if [self.file is not None, self.names, self.rate_hz is not None].count(True) != 1:
            raise ValueError("give one of file, names = true or rate_hz")
        return self


class Recorded(Table):
    """Base of what a sensor or another program has written down.

    Attributes
    ----------
    file : table of it.
    time_offset : s; added to the file's times so that they are those of the images.
    """

    file: str
    time_offset: float = 0.0


class Poses(Recorded):
    """Base of poses of the left camera or of a body that carries it.

    Attributes
    ----------
    file : poses, one a pair, or with times.
    format : kitti 3 x 4 (perhaps behind a time), tum, euroc, csv, or colmap (images.txt, by the names of the left
        images).
    T_body_left : rows of [R | t], m: from the left camera's frame to the body's whose poses the file has.
    max_gap : s; poses are interpolated over no longer gap.
    """

    format: PoseFormat = "auto"
    T_body_left: Pose | None = None
    max_gap: float = Field(default=0.5, gt=0)


class PoseFile(Poses):
    """Base of ``[odometry]`` and ``[truth]``.

    Attributes
    ----------
    unit : m; length of one unit of the file, 0.001 where it says mm; by default as its columns' names say, else 1.
    source : words: where the poses come from.
    """

    unit: float | None = Field(default=None, gt=0)
    source: str = ""


class Odometry(PoseFile):
    """``[odometry]``: dead reckoning; it predicts, and where it says how good it is it is a measurement, too.

    Attributes
    ----------
    drift : standard deviation of a way as a share of it, e.g. 0.02; with turn_deg: the trajectory is adjusted to the
        odometry, which joins its pieces.
    turn_deg : degrees for each metre of way; standard deviation of the rotation.
    """

    drift: float | None = Field(default=None, ge=1e-6, lt=1)
    turn_deg: Deviation | None = None

    @model_validator(mode="after")
    def _both_or_none(self) -> Odometry:
        if (self.drift is None) != (self.turn_deg is None):
            raise ValueError(f"{'turn_deg' if self.turn_deg is None else 'drift'} is missing: give both, or neither")
        return self


class PositionFile(Recorded):
    """``[positions]``: where an antenna (GNSS) or a prism was; the trajectory is adjusted to them.

    Attributes
    ----------
    file : table of time and position, x and y in the plane in metres (easting, northing) or latitude and longitude in
        degrees, and perhaps z up; in the place of times the first column may have names of left images.
    sigma : m; standard deviation of each coordinate, or of x, y and z.
    lever_arm : m; where the antenna or prism is in the left camera's frame: x right, y down, z ahead.
    columns : names or numbers (from 1) of the columns, as for truth; names that are clear need none.
    unit : m; length of one unit of the file; by default as its columns' names say, else 1.
    time_offset : s; added to the file's times so that they are those of the images; what is left of it is estimated.
    """

    sigma: Deviation | tuple[Deviation, Deviation, Deviation]
    lever_arm: Vector = (0.0, 0.0, 0.0)
    columns: Columns = Field(default={})
    unit: float | None = Field(default=None, gt=0)


class Truth(PoseFile):
    """``[truth]``: poses, or positions alone, which are compared after a rigid fit in the plane.

    Attributes
    ----------
    columns : names or numbers (from 1) of the columns of positions alone, e.g. { time = "gps s", x = "E", y = "N" }; x
        and y span the ground, y left of x seen from above, z is up; names that are clear need none.
    lever_arm : m; where the antenna or prism of positions alone is in the left camera's frame: x right, y down, z
        ahead; none: fitted where turns show it, and the report says so.
    sigma_m : m; standard deviation of true positions along each axis; stated covariances are judged together with it.
    sigma_deg : degrees; that of true rotations about each axis.
    """

    columns: Columns = Field(default={})
    lever_arm: Vector | None = None
    sigma_m: Deviation | None = None
    sigma_deg: Deviation | None = None


class Attitude(Poses):
    """``[attitude]``: rotation from a sensor.

    Attributes
    ----------
    file : table of time and roll, pitch, yaw or a quaternion; or poses, of which R is taken.
    T_body_left : rows of [R | t]: from the left camera's frame to the sensor's.
    up : direction of up in the sensor's reference; none: not used as such.
    sigma_deg : degrees; standard deviation of the rotation from frame to frame and of up; with it the trajectory is
        adjusted to them.
    max_gap : s; attitudes are interpolated over no longer gap.
    time_offset : s; added to the file's times so that they are those of the images.
    """

    up: Direction | None = None
    sigma_deg: Deviation | None = None


class Imu(Recorded):
    """``[imu]``: angular rates and accelerations.

    Attributes
    ----------
    file : table of time, rates (rad/s) about x y z and accelerations (m/s2) along them.
    T_imu_left : rows of [R | t]: from the left camera's frame to the IMU's.
    sigma_deg : degrees; as for attitude.
    time_offset : s; added to the file's times so that they are those of the images.
    """

    T_imu_left: Pose
    sigma_deg: Deviation | None = None


class World(Table):
    """``[world]``: what is known of the vertical, and of the place.

    Attributes
    ----------
    pitch_deg : degrees; downward pitch of the left camera's axis over the ground, roll 0.
    up : direction of up in the reference frame of the calibration files (the left camera's where they state none), the
        same for all pairs.
    crs : projected CRS in metres of the results, e.g. "EPSG:32633"; with origin and azimuth_deg. Alone: that of
        [positions] in degrees.
    origin : m; easting, northing and height of the first left camera's centre in that CRS.
    azimuth_deg : degrees clockwise from grid north; heading of the first left camera's optical axis, the world's y
        axis; of a camera within 10 degrees of straight down that of its images' upper edge, up to 30 degrees between.
    """

    pitch_deg: float | None = Field(default=None, gt=-90, lt=90)
    up: Direction | None = None
    crs: Annotated[str, AfterValidator(metric_crs)] | None = None
    origin: Vector | None = None
    azimuth_deg: float | None = Field(default=None, ge=-360, le=360)

    @model_validator(mode="after")
    def _one_vertical_and_a_whole_place(self) -> World:
        if self.up is not None and self.pitch_deg is not None:
            raise ValueError("up and pitch_deg both state the vertical: remove one of them")
        if (missing := self.missing) and len(missing) < 3 and missing != ["origin", "azimuth_deg"]:
            raise ValueError(f"a place needs crs, origin and azimuth_deg: {' and '.join(missing)} missing")
        if self.crs is not None and self.origin is not None and are_degrees(self.crs, self.origin):
            text = f"origin = {list(self.origin)} looks like degrees"
            raise ValueError(f"{text}: give easting, northing and height in {self.crs}, metres")
        scale = None if self.crs is None or self.origin is None else scale_at(self.crs, self.origin)
        # Grids of countries and polar regions differ from the ground by 5 % at most.
        if scale is not None and not 0.9 < scale < 1.1:
            where = f"is {scale:.2g} m long" if scale else "does not exist"
            text = f"a metre of {self.crs} {where} at origin = {list(self.origin or ())}"
            doubt = "are easting and northing exchanged? else give them in a CRS of the place, as UTM"
            raise ValueError(f"{text}: {doubt}")
        return self

    @property
    def missing(self) -> list[str]:
        """Keys of the place that are not stated."""
        return [key for key in ("crs", "origin", "azimuth_deg") if getattr(self, key) is None]

    @property
    def place(self) -> Georeference | None:
        """Where the world frame lies; None where nothing is stated."""
        if self.crs is None or self.origin is None or self.azimuth_deg is None:
            return None
        return Georeference(self.crs, self.origin, math.radians(self.azimuth_deg))


class Manifest(Table):
    """A stereo sequence in a folder of any form.

    Attributes
    ----------
    name : short name, used for folders; the manifest's folder by default.
    root : folder of all files, relative to the manifest; ${VARIABLE} is allowed. Paths and patterns of files may be
        absolute.
    defaults : parameters that suit the sequence, e.g. locus.cell_size = 0.05.
    notes : facts that the report repeats.
    """

    name: str = ""
    root: str = "."
    images: Images
    cameras: Cameras = Cameras()
    rig: RigSection = RigSection()
    disparity: Disparity | None = None
    masks: Masks = Masks()
    times: Times | None = None
    truth: Truth | None = None
    truth_disparity: DisparityMaps | None = None
    odometry: Odometry | None = None
    positions: PositionFile | None = None
    attitude: Attitude | None = None
    imu: Imu | None = None
    world: World = World()
    vehicle: Vehicle | None = None
    defaults: dict[str, Any] = Field(default={})
    notes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_rotation_and_a_whole_place(self) -> Manifest:
        if self.attitude is not None and self.imu is not None:
            raise ValueError("[attitude] and [imu] both state the rotation: remove one of them")
        # A CRS alone is that of positions.
        if self.world.crs is not None and self.world.missing and self.positions is None:
            raise ValueError("world: a place needs crs, origin and azimuth_deg: origin and azimuth_deg missing")
        return self


VEHICLE_FILE = "vehicle.toml"
"""File beside the images whose table ``[vehicle]`` is that of a manifest; `--config` takes it as well."""


class OfVehicle(Params):
    """Tables of :data:`VEHICLE_FILE`."""

    vehicle: Vehicle


def stated_vehicle(folder: Path) -> Vehicle | None:
    """The vehicle of a folder's :data:`VEHICLE_FILE`; None: it has none.

    Raises
    ------
    InputError
        The file cannot be read, or states no vehicle; the message names the key.
    """
    path = folder / VEHICLE_FILE
    there = path.is_file()
    return validated("RIL-964", OfVehicle, read_toml(path, "vehicle"), file=str(path)).vehicle if there else None


def read_manifest(path: Path) -> Manifest:
    """Manifest of a TOML file.

    Raises
    ------
    InputError
        It cannot be read, is not TOML, or a key is unknown, missing or not permitted; the message names the key.
    """
    values = read_toml(path, "manifest")
    # Of one that names images, the wrong key and value say what to correct.
    remedy = "" if "images" in values else "`rille init FOLDER` writes one to begin with"
    return validated("RIL-223", Manifest, values, file=str(path), remedy=remedy)
