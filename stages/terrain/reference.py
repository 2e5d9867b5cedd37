"""Whether a run's elevations are heights above ground or distances from the scene's own plane, by its pairs.

Many scenes hold a level plane that is no ground: a floor under shelves, a table. A pair shows *ground* if

- the vertical is known, and the plane is level but for 10 degrees; or
- the ground is stated, or holds :data:`MIN_REFERENCE_SHARE` of the pair's matched pixels; or
- it is open ground, seen as far as :data:`MIN_REACH_HEIGHTS` camera heights; or
- another pair shows the same plane: its normal turned by at most :data:`MAX_TURN_DEG` in the camera's frame, and the
  camera's height alike to a quarter. A vehicle carries its cameras so.

Pairs that show ground must outnumber those whose matched pixels lie on another plane.

The limits were chosen on 27 November 2026 with the street, the mockup and the Middlebury pairs, and judged on Devon
Island, K10, EuRoC (at rest, in flight without its vertical), the lunar views and a table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.pose_arrays import GROUND_PLANE, NO_VERTICAL

MIN_REFERENCE_SHARE = 0.4
MIN_REACH_HEIGHTS = 5.0
MAX_TURN_DEG = 10.0
MIN_MATCHED_BELOW = 0.5
"""Share of matched pixels in the lowest quarter of the left image, below which ground may be there and not be seen."""


def seen_up(facts: GroundFacts) -> Floats | None:
    """Up (3,) in the left camera's frame by the ground that a pair shows; None where little of it is seen."""
    if "seen_up" in facts:
        return np.array(facts["seen_up"])
    return _normal(facts) if facts["plane"] and facts["ground_share"] >= MIN_REFERENCE_SHARE else None


def camera_height(facts: GroundFacts) -> float:
    """Height, m, of the left camera above a pair's plane, along its normal."""
    assert facts["plane"] is not None
    x, y, z = facts["plane"]
    return -z / math.sqrt(x * x + y * y + 1.0)


def _normal(facts: GroundFacts) -> Floats:
    """Unit normal (3,) of a pair's plane in the left camera's frame."""
    assert facts["plane"] is not None
    x, y, _ = facts["plane"]
    local = np.array([-x, -y, 1.0]) / math.sqrt(x * x + y * y + 1.0)
    return RigidTransform.from_matrix(facts["T_local_left"]).rotation.T @ local


class GroundVerdict(NamedTuple):
    """Whether elevations are heights above ``ground``, and ``why``, in words."""

    ground: bool
    why: str


def judge(levels: Sequence[GroundFacts], *, coarse: bool) -> GroundVerdict:
    """Whether the pairs of a run show ground.

    ``coarse``: a cell size is stated, so that ground counts which is too far away for cells that suit the rig.
    """
    planes = [_Plane.of(facts) for facts in levels if facts["plane"] and ("no_ground" not in facts or coarse)]
    shown = [plane for plane in planes if plane.is_ground or sum(map(plane.is_same, planes)) > 1]
    others = [facts["other_up"] for facts in levels if "other_up" in facts]
    why = f"{len(shown)} of {len(levels)} pairs show ground"
    if others:
        up = ", ".join(f"{v + 0.0:.2f}" for v in others[0])
        stated = f"state its normal [{up}] as world.up"
        if np.min(np.array(others) @ others[0]) < math.cos(math.radians(MAX_TURN_DEG)):
            stated = "the camera rolls from pair to pair: state an [attitude] or [imu], for world.up is one for all,"
        why += f", {len(others)} another plane (if it is the ground, {stated} in a manifest)"
    blind = [facts["matched_below"] for facts in levels if facts.get("matched_below", 1.0) < MIN_MATCHED_BELOW]
    if blind:
        why += (
            f"; of {len(blind)} of the pairs less than half of the lowest quarter of the left image is matched (at "
            f"least {min(blind):.0%}): ground that lies there shows no texture, or is hidden"
        )
    if planes and not shown:
        best = max(planes, key=lambda plane: plane.share)
        why += (
            f"; a level plane holds {best.share:.0%} of the matched pixels and is seen as far as {best.reach:.1f} "
            f"camera heights, where {MIN_REFERENCE_SHARE:.0%} or {MIN_REACH_HEIGHTS:g} heights, a known vertical or "
            "another pair with the same plane would show ground (terrain.reference=ground takes it for that)"
        )
    coarse_only = [facts for facts in levels if facts["plane"] and "no_ground" in facts]
    if coarse_only and not planes:
        share = coarse_only[0]["ground_share"]
        why += f"; a plane that may be ground holds {share:.0%} of the matched pixels: {coarse_only[0]['no_ground']}"
    return GroundVerdict(len(shown) > len(others), why)


class _Plane(NamedTuple):
    """Plane of a pair that may be ground: unit normal ``up`` (3,) in the left camera's frame, ``height`` of the camera
    above it, m, whether it ``is_ground`` by itself, ``share`` of the matched pixels, and ``reach``, camera heights."""

    up: Floats
    height: float
    is_ground: bool
    share: float
    reach: float

    @staticmethod
    def of(facts: GroundFacts) -> _Plane:
        """Read the plane of a pair."""
        up = _normal(facts)
        level = float(RigidTransform.from_matrix(facts["T_local_left"]).rotation[2] @ up)
        share, reach = facts["ground_share"], facts["ground_reach"]
        is_known = facts["source"] not in (GROUND_PLANE, NO_VERTICAL)
        is_level = is_known and level >= math.cos(math.radians(10.0))
        # Ground that is stated (``ground_frame.reference_height``), not seen, has a share of 0.
        is_ground = is_level or share >= MIN_REFERENCE_SHARE or reach >= MIN_REACH_HEIGHTS or share == 0.0
        return _Plane(up, camera_height(facts), is_ground, share, reach)

    def is_same(self, other: _Plane) -> bool:
        """Whether another pair shows the same plane."""
        turn = float(self.up @ other.up)
        change = abs(self.height - other.height) / max(self.height, other.height)
        return turn >= math.cos(math.radians(MAX_TURN_DEG)) and change <= 0.25
