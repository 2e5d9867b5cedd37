"""The simulated experiment as a sequence, recorded or driven: poses of the cameras, given data and truth.

The closed loop decides the motion of a driven rover from its images.

Frames: the bed frame (truth) has z up, y ahead, x right and its origin in the middle of the bed's near edge at mean
height. The body frame moves with the rig: y ahead, x along the baseline to the right, z up, origin between the cameras.
Each camera is turned inward about the body's z axis by the toe-in and then downward by the pitch about its own
horizontal axis, so that with a level body both cameras have exactly that pitch and no roll.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rille.datasets.mockup.params import MockupParams, RenderParams, SceneParams, SetupParams
from rille.datasets.mockup.rover import START, RoverParams
from rille.datasets.protocol import CAMERAS, Rows, Sequence, Simulation, Source, Vector, rows_of, vector_of
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import ConfigError, InputError
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.terrain.ground import rounded_cell

FIRST_Y_M = -0.1
"""m, y of the first position in the bed frame: the near edge of the bed lies below the first images."""

TRUTH_SOURCE = "the simulator's own poses: exact"

LOOP: Mapping[str, Any] = {
    "image_width": 320,
    "image_height": 240,
    "focal_length": 180.0,
    "toe_in_deg": 3.0,
    "pitch_deg": 32.0,
    "sampling": 1,
    "bed_width": 1.6,
    "bed_length": 2.0,
    "cell": 0.002,
    "rocks": 12.0,
    "craters": 4.0,
}
"""``mockup-loop``: small images of wide-angle cameras, which see the ground from 0.08 m ahead to the horizon; one ray
per pixel, since a drive takes a hundred images."""

EXACT_CALIBRATION = 1e-5
"""Standard deviation of the simulated cameras' focal length and principal point, over the focal length."""

LOOP_DEFAULTS: Mapping[str, Any] = {
    "intrinsics.prior": EXACT_CALIBRATION,
    "terrain.preset": "accurate",
    "track.points": 400,
    "resect.joint": False,
    "locus.cell_size": 0.004,
    "locus.least_facing": 0.0,
    "crosscheck.enabled": False,
    "drive.goal": (0.0, 1.0),
}
"""Accurate terrain, because wheels meet edges that a map smooths away: of the cells with an edge above ``max_step``
(six beds, three stops each) half as many have a probability below 0.3, none below 0.06 (0.5 %), and a tenth fewer cells
are false hazards. Ground seen edge-on stays: without it stones close more ways (three beds at 10 %: 1.53, 2.07, 1.93
times the shortest instead of 1.21, 1.00, 0.78). A stop takes a quarter more time. Poses need no more points than by
default. Each leg is a segment: with a joint adjustment its frames err less, but the pose at its end does not, and one
of 15 drives lost its way."""


def mount(p: SetupParams, camera: str) -> RigidTransform:
    """T_body_camera of the true rig."""
    side = -1.0 if camera == "left" else 1.0
    toe, pitch = math.radians(p.toe_in_deg), math.radians(p.pitch_deg)
    # Optical axes of a level camera that looks along y: x right, y down, z ahead.
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    inward = rotation_exp([0.0, 0.0, side * toe])
    down = rotation_exp([-pitch, 0.0, 0.0])
    return RigidTransform(inward @ down @ level, np.array([side * 0.5 * p.baseline, 0.0, 0.0]))


def body_poses(p: MockupParams) -> list[RigidTransform]:
    """T_bed_body of every frame: equal steps of the body on the mean plane, with turns, roll and jitter."""
    turns = np.deg2rad(p.turn_deg) * np.arange(p.frames)
    # Each step follows the heading half-way: with a constant turn they are chords of a circle.
    ahead = turns - 0.5 * np.deg2rad(p.turn_deg)
    across = p.sideways * np.cos(ahead) - p.forward * np.sin(ahead)
    along = p.sideways * np.sin(ahead) + p.forward * np.cos(ahead)
    steps = np.column_stack([across, along])
    steps[0] = 0.0
    offsets = np.cumsum(steps, axis=0)
    # The drive is centred across the bed.
    offsets[:, 0] -= 0.5 * (offsets[:, 0].min() + offsets[:, 0].max())
    # A drive with turns looks to all sides, and is centred along the bed too.
    middle = 0.5 * (p.bed_length - offsets[:, 1].min() - offsets[:, 1].max())
    offsets[:, 1] += middle if p.turn_deg else FIRST_Y_M - min(offsets[:, 1].min(), 0.0)
    shakes = np.deg2rad(p.jitter_deg) * np.random.default_rng([p.seed, 60]).standard_normal((p.frames, 3))
    T_bed_plane = RigidTransform(rotation_exp([np.deg2rad(p.slope_deg), 0.0, 0.0]), np.zeros(3))
    poses = []
    for (x, y), turn, (pitch, roll, heading) in zip(offsets, turns, shakes, strict=True):
        rotation = (
            rotation_exp([0.0, 0.0, turn + heading])
            @ rotation_exp([pitch, 0.0, 0.0])
            @ rotation_exp([0.0, math.radians(p.roll_deg) + roll, 0.0])
        )
        poses.append(T_bed_plane @ RigidTransform(rotation, np.array([x, y, p.camera_height])))
    return poses


def true_rig(p: SetupParams) -> Rig:
    """The rig that takes the images."""
    f, width, height = p.focal_length, p.image_width, p.image_height
    camera = Camera(f, f, 0.5 * (width - 1), 0.5 * (height - 1), width, height)
    return Rig(camera, camera, mount(p, "right").inverse() @ mount(p, "left"))


def given_rig(p: SetupParams) -> Rig:
    """The rig given to the reconstruction: the true one with the stated error."""
    rig = true_rig(p)
    error = RigidTransform(rotation_exp(np.deg2rad(p.rig_error_deg)), np.zeros(3))
    return Rig(rig.left, rig.right, error @ rig.T_right_left)


def _check_on_bed(p: MockupParams, poses: list[RigidTransform]) -> None:
    """Refuse a drive that leaves the bed."""
    for k, pose in enumerate(poses):
        x, y, _ = pose.translation
        # Not y < 0: a drive begins before the near edge (FIRST_Y_M).
        if abs(x) > 0.5 * p.bed_width or y > p.bed_length:
            bed = f"the bed of {p.bed_width:g} x {p.bed_length:g} m"
            text = f"mockup: frame {k} stands at x = {x:.2f} m, y = {y:.2f} m, outside {bed}"
            raise ConfigError("RIL-253", text, remedy="take fewer frames, smaller steps, or a larger bed")


def _attitude(p: MockupParams, truth: list[RigidTransform]) -> tuple[Rows, ...] | None:
    """R_bed_left of each frame by a sensor with the stated error."""
    if p.attitude_noise_deg is None:
        return None
    errors = np.deg2rad(p.attitude_noise_deg) * np.random.default_rng([p.seed, 61]).standard_normal((p.frames, 3))
    # Errors are about the camera's axes, so they multiply R_left_bed, the transposed rotation, from the left.
    return tuple(rows_of((rotation_exp(e) @ T.rotation.T).T) for e, T in zip(errors, truth, strict=True))


def _up(p: MockupParams, truth: list[RigidTransform]) -> tuple[Vector, ...] | None:
    """Direction of up in each left camera by an inclinometer with the stated error."""
    if not p.inclinometer:
        return None
    out = []
    for frame, pose in enumerate(truth):
        # A stream for each frame, whose error does not depend on the number of frames.
        error = np.random.default_rng([p.seed, 62, frame]).standard_normal(3)
        out.append(vector_of(rotation_exp(np.deg2rad(p.up_noise_deg) * error) @ pose.rotation[2]))
    return tuple(out)


@dataclass(frozen=True)
class Sources:
    """Sources of images and truth of an experiment; ``inputs``: the scene, if it is the same for all of them."""

    rig: Rig
    inputs: Mapping[str, Source]

    @cached_property
    def given(self) -> dict[str, Any]:
        """The rig as an argument, one object for all tasks."""
        return self.rig.to_dict()

    def image(self, frame: int, camera: str, T_bed_camera: RigidTransform, sensor: RenderParams) -> Source:
        """Image of a true camera."""
        geometry = self.rig.left if camera == "left" else self.rig.right
        args = {"frame": frame, "camera": camera, "geometry": geometry.to_dict()}
        args["T_bed_camera"] = T_bed_camera.to_list()
        return Source("rille.datasets.mockup.render", sensor, args, inputs=self.inputs)

    def disparity(self, frame: int, T_bed_left: RigidTransform) -> Source:
        """True disparity of a pair."""
        args = {"frame": frame, "rig": self.given, "T_bed_left": T_bed_left.to_list()}
        return Source("rille.datasets.mockup.truth", NoParams(), args, inputs=self.inputs)

    def dem(self, lattice: Mapping[str, Any], T_bed_world: RigidTransform, lefts: Iterable[RigidTransform]) -> Source:
        """True elevations, and whether pairs at the poses ``lefts`` see them."""
        args = {"lattice": dict(lattice), "T_bed_world": T_bed_world.to_list(), "rig": self.given}
        args["pairs"] = [T.to_list() for T in lefts]
        return Source("rille.datasets.mockup.truth_dem", NoParams(), args, inputs=self.inputs)


def mockup(p: MockupParams, name: str = "mockup") -> Sequence:
    """The simulated sequence."""
    bodies = body_poses(p)
    _check_on_bed(p, bodies)
    poses = {c: [body @ mount(p, c) for body in bodies] for c in CAMERAS}
    lefts = poses["left"]
    sources = Sources(true_rig(p), {"scene": Source("rille.datasets.mockup.scene", p.part(SceneParams))})

    def dem(lattice: Mapping[str, Any], T_truth_world: RigidTransform, pairs: tuple[int, ...] = ()) -> Source:
        return sources.dem(lattice, T_truth_world, [lefts[k] for k in pairs])

    attitude = _attitude(p, lefts)
    return Sequence(
        name=name,
        rig=given_rig(p),
        frames=p.frames,
        image=lambda frame, camera: sources.image(frame, camera, poses[camera][frame], p.part(RenderParams)),
        frame_names=tuple(f"{k:06d}" for k in range(p.frames)),
        times=tuple(float(k) for k in range(p.frames)),
        truth=tuple(lefts),
        truth_source=TRUTH_SOURCE,
        up=_up(p, lefts) if attitude is None else tuple(rows[2] for rows in attitude),
        attitude=attitude,
        vehicle=vehicle_at_scale(),
        truth_dem=dem,
        truth_disparity=lambda frame: sources.disparity(frame, lefts[frame]),
        # 600 x 300 mm about where the optical axes cross, 0.55 m ahead.
        evaluation_window=(-0.3, 0.4, 0.3, 0.7),
        defaults={
            "keyframes.rule": "stride",
            "keyframes.stride": 4,
            "locus.cell_size": cell_of(p),
            "intrinsics.prior": EXACT_CALIBRATION,
        },
        notes=(
            f"simulated at 1:10 with seed {p.seed}; lengths are those of the model",
            "truth frame: z up, y along the bed, x right, origin in the middle of the near edge at mean height",
        ),
        parameters={"mockup": p},
    )


def cell_of(p: SetupParams) -> float:
    """Side of a cell, m: 1 mm, or more where two errors of the nearest ground's depth are (0.2 px of disparity)."""
    half = math.atan(0.5 * p.image_height / p.focal_length)
    nearest = p.camera_height * math.cos(half) / math.sin(min(math.radians(p.pitch_deg) + half, 0.5 * math.pi))
    return max(0.001, rounded_cell(2.0 * 0.2 * nearest**2 / (p.focal_length * p.baseline)))


def vehicle_at_scale() -> Vehicle:
    """The rover at 1:10: a 0.8 m wide, 1 m long one with 0.3 m wheels at full scale."""
    return Vehicle(
        name="rover at 1:10",
        wheel_diameter=0.03,
        track=0.08,
        wheel_base=0.10,
        clearance=0.025,
        max_slope_deg=20.0,
        max_step=0.012,
        max_roughness=0.004,
        margin=0.01,
    )


def mockup_loop(p: SetupParams, rover: RoverParams, name: str = "mockup-loop") -> Sequence:
    """The sequence of a driven rover: one pair at the start, others during the drive."""
    sources = Sources(true_rig(p), {})
    # The cameras stand 5 cm ahead of the centre of the wheels.
    T_vehicle_body = RigidTransform(np.eye(3), np.array([0.0, 0.05, p.camera_height]))
    T_vehicle_left = T_vehicle_body @ mount(p, "left")
    T_left_right = sources.rig.T_right_left.inverse()
    mounted = {"T_vehicle_left": T_vehicle_left.to_list()}

    def leg(body: Vehicle, number: int, row: int | None = None) -> Source:
        args = {"leg": number, "row": row, "vehicle": body.model_dump(mode="json", exclude={"name"}), **mounted}
        return Source("rille.datasets.mockup.rover", rover, args)

    def image(frame: int, camera: str, T_bed_left: RigidTransform) -> Source:
        T_bed_camera = T_bed_left if camera == "left" else T_bed_left @ T_left_right
        # Black except for the sensor's noise, as with a closed shutter.
        lost = {"exposure": 1e-3} if frame in rover.lost_frames else {}
        return sources.image(frame, camera, T_bed_camera, p.part(RenderParams).model_copy(update=lost))

    def change(number: int, row: int) -> Source | None:
        if number != rover.obstacle_leg:
            return None
        return Source("rille.datasets.mockup.obstacle", rover, {"leg": number, "row": row, **mounted})

    def nothing(frame: int, camera: str) -> Source:
        raise InputError("RIL-247", "images of a drive come about on the way", remedy=f"rille drive {name}")

    site = {"pad": [*START[:2], rover.pad] if rover.pad > 0 else None, "blank": rover.blank}
    # The rover looks along the bed, so the world frame is the bed's, moved to the left camera.
    x, y, _ = T_vehicle_left.translation + np.array([*START[:2], 0.0])
    overview = Source("rille.datasets.mockup.overview", rover, {"cell": rover.map_cell})
    return Sequence(
        name=name,
        rig=given_rig(p),
        frames=1,
        image=nothing,
        frame_names=("000000",),
        truth_source=TRUTH_SOURCE,
        vehicle=vehicle_at_scale(),
        defaults=LOOP_DEFAULTS,
        notes=(
            f"simulated at 1:10, bed of seed {p.seed}, rover of seed {rover.seed}; lengths are those of the model",
            "a closed loop: each image was rendered where the rover had driven to by what was made of those before",
        ),
        parameters={"mockup": p, "rover": rover},
        simulation=Simulation(
            scene=Source("rille.datasets.mockup.scene", p.part(SceneParams), site),
            place=lambda body: leg(body, -1),
            drive=leg,
            sense=lambda number: Source("rille.datasets.mockup.sense", rover, {"leg": number}),
            change=change,
            image=image,
            truth_dem=sources.dem,
            T_vehicle_left=T_vehicle_left,
            pad=rover.pad,
            ground=(-0.5 * p.bed_width - x, 0.5 * p.bed_width - x, -y, p.bed_length - y),
            overview=None if rover.map_cell is None else overview,
        ),
    )
