"""A vehicle's size and its camera's inclination from a robot description (URDF).

Wheels are links with a cylinder or sphere that turn on ``continuous`` joints; all joints stand at zero. The first link
is level, x ahead, y to the left and z up (REP 103); the camera's link is an optical one, z along its axis (REP 104).
Clearance is the least height, above the ground beneath the wheels, of the boxes, cylinders and spheres of other links.
Source: the URDF specification (wiki.ros.org/urdf/XML), elements link and joint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from rille.datasets.text.reading import read_text
from rille.datasets.text.validation import validated
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.hazard.vehicle import Vehicle

LARGE = 0.7
"""Share of the greatest radius from which a turning link is a wheel, and no castor or mast."""

SUNK = 0.1
"""Share of the radius by which a link that does not turn may lie below the ground: a castor is placed no better."""

MOST_LINKS = 300
"""And joints: robots with hands have a hundred; the way from each link to the first is walked."""

ROLL = math.radians(2.0)
"""Roll beyond which the pitch alone does not describe how a camera is mounted."""


@dataclass(frozen=True)
class Robot:
    """The vehicle, and the downward pitch of its camera's axis, radians."""

    vehicle: Vehicle
    pitch: float | None = None


@dataclass(frozen=True)
class _Shape:
    """Centre (3,) of a shape and its lowest height, in the frame of the first link, m; its radius where it is round."""

    centre: Floats
    low: float
    radius: float = 0.0


def read_urdf(path: Path, camera: str = "", stated: Vehicle | None = None) -> Robot:
    """The vehicle of a description, and the pitch of the link ``camera`` where one is named.

    Parameters
    ----------
    stated : vehicle whose values that were set count before those of the description.

    Raises
    ------
    InputError
        The file cannot be read or is no URDF, has no two wheels or no such link, the camera is rolled, or
        size and limits are no vehicle.
    """
    robot = _parsed(path)
    joints = {}
    for joint in robot.iter("joint"):
        child, parent = joint.find("child"), joint.find("parent")
        if child is not None and parent is not None:
            joints[child.get("link", "")] = (parent.get("link", ""), _origin(joint, path), joint.get("type", ""))
    links = {link.get("name", ""): link for link in robot.iter("link")}
    if max(len(links), len(joints)) > MOST_LINKS:
        extent = f"{len(links)} links and {len(joints)} joints"
        raise _error(path, f"has {extent}, at most {MOST_LINKS} are read", "leave out what is no part of it")
    places = {name: _place(name, joints, path) for name in links}
    shapes = {name: _shapes(link, places[name], path) for name, link in links.items()}
    turning = {name: s for name, s in shapes.items() if s and joints.get(name, ("",) * 3)[2] == "continuous"}
    radius = max((s[0].radius for s in turning.values()), default=0.0)
    wheels = {name: s[0] for name, s in turning.items() if s[0].radius >= LARGE * radius > 0}
    centres = np.array([wheel.centre for wheel in wheels.values()])
    if len(wheels) < 2:
        raise _error(
            path,
            f"has {len(wheels)} wheels (continuous joints of links with a cylinder or sphere)",
            "give its wheels cylinders for their meshes, or state the vehicle in [vehicle] instead",
        )
    length, width = np.ptp(centres[:, :2], axis=0)
    # The lowest wheel carries, by its own radius: castors and raised wheels do not touch flat ground.
    ground = min(float(z) - wheel.radius for z, wheel in zip(centres[:, 2], wheels.values(), strict=True))
    lows = {name: min(one.low for one in those) for name, those in shapes.items() if those and name not in turning}
    low = min(lows.values(), default=ground)
    # A castor on a fixed joint stands on the ground, and then nothing tells the clearance.
    if low < ground - SUNK * radius and (stated is None or "clearance" not in stated.model_fields_set):
        raise _error(
            path,
            f"has {min(lows, key=lambda name: lows[name])!r} {ground - low:.3g} m below the ground under its wheels",
            "correct it, or state clearance in [vehicle]",
        )
    sizes = {"wheel_diameter": 2 * radius, "wheel_base": length, "track": width, "clearance": low - ground}
    found: dict[str, Any] = {name: round(float(value), 6) for name, value in sizes.items() if value > 1e-3}
    found |= {"name": robot.get("name")} if robot.get("name") else {}
    found |= {} if stated is None else stated.model_dump(exclude_unset=True)
    remedy = "state what differs in [vehicle]"
    vehicle = validated("RIL-963", Vehicle, found, file=f"URDF {path}", remedy=remedy)
    return Robot(vehicle, _pitch(camera, places, path) if camera else None)


def _parsed(path: Path) -> ElementTree.Element:
    text = read_text(path, "URDF")
    # Entities expand without bound, and xacro's expressions are not numbers yet.
    if "<!ENTITY" in text or "${" in text:
        raise _error(path, "holds entities or xacro expressions", f"expand it: xacro {path.name} > robot.urdf")
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise _error(path, f"cannot be parsed: {error}") from error
    if robot.tag != "robot":
        raise _error(path, f"holds <{robot.tag[:40]}>, no <robot>")
    return robot


def _error(path: Path, what: str, remedy: str = "give the robot's URDF") -> InputError:
    return InputError("RIL-959", f"URDF {path} {what}", remedy=remedy)


def _numbers(text: str, count: int, path: Path) -> Floats:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not (np.abs(values) < 1e3).all():
        raise _error(path, f"has {text[:40]!r} where {count} numbers in metres or radians belong", "correct it")
    return values


def _origin(element: ElementTree.Element, path: Path) -> RigidTransform:
    from scipy.spatial.transform import Rotation

    origin = element.find("origin")
    xyz, rpy = ("0 0 0" if origin is None else origin.get(key, "0 0 0") for key in ("xyz", "rpy"))
    return RigidTransform(Rotation.from_euler("xyz", _numbers(rpy, 3, path)).as_matrix(), _numbers(xyz, 3, path))


def _place(name: str, joints: dict[str, tuple[str, RigidTransform, str]], path: Path) -> RigidTransform:
    """Pose of a link in the first link's frame."""
    T, seen = RigidTransform.identity(), {name}
    while name in joints:
        name, T_parent_child, _ = joints[name]
        if name in seen:
            raise _error(path, f"has a circle of joints at {name!r}", "correct it")
        seen.add(name)
        T = T_parent_child @ T
    return T


def _shapes(link: ElementTree.Element, T_base_link: RigidTransform, path: Path) -> list[_Shape]:
    """Shapes of a link that have a size of their own; those of collisions before those that are drawn."""
    found = []
    for part in link.findall("collision") or link.findall("visual"):
        size, radius, T = np.zeros(3), 0.0, T_base_link @ _origin(part, path)
        x, y, z = np.abs(T.rotation[2])
        # How far it reaches below its centre: to a corner of a box, the rim of a cylinder, a radius of a sphere.
        reach = 0.0
        for shape in part.iterfind("geometry/*"):
            if shape.tag == "box":
                size = np.abs(_numbers(shape.get("size", ""), 3, path))
                reach = 0.5 * float(size @ (x, y, z))
            elif shape.tag in ("cylinder", "sphere"):
                radius = reach = float(_numbers(shape.get("radius", ""), 1, path)[0])
                size = np.array([radius])
            if shape.tag == "cylinder":
                size = np.array([radius, _numbers(shape.get("length", "0"), 1, path)[0]])
                reach = radius * math.hypot(x, y) + 0.5 * float(size[1]) * z
        if size.any():
            found.append(_Shape(T.translation, float(T.translation[2]) - reach, radius))
    return found


def _pitch(camera: str, places: dict[str, RigidTransform], path: Path) -> float:
    if camera not in places:
        near = ", ".join(sorted(name for name in places if "cam" in name or "optical" in name)[:5])
        raise _error(path, f"has no link {camera!r}", f"name an optical link{f', e.g. of {near}' if near else ''}")
    across, _, ahead = places[camera].rotation.T
    # Clamped, here and below: rounding may leave a component of a unit vector above 1.
    if abs(math.asin(max(-1.0, min(1.0, across[2])))) > ROLL:
        raise _error(path, f"has {camera} rolled: its columns are not level", "name the optical link of a level camera")
    return -math.asin(max(-1.0, min(1.0, float(ahead[2]))))
