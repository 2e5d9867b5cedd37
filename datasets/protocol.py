"""Definition of a stereo sequence, recorded or rendered.

A sequence holds no pixels, but the stage that makes each image (:class:`Source`), so that reading and rendering are
cached tasks like all others. Truth is optional and only for assessment; no estimate may read it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Sequence_
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rille.datasets.georeference import Georeference
from rille.datasets.text.names import check_name
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Params
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens

if TYPE_CHECKING:
    from rille.stages.hazard.vehicle import Vehicle

CAMERAS = ("left", "right")

Vector = tuple[float, float, float]
Rows = tuple[Vector, Vector, Vector]
"""A 3 x 3 rotation, row by row."""


def vector_of(values: Floats) -> Vector:
    """Three numbers of an array as plain ones."""
    x, y, z = map(float, values)
    return x, y, z


def rows_of(rotation: Floats) -> Rows:
    """A rotation (3, 3) as plain numbers."""
    a, b, c = map(vector_of, rotation)
    return a, b, c


@dataclass(frozen=True)
class Source:
    """The task that provides data: a stage module, resolved by name, with its parameters and arguments.

    ``args`` enter the cache key. ``hints`` (paths) do not: they are merged into the arguments when the stage runs
    (``args | hints``) and must not change its result. ``inputs`` are sources of the stage's input ports, resolved
    recursively (the renderer's scene).
    """

    module: str
    params: Params
    args: Mapping[str, Any] = field(default_factory=dict)
    hints: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Source] = field(default_factory=dict)


class TruthDem(Protocol):
    """Exact elevations on a lattice given in the frame of the reconstruction (see :class:`Sequence`)."""

    def __call__(
        self, lattice: Mapping[str, Any], T_truth_world: RigidTransform, pairs: tuple[int, ...] = ()
    ) -> Source:
        """Source of ``elevation`` and ``seen`` (the cell is visible in both cameras of one of ``pairs``)."""


@dataclass(frozen=True)
class Positions:
    """True positions without rotations, in a frame of their own: x and y in the plane, z up.

    Attributes
    ----------
    positions : one row each, x, y or x, y, z, metres.
    times : seconds, increasing, of a clock that may be off by a constant; None: one row a frame.
    max_gap : seconds; between rows farther apart nothing is interpolated.
    lever_arm : m, place of the antenna or prism in the left camera's frame; None: not known.
    """

    positions: tuple[tuple[float, ...], ...]
    times: tuple[float, ...] | None = None
    max_gap: float = 0.5
    lever_arm: Vector | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


@dataclass(frozen=True)
class Simulation:
    """A vehicle that can be driven: sources of its true poses, its sensors' readings and its images.

    The closed loop connects the input ports of each :class:`Source`: ``scene`` to the artifact of the world at that
    time, the others as named.

    Attributes
    ----------
    scene : the world at the start.
    place : ``place(vehicle)``, true poses before the first leg (one row): ``scene``.
    drive : ``drive(vehicle, leg, row)``, true poses of a leg: ``scene``; ``before``, the leg that led here, at that
        row; ``pose``, the estimated pose; ``leg``, the leg to drive.
    sense : ``sense(leg)``, readings of its sensors: ``drive``.
    change : ``change(leg, row)``, the world after something happened, with ports as of ``drive``; None: nothing does.
    image : ``image(frame, camera, T_truth_left)``: ``scene``.
    truth_dem : ``truth_dem(lattice, T_truth_world, T_truth_left of stops)``: ``scene``.
    T_vehicle_left : mounting of the left camera; the vehicle's frame is between its wheels on the ground, y ahead.
    pad : m; radius about the start whose ground is known.
    ground : m, x_min, x_max, y_min, y_max of the ground in the world frame.
    overview : a coarse elevation model of the whole world in a frame of its own: ``scene``.
    """

    scene: Source
    place: Callable[[Vehicle], Source]
    drive: Callable[[Vehicle, int, int], Source]
    sense: Callable[[int], Source]
    change: Callable[[int, int], Source | None]
    image: Callable[[int, str, RigidTransform], Source]
    truth_dem: Callable[[Mapping[str, Any], RigidTransform, Sequence_[RigidTransform]], Source]
    T_vehicle_left: RigidTransform
    pad: float
    ground: tuple[float, float, float, float]
    overview: Source | None = None


@dataclass(frozen=True)
class Sequence:
    """A calibrated stereo sequence.

    Attributes
    ----------
    name : short name, used for folders.
    rig : the rig as it was *given* (it may be wrong by a calibration error); its cameras are ideal: those that the
        images have once their distortion is removed.
    frames : number of stereo pairs.
    image : ``image(frame, camera)`` with camera ``"left"`` or ``"right"``: source of ``image`` and ``valid``.
    lenses : real optics by camera, where the images are distorted.
    frame_names : one name a frame (file stem).
    times : seconds, one a frame.
    truth : T_truth_left of each frame, in any world frame, metres; None where the truth has a gap.
    truth_positions : truth that is positions alone, where ``truth`` is None.
    truth_record : positions of the camera by the file of ``truth``, at its own times; None: it has one row a frame.
    truth_source : what the truth is, in words.
    truth_sigma_m, truth_sigma_rad : standard deviations of the true positions, and rotations about each axis; 0: not
        stated.
    truth_mount : T_body_left, by which the poses of the truth's file were multiplied; None: they are the camera's.
    up : direction of "up" in each left camera frame (attitude); None where it is not known.
    attitude : R_reference_left of each frame from a sensor (gyroscope, compass); the reference is any inertial frame,
        the same for all frames, and only differences between frames are used. None where it is not known.
    imu_axes : R_imu_left, where ``up`` and ``attitude`` are those of an IMU.
    odometry : T_odometry_left of each frame by dead reckoning, metres; part of the result only as a prior.
    priors : sensors that the trajectory is adjusted to, and how good they are: ``odometry`` (drift, turn; of wheels on
        a plane its ``up`` and the ``origin``, m, of their body in the left camera's frame), ``attitude`` and ``up``
        (sigma, rad), ``positions`` (positions, times, sigma, lever).
    pitch : downward pitch of the left camera's optical axis, radians, stated with the rig; roll 0.
    georeference : where the world frame lies, where that is known.
    vehicle : the vehicle whose limits suit the scale of the sequence.
    truth_dem : exact elevations on any lattice of any frame whose pose in the truth frame is given.
    truth_disparity : ``truth_disparity(frame)``: source of the exact disparity of a pair; None where it is not known.
    disparity : ``disparity(frame)``: source of the ``column_disparity`` of a pair (right minus left, pixels) that
        another program made, and maybe its ``disparity_std``; it is checked, and takes the matcher's place.
    masks : of cameras, files that say which pixels never show the scene (see :mod:`rille.datasets.images.masks`).
    evaluation_window : (x_min, y_min, x_max, y_max), metres, local frame of a basic pair: where a DEM is judged.
    lost : frames that have no pair of images, and why; nothing asks for their images.
    defaults : dotted configuration that suits the sequence.
    notes : facts that the report repeats.
    warnings : what is suspicious but possible, one line each with the figure; a run prints them and goes on.
    parameters : the sequence's own settings by configuration section, all defaults filled.
    opened : words of a command line that name it: what it was opened by, and options with settings from Python.
    simulation : of a vehicle that is driven, not recorded: its frames come about on the way.
    """

    name: str
    rig: Rig
    frames: int
    image: Callable[[int, str], Source]
    frame_names: tuple[str, ...]
    lenses: Mapping[str, Lens] | None = None
    times: tuple[float, ...] | None = None
    truth: tuple[RigidTransform | None, ...] | None = None
    truth_positions: Positions | None = None
    truth_record: Positions | None = None
    truth_source: str = ""
    truth_sigma_m: float = 0.0
    truth_sigma_rad: float = 0.0
    truth_mount: RigidTransform | None = None
    up: tuple[Vector | None, ...] | None = None
    attitude: tuple[Rows | None, ...] | None = None
    imu_axes: Rows | None = None
    odometry: tuple[RigidTransform | None, ...] | None = None
    priors: Mapping[str, Any] = field(default_factory=dict)
    pitch: float | None = None
    georeference: Georeference | None = None
    vehicle: Vehicle | None = None
    truth_dem: TruthDem | None = None
    truth_disparity: Callable[[int], Source | None] | None = None
    disparity: Callable[[int], Source] | None = None
    masks: Mapping[str, Path] = field(default_factory=dict)
    evaluation_window: tuple[float, float, float, float] | None = None
    lost: Mapping[int, str] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    parameters: Mapping[str, Params] = field(default_factory=dict)
    opened: tuple[str, ...] = field(default=(), compare=False)
    simulation: Simulation | None = None

    def __post_init__(self) -> None:
        check_name(self.name)
        if self.frames < 1:
            text = f"sequence {self.name} has no frames"
            raise InputError("RIL-272", text, remedy="give a folder with at least one pair")
        for what in ("frame_names", "times", "truth", "up", "attitude", "odometry"):
            values = getattr(self, what)
            if values is not None and len(values) != self.frames:
                text = f"sequence {self.name}: {len(values)} {what.replace('_', ' ')} for {self.frames} frames"
                raise InputError("RIL-273", text, remedy=f"give one entry of {what.replace('_', ' ')} a frame")

    @property
    def loose_odometry(self) -> bool:
        """Whether dead reckoning is known, but not how good it is: the trajectory is not adjusted to it."""
        return self.odometry is not None and "odometry" not in self.priors
