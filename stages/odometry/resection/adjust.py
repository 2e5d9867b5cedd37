"""Adjustment of the trajectory to other measurements between its frames: places seen again, other sensors.

The chain of segments (:mod:`rille.stages.odometry.resection.trajectory`) is a pose graph without loops: each frame is
measured from the key frame of its segment, with errors of its own and with those that all segments share. Factors
between other frames close loops in it, or join pieces between which the chain is broken; then all poses are adjusted
together (:mod:`rille.stages.odometry.pose_graph`). A factor that contradicts the others is left out and named.

Errors of the calibration are sources of the graph, too. They are in stated motions as in those of the chain (the more,
the longer the way), since both are measured with the same cameras: only other sensors determine them.

Pieces that factors join become one piece, in the frame of the first of them. Pieces without factors stay bit by bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.odometry import IntrinsicsFacts, LoopFacts, ResectFacts, TrajectoryFacts
from rille.stages.geometry.geometry import RigidTransform, rotation_log
from rille.stages.geometry.pose_arrays import NO_VERTICAL
from rille.stages.geometry.rigid import compose, lengths_along
from rille.stages.odometry.pose_graph import EXCESS, Adjusted, Factors, GraphState, PoseGraph, root_of
from rille.stages.odometry.resection.priors import Sensors
from rille.stages.odometry.resection.sensors import OwnTrajectory, moved
from rille.stages.odometry.resection.trajectory import Chained, ChainLink, account, trajectory_stage


def chain_factors(segments: Sequence[ChainLink], numbers: Sequence[Sequence[int]], row: Mapping[int, int]) -> Factors:
    """Factors from the key frame of each segment to its other frames; the sources of the calibration are the last.

    Parameters
    ----------
    segments : poses, covariances and shared errors in the frame of the key's pair.
    numbers : of the frames of each segment, the key first.
    row : node of each frame that has a pose.
    """
    ends, poses, covariances, shared = list[list[int]](), list[Floats](), list[Floats](), list[Floats]()
    for link, frames in zip(segments, numbers, strict=True):
        key = RigidTransform.from_matrix(link.poses[0])
        turn = np.kron(np.eye(2), key.rotation.T)
        for k, frame in enumerate(frames[1:], start=1):
            if frame not in row or frames[0] not in row or not np.isfinite(link.poses[k]).all():
                continue
            common = link.shared[k]
            ends.append([row[frames[0]], row[frame]])
            poses.append((key.inverse() @ RigidTransform.from_matrix(link.poses[k])).matrix34)
            covariances.append(turn @ (link.covariance[k] - common @ common.T) @ turn.T)
            shared.append(turn @ np.hstack([common, link.calibration[k]]))
    return Factors.of(
        np.array(ends, np.intp).reshape(-1, 2),
        np.array(poses).reshape(-1, 3, 4),
        root_of(np.array(covariances).reshape(-1, 6, 6)),
        shared=np.array(shared) if shared else None,
    )


def stated_factors(given: Sequence[Mapping[str, Any]], row: Mapping[int, int]) -> Factors:
    """Factors as facts state them (``from``, ``to``, ``pose``, ``covariance``); ``row`` is the node of each frame."""
    covariance = np.array([one["covariance"] for one in given], dtype=np.float64).reshape(-1, 6, 6)
    ends = np.array([[row[one["from"]], row[one["to"]]] for one in given], np.intp).reshape(-1, 2)
    poses = np.array([one["pose"] for one in given], dtype=np.float64).reshape(-1, 3, 4)
    return Factors.of(ends, poses, root_of(covariance), components=6)


def measured_alike(stated: Factors, chain: Factors, calibration: int) -> Factors:
    """Stated factors with the sources of the chain, of which the last ones, of the ``calibration``, show in them, too.

    By the way from one end to the other as they show in the chain on average: a least-squares fit.
    """
    count, sources = len(stated.ends), chain.shared.shape[2]
    seen = np.zeros((count, 6, sources))
    if len(chain.ends) and calibration:
        # 0.03: of the chain's ways along a direction, over those along the main one, for it to tell errors along that
        # direction.
        per_way = np.linalg.lstsq(
            chain.poses[:, :, 3], chain.shared[:, :, -calibration:].reshape(len(chain.ends), -1), rcond=0.03
        )[0]
        seen[:, :, -calibration:] = (stated.poses[:, :, 3] @ per_way).reshape(count, 6, calibration)
    return replace(stated, shared=seen)


def join(own: OwnTrajectory, factors: Factors, sure: Bools) -> OwnTrajectory:
    """Pieces laid together by the factors between them, each by the one that most others agree with.

    Within a piece the chain contradicts a place that is taken for another. Between two pieces only a second factor can,
    so one alone joins them only if it is ``sure``.

    Parameters
    ----------
    own : its poses are in a common frame afterwards as far as factors join their pieces.
    sure : which factors (m,) need no other that agrees about with them.
    """
    poses, piece = own.poses, own.piece
    while True:
        pieces = np.sort(piece[factors.ends], axis=1)
        for first, other in np.unique(pieces[pieces[:, 0] != pieces[:, 1]], axis=0):
            rows = np.flatnonzero((pieces == [first, other]).all(1))
            here = factors.take(rows)
            graph = PoseGraph(here, len(poses), np.ones(len(rows)))
            laid = [
                _moved(poses, piece == other, ends, pose) for ends, pose in zip(here.ends, here.motions, strict=True)
            ]
            states = (GraphState.of(one, here.shared.shape[2]) for one in laid)
            squares = np.array([(graph.errors(state) ** 2).sum(1) for state in states])
            joins = sure[rows] | ((squares <= EXCESS[-1] ** 2 * here.bound).sum(1) > 1)
            if joins.any():
                costs = np.where(joins, np.minimum(squares, here.bound).sum(1), np.inf)
                poses, piece = laid[int(np.argmin(costs))], np.where(piece == other, first, piece)
                break
        else:
            return own._replace(poses=poses, piece=piece)


def _moved(poses: Floats, rows: Bools, ends: NDArray[np.intp], pose: Floats) -> Floats:
    """Poses (n, 3, 4); those of some rows are moved together so that a factor with one end in them holds."""
    a, b, measured = (RigidTransform.from_matrix(T) for T in (*poses[ends], pose))
    return moved(poses, rows, a @ measured @ b.inverse() if rows[ends[1]] else b @ measured.inverse() @ a.inverse())


def _left_out(one: Mapping[str, Any], adjusted: Floats) -> str:
    """Line on a factor that contradicts: by how much it departs from the adjusted poses (2, 3, 4) of its ends."""
    a, b = (RigidTransform.from_matrix(T) for T in adjusted)
    off = RigidTransform.from_matrix(one["pose"]).inverse() @ a.inverse() @ b
    turn = math.degrees(np.linalg.norm(rotation_log(off.rotation)))
    return (
        f"the motion from frame {one['from']} to frame {one['to']} ({one['source']}) contradicts the "
        f"others by {np.linalg.norm(off.translation):.2g} m and {turn:.2g} degrees: it is left out"
    )


@stage("adjust", outputs=trajectory_stage.outputs)
def adjust_stage(
    params: NoParams,
    trajectory: Bundle[TrajectoryFacts],
    segments: Sequence[Bundle[ResectFacts]],
    loops: Sequence[Bundle[LoopFacts]] = (),
    intrinsics: Bundle[IntrinsicsFacts] | None = None,
    *,
    priors: Mapping[str, Any] | None = None,
) -> Bundle[TrajectoryFacts]:
    """Poses of all left frames, adjusted to places seen again and to what other sensors say."""
    frames = trajectory.meta["frames"]
    out = Chained.of(trajectory)
    posed = np.flatnonzero(out.piece >= 0)
    row = {frames[k]: node for node, k in enumerate(posed)}
    numbers = [[int(f["frame"]) for f in bundle.meta["per_frame"]] for bundle in segments]
    links = [ChainLink.of(bundle, intrinsics) for bundle in segments]
    calibration = links[0].calibration.shape[2] if links else 0
    chain = chain_factors(links, numbers, row)
    given = [one for bundle in loops for one in bundle.meta["factors"] if one["from"] in row and one["to"] in row]
    stated = measured_alike(stated_factors(given, row), chain, calibration)
    sensors = Sensors.of(priors or {}, frames)
    own = OwnTrajectory(out.poses[posed], out.piece[posed], sensors.times[posed], posed)
    sensors.drop_contradicting(own, upright=NO_VERTICAL not in trajectory.meta["verticals"])
    between = Factors.joined([stated, *sensors.relative_factors(own)])
    sure = np.arange(len(between.ends)) >= len(given)
    apart, own = own.poses, sensors.joined_by_positions(join(own, between, sure))
    alone = own.piece[stated.ends[:, 0]] != own.piece[stated.ends[:, 1]]
    lines = [
        f"frames {given[k]['from']} and {given[k]['to']} alone link their pieces, which are not joined"
        for k in np.flatnonzero(alone)
    ]
    known, excess, lengths, contradiction = chain.beside(stated), 1.0, np.zeros(2), {}
    for nodes, inside, done in adjusted_pieces(own, apart, known, sensors):
        excess = max(excess, done.graph.excess)
        lengths += [lengths_along(poses[:, :, 3])[-1] for poses in (own.poses[nodes], done.state.poses[:-1])]
        sources = known.shared.shape[2]
        _write(out, posed[nodes], done, slice(sources - calibration, sources))
        for k in np.flatnonzero(~done.kept[: len(inside)]):
            ends = np.searchsorted(nodes, known.ends[inside[k]])
            lines.append(_left_out(given[inside[k] - len(chain.ends)], done.state.poses[ends]))
    if excess > 1.0:
        text = f"the camera's own errors are about {excess:.0f} times those stated: all covariances grow by that"
        if abs((longer := lengths[1] / max(lengths[0], 1e-12)) - 1.0) > 0.01 and sensors.used:
            text += f"; by {' and '.join(f'[{name}]' for name in sensors.used)} its ways are {longer:.3f} times as long"
            text += ", elevations are not: correct the baseline, or the sensor's unit and scale"
        lines.append(text)
        # Without sensors places seen again alone ask for it.
        contradiction = {"contradiction": text} if sensors.used and excess > sensors.alone else {}
    # Some hold for several pieces alike.
    lines = list(dict.fromkeys([*lines, *sensors.lines]))
    return _bundle(trajectory, out, lines, {"excess": excess, "priors": sensors.facts, **contradiction})


Piece = tuple[NDArray[np.intp], NDArray[np.intp], Adjusted]


def adjusted_pieces(own: OwnTrajectory, apart: Floats, known: Factors, sensors: Sensors) -> Iterator[Piece]:
    """Nodes of each piece that is adjusted, the numbers of the factors between them, and their adjustment.

    A piece whose joining factors contradict the others falls into parts, each adjusted by itself and in the frame of
    its first piece: ``apart`` (n, 3, 4) are poses in the frames of their pieces.
    """
    waiting = [np.flatnonzero(own.piece == number) for number in np.unique(own.piece)]
    for nodes in waiting:
        inside = np.flatnonzero(np.isin(known.ends, nodes).all(1))
        ends = np.searchsorted(nodes, known.ends[inside])
        parts, done = sensors.adjusted(own.take(nodes), replace(known.take(inside), ends=ends))
        if done is not None:
            yield nodes, inside, done
        elif parts.any():
            sensors.lines.append("what joined pieces of the trajectory contradicts the rest: they are not joined")
            for part in (nodes[parts == k] for k in np.unique(parts)):
                before, after = (RigidTransform.from_matrix(poses[part[0]]) for poses in (own.poses, apart))
                own.poses[part] = compose((after @ before.inverse()).matrix34, own.poses[part])
                waiting.append(part)


def _write(out: Chained, rows: NDArray[np.intp], done: Adjusted, calibration: slice) -> None:
    """Write the adjusted poses into these rows, which are one piece now.

    ``calibration`` are the sources that are errors of it.
    """
    exact = replace(done.graph.factors, shared=done.graph.factors.shared.copy())
    exact.shared[:, :, calibration] = 0.0
    # The place of positions and of the vertical is a node behind the frames.
    out.poses[rows] = done.state.poses[:-1]
    out.covariance[rows] = done.graph.covariance(done.state)[:-1]
    out.own_covariance[rows] = replace(done.graph, factors=exact).covariance(done.state)[:-1]
    out.piece[rows] = out.piece[rows].min()


def _bundle(
    before: Bundle[TrajectoryFacts], out: Chained, lines: list[str], more: Mapping[str, Any]
) -> Bundle[TrajectoryFacts]:
    """Arrays and facts as of stage ``trajectory``."""
    kept, out.piece[out.piece >= 0] = np.unique(out.piece[out.piece >= 0], return_inverse=True)
    chained, causes = before.meta, {int(frame): cause for frame, cause in before.meta["causes"].items()}
    facts = account(chained["frames"], out, causes, [chained["verticals"][k] for k in kept])
    meta: TrajectoryFacts = {
        **chained,
        **facts,  # type: ignore[typeddict-item]
        **more,
        # What the chain lacked or seemed to do is judged anew.
        "warnings": [*facts["warnings"], *chained["odd_verticals"], *lines],
    }
    return Bundle(vars(out), meta)
