"""The simulated experiment as a closed loop: a rover that is driven by what the chain makes of its images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rille.datasets import protocol
from rille.datasets.mockup.params import MockupParams
from rille.datasets.mockup.rover import RoverParams
from rille.datasets.mockup.sequence import given_rig, mount, true_rig, vehicle_at_scale
from rille.datasets.protocol import Simulation, Source
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.hazard.vehicle import Vehicle

LOOP: Mapping[str, Any] = {
    "frames": 1,
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
"""``mockup-loop``: small images of wide-angle cameras, which see the ground from 0.08 m before them to the horizon;
one ray a pixel, since a drive takes a hundred of them."""

DEFAULTS: Mapping[str, Any] = {
    "terrain.preset": "accurate",
    "track.points": 400,
    "locus.cell_size": 0.004,
    "crosscheck.enabled": False,
    "drive.goal": (0.0, 1.0),
}
"""Accurate terrain, since what a map smooths away is met by a wheel: of the cells with an edge above ``max_step`` (six
beds, three stops each) half as many have a probability below 0.3, none below 0.06 (0.5 %), and a tenth fewer cells are
false hazards. It takes a quarter more time a stop. Poses need no more points than by default."""


def mockup_loop(p: MockupParams, rover: RoverParams, name: str = "mockup-loop") -> protocol.Sequence:
    """The sequence of a rover that is driven: one pair at the start, the others come about on the way."""
    rig, vehicle = true_rig(p), vehicle_at_scale()
    cameras = {"left": rig.left, "right": rig.right}
    T_vehicle_body = RigidTransform(np.eye(3), np.array([0.0, rover.camera_forward, p.camera_height]))
    T_vehicle_left = T_vehicle_body @ mount(p, "left")
    T_left_right = rig.T_right_left.inverse()
    mounted = {"T_vehicle_left": T_vehicle_left.to_list()}

    def leg(body: Vehicle, number: int, **more: int) -> Source:
        args = {"leg": number, **more, "vehicle": body.model_dump(mode="json"), **mounted}
        return Source("rille.datasets.mockup.rover", rover, args)

    def image(frame: int, camera: str, T_bed_left: RigidTransform) -> Source:
        T_bed_camera = T_bed_left if camera == "left" else T_bed_left @ T_left_right
        sensor = p.render()
        if frame in rover.lost_frames:
            # Black but for the sensor's noise, as with a closed shutter.
            sensor = sensor.model_copy(update={"exposure": 1e-3})
        args = {"frame": frame, "camera": camera, "geometry": cameras[camera].to_dict()}
        return Source("rille.datasets.mockup.render", sensor, args | {"T_bed_camera": T_bed_camera.to_list()})

    def change(leg: int, row: int) -> Source | None:
        if leg != rover.obstacle_leg:
            return None
        return Source("rille.datasets.mockup.obstacle", rover, {"leg": leg, "row": row, **mounted})

    def dem(lattice: Mapping[str, Any], T_truth_world: RigidTransform, stops: Sequence[RigidTransform]) -> Source:
        args = {"lattice": dict(lattice), "T_bed_world": T_truth_world.to_list(), "rig": rig.to_dict()}
        return Source("rille.datasets.mockup.truth_dem", NoParams(), args | {"pairs": [T.to_list() for T in stops]})

    pad = [*rover.start, rover.pad] if rover.pad > 0 else None
    site = {"pad": pad, "blank": None if rover.blank is None else list(rover.blank)}
    simulation = Simulation(
        scene=Source(
            "rille.datasets.mockup.site",
            NoParams(),
            site,
            inputs={"scene": Source("rille.datasets.mockup.scene", p.scene())},
        ),
        place=lambda body: leg(body, -1),
        drive=lambda body, number, row: leg(body, number, row=row),
        sense=lambda leg: Source("rille.datasets.mockup.sense", rover, {"leg": leg}),
        change=change,
        image=image,
        truth_dem=dem,
        T_vehicle_left=T_vehicle_left,
        pad=rover.pad,
        overview=None
        if rover.map_cell is None
        else Source("rille.datasets.mockup.overview", rover, {"cell": rover.map_cell}),
    )

    def nothing(frame: int, camera: str) -> Source:
        raise InputError("RIL-247", "images of a drive come about on the way", remedy=f"rille drive {name}")

    return protocol.Sequence(
        name=name,
        rig=given_rig(p),
        frames=1,
        image=nothing,
        frame_names=("000000",),
        truth_source="the simulator's own poses: exact",
        vehicle=vehicle,
        defaults=DEFAULTS,
        notes=(
            f"simulated at 1:10, bed of seed {p.seed}, rover of seed {rover.seed}; lengths are those of the model",
            "a closed loop: each image was rendered where the rover had driven to by what was made of those before",
        ),
        parameters={"mockup": p, "rover": rover},
        simulation=simulation,
    )
