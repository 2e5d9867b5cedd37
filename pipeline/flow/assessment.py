"""Comparisons with truth: only these tasks of a reconstruction read the truth, and no estimate reads them.

::

    trajectory, crosscheck (main pieces) --> accuracy, position_accuracy (by true poses or positions)
    trajectory, crosscheck ----------------> agreement (it needs none)
    hfvm ----------------------------------> disparity_accuracy <-- truth_disparity
    locus (local), merge ------------------> dem_accuracy <-- truth_dem (exact elevations)
    path ----------------------------------> path_check <-- risk (of these)
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any

from rille.pipeline.engine.graph import Wait, done
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.flow.builders import Builder, Pair
from rille.stages.evaluation.accuracy import accuracy_stage
from rille.stages.evaluation.agreement import agreement_stage
from rille.stages.evaluation.dem_accuracy import dem_accuracy_stage
from rille.stages.evaluation.disparity_accuracy import disparity_accuracy_stage
from rille.stages.evaluation.path_check import path_check_stage
from rille.stages.evaluation.position_accuracy import position_accuracy_stage
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice, union

Flow = Generator[Wait, Any, None]


def of_trajectory(make: Builder, frames: Sequence[int]) -> None:
    """Compare the trajectory with the other program's, and both with the truth, if there is one."""
    p, s = make.products, make.sequence
    if p.crosscheck is not None:
        p.agreement = make.node(agreement_stage, "agreement", trajectory=p.trajectory, crosscheck=p.crosscheck)
    if s.truth_positions is not None:
        true, moments = s.truth_positions.to_dict(), s.times and [s.times[f] for f in frames]
        if s.truth_positions.times is None:
            true["positions"], moments = [s.truth_positions.positions[f] for f in frames], None
        given = {"truth": true, "moments": moments, "frames": list(frames)}
        p.position_accuracy = make.node(position_accuracy_stage, "position_accuracy", trajectory=p.trajectory, **given)
    poses = [None if (pose := _truth(make, f)) is None else pose.to_list() for f in frames]
    # No task for no truth: the report then says that there is none, not that it failed.
    if any(poses):
        known = {"truth": poses, "frames": list(frames)}
        source = {
            "mount": (s.truth_mount or RigidTransform.identity()).to_list(),
            "sigmas": [s.truth_sigma_m, s.truth_sigma_rad],
            "record": s.truth_record and s.truth_record.to_dict(),
            "moments": s.times and [s.times[f] for f in frames],
        }
        p.accuracy = make.node(accuracy_stage, "accuracy", trajectory=p.trajectory, source=source, **known)
        if p.crosscheck is not None:
            p.crosscheck_accuracy = make.node(accuracy_stage, "accuracy/crosscheck", trajectory=p.crosscheck, **known)


def of_pair(make: Builder, pair: Pair) -> Flow:
    """Compare the disparity of a pair and its local elevation model with the truth."""
    exact_disparity = make.sequence.truth_disparity
    if exact_disparity is not None and (known := exact_disparity(pair.frame)) is not None:
        true = make.source(known, f"truth_disparity/{pair.frame}")
        make.products.disparity_accuracy[pair.frame] = make.node(
            disparity_accuracy_stage, f"disparity_accuracy/{pair.frame}", disparity=pair.disparity, truth=true
        )
    exact, T_truth_left, cut = make.sequence.truth_dem, _truth(make, pair.frame), make.graph.cut
    if exact is None or T_truth_left is None or (cut and "dem_accuracy" not in cut.stages):
        return
    level, dem = (yield from done(pair.level)), (yield from done(pair.dem))
    source = exact(dem.meta["lattice"], _levelled(T_truth_left, level), (pair.frame,))
    window = make.sequence.evaluation_window
    make.products.local_dem_accuracy[pair.frame] = make.node(
        dem_accuracy_stage,
        f"dem_accuracy/local/{pair.frame}",
        dem=[pair.dem],
        truth=make.source(source, f"truth_dem/local/{pair.frame}"),
        window=None if window is None else list(window),
    )


def of_world(make: Builder, pairs: Sequence[Pair]) -> Flow:
    """Compare the merged elevation model with the truth; judge the path by the hazards of the exact model."""
    p, first, exact = make.products, pairs[0], make.sequence.truth_dem
    if exact is None or (T_truth_left := _truth(make, first.frame)) is None:
        return
    level = yield from done(first.level)
    whole = union(Lattice.from_dict(tile.spec.args["lattice"]) for tile in p.world_tiles)
    source = exact(whole.to_dict(), _levelled(T_truth_left, level), tuple(pair.frame for pair in pairs))
    true = make.source(source, f"truth_dem/world/{first.frame}")
    p.dem_accuracy = make.node(dem_accuracy_stage, "dem_accuracy/world", dem=p.world_tiles, truth=true)
    if p.world_path is not None:
        true_risk = make.hazards("risk/truth", [true])
        p.path_check = make.node(path_check_stage, "path_check", path=p.world_path, risk=true_risk)


def _truth(make: Builder, frame: int) -> RigidTransform | None:
    return None if make.sequence.truth is None else make.sequence.truth[frame]


def _levelled(T_truth_left: RigidTransform, level: Ref[GroundFacts]) -> RigidTransform:
    """Pose in the truth of the levelled frame of a pair (of the first one: the world)."""
    return T_truth_left @ RigidTransform.from_matrix(level.meta["T_local_left"]).inverse()
