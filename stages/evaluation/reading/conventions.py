"""Whether truth would fit the trajectory if its file were read by another convention; no estimate is changed by this.

Readings differ in the order of the quaternion, the direction of the transform, a mirrored axis, the order of the poses,
the unit of length, and the axes of the body: a rotation B from the right, one of the 24 that exchange axes or the one
that fits best. Readings are compared by the misfit of positions and orientations together after the best rotation and
translation of the world (:mod:`rille.stages.geometry.rigid`), over the extent of the trajectory. A drive that is
straight or hardly turns is fitted by several readings alike, which are named together.
"""

from __future__ import annotations

from itertools import accumulate, product
from typing import NamedTuple

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.evaluation.imu_check import signed_axes
from rille.stages.geometry.geometry import RigidTransform, orthonormal
from rille.stages.geometry.rigid import alignment, angle, compose, inverse, rms, spread, standing_out

MIN_FRAMES, MAX_FRAMES = 4, 50
# Misfit over the extent, as read, up to which the estimate's own errors explain it; largest share of it, and of the
# extent, that another reading may leave; and the misfit above which no estimate errs as much.
MIN_MISFIT, MAX_SHARE, MAX_MISFIT, MUCH = 0.02, 0.4, 0.1, 0.3
# Least turn of a body against the camera, radians: an estimate's own errors look like smaller ones.
MIN_TURN = 0.3
# Factor of length above which it is no error of the estimate; units, m: mm, cm, inches, feet, yards, km.
MIN_UNIT, UNITS = 1.3, (0.001, 0.01, 0.0254, 0.3048, 0.9144, 1000.0)
# Places, in (x, y, z, w) as read, of the true x, y, z and w.
ORDERS = {
    "": [0, 1, 2, 3],
    "its quaternions begin with w: write x y z w, or state truth.format = 'euroc'": [1, 2, 3, 0],
    "its quaternions end with w: write w x y z, or state truth.format = 'tum'": [3, 0, 1, 2],
}
DIRECTIONS = (
    "",
    "its poses lead from the world to the camera: invert each, [R | t] to [R' | -R' t]",
    "its rotations lead from the world to the camera: negate qx, qy and qz, or transpose each R",
)
LEFT_HANDED = "it is left-handed, or the images of both cameras are mirrored"
MIRRORS = {
    "": (1.0, 1.0, 1.0),
    f"{LEFT_HANDED}: negate x, qy and qz": (-1.0, 1.0, 1.0),
    f"{LEFT_HANDED}: negate y, qx and qz": (1.0, -1.0, 1.0),
    f"{LEFT_HANDED}: negate z, qx and qy": (1.0, 1.0, -1.0),
}


class ReadingFit(NamedTuple):
    """Misfit of a reading over the extent; its number of changes; remedy."""

    misfit: float
    changes: int
    words: str


def better_reading(
    estimate: Floats, truth: Floats, T_body_left: RigidTransform, sigma: float, mounted: Floats | None = None
) -> list[str]:
    """Warnings that the truth fits far better by other conventions than as it was read, with the remedy.

    Parameters
    ----------
    estimate : (frame, 3, 4) T_world_left, m, of the frames that have truth, too.
    truth : (frame, 3, 4) T_truth_left as read.
    T_body_left : by which the file's poses were multiplied.
    sigma : m, of the estimated positions.
    mounted : (frame, 3, 4) truth with the mounting corrected (:mod:`.hand_eye`), for which no warning is due here.
    """
    chosen = np.linspace(0, len(estimate) - 1, min(len(estimate), MAX_FRAMES)).astype(int)
    P, Q, mount = estimate[chosen], truth[chosen], T_body_left.matrix34
    # An extent of a few standard deviations is that of a camera at rest.
    if len(P) < MIN_FRAMES or spread(P) < max(5.0 * sigma, 1e-6):
        return []
    if spread(Q) < 1e-6 * spread(P):
        return [f"the truth rests, the trajectory extends {spread(P):.3g} m: is it the right file, and does it go on?"]
    as_read, file = _misfit(P, Q), compose(Q, inverse(mount))
    jumps = _jumps(estimate, truth, sigma)
    if jumps or as_read < MIN_MISFIT:
        return jumps
    fits = [] if mounted is None else [ReadingFit(_misfit(P, mounted[chosen]), 2, "")]
    if not np.allclose(mount, np.eye(3, 4)):
        turned = compose(file, inverse(mount))
        fits.append(ReadingFit(_misfit(P, turned), 0, "truth.T_body_left leads from the body to the camera: invert it"))
    fits += _fits(P, Q[::-1], mount, ["it runs backwards: reverse its rows, or the order of the images"])
    for order, direction, mirror in product(ORDERS, DIRECTIONS, MIRRORS):
        # A file that begins with the identity has its quaternions in the right order.
        if not (order and angle(file[0]) < MIN_TURN):
            poses, signs = file.copy(), MIRRORS[mirror]
            kind = scipy.spatial.transform.Rotation
            quaternion = kind.from_matrix(file[:, :, :3]).as_quat()[:, ORDERS[order]]
            poses[:, :, :3] = kind.from_quat(quaternion).as_matrix()
            # The whole pose is inverted, or its rotation alone; or nothing.
            columns = slice((0, 4, 3)[DIRECTIONS.index(direction)])
            poses[:, :, columns] = inverse(poses)[:, :, columns]
            words = [word for word in (order, direction, mirror) if word]
            # M R M and M t of a mirror M = diag(signs).
            fits += _fits(P, compose(poses * np.outer(signs, [*signs, 1.0]), mount), mount, words)
    best = min(fit.misfit for fit in fits)
    if best > min(MAX_SHARE * as_read, MAX_MISFIT):
        text = (
            f"the truth does not fit the trajectory: {as_read:.0%} of its extent are left, {best:.0%} at least by other"
        )
        doubt = "conventions: is it of this drive, and are its columns, and the order of the images, right?"
        return [f"{text} {doubt}"] if as_read > MUCH else []
    # The simplest of those that fit: an estimate's own errors may favour one of more changes by a factor of 4. Up to
    # 0.005 of the extent readings cannot be told apart.
    most = min(MAX_SHARE * as_read, 4.0 * best + 0.005)
    changes = min(fit.changes for fit in fits if fit.misfit <= most)
    simple = sorted(fit for fit in fits if fit.changes == changes)
    simple = [fit for fit in simple if fit.misfit <= 1.5 * simple[0].misfit + 0.005]
    told = list(dict.fromkeys(fit.words for fit in simple))
    if "" in told:
        return []
    return [
        f"the truth fits the trajectory far better by another convention ({100 * best:.2g} % of its extent are left, "
        f"{100 * as_read:.3g} % as read): {'; or: '.join(told)}"
        + ("; this drive cannot tell these apart" if len(told) > 1 else "")
    ]


def _jumps(P: Floats, Q: Floats, sigma: float) -> list[str]:
    """Warning if the truth Q (n, 3, 4) fits P but for a few motions, which depart far more than the others; ``sigma``,
    m, of a position of P."""
    moved, said = (compose(inverse(T[:-1]), T[1:]) for T in (P, Q))
    off = np.linalg.norm(moved[:, :, 3] - said[:, :, 3], axis=1)
    jumps = np.flatnonzero(standing_out(off, 3.0 * sigma))
    said[jumps] = moved[jumps]
    steady = np.array(list(accumulate(said, compose, initial=Q[0])))
    if not len(jumps) or _misfit(P, steady) > MAX_SHARE * _misfit(P, Q):
        return []
    text = (
        f"after {jumps[0] + 1} of its {len(Q)} poses, usually by {np.median(off):.2g} m: correct or remove poses there"
    )
    return [
        f"the truth jumps by {off[jumps[0]]:.3g} m against the trajectory {text}, unless it is the trajectory's error"
    ]


def _fits(P: Floats, Q: Floats, mount: Floats, words: list[str]) -> list[ReadingFit]:
    """Fits of a reading Q (n, 3, 4) of the truth with the best unit and several axes of the body."""
    ratio, fits = spread(P) / max(spread(Q), 1e-12), []
    if not 1.0 / MIN_UNIT < ratio < MIN_UNIT:
        unit = next((unit for unit in UNITS if abs(np.log(unit / ratio)) < 0.1), float(f"{ratio:.3g}"))
        if words and unit not in UNITS:
            return []  # two mistakes of which one has any size explain too much
        doubt = "" if unit in UNITS else ", unless its clock runs otherwise, or the rig's baseline is wrong"
        words = [*words, f"its unit of length is {unit:g} m: state truth.unit = {unit:g}{doubt}"]
        Q = Q * [1.0, 1.0, 1.0, unit]
    exchanges = [S for S in signed_axes() if np.linalg.det(S) > 0]
    for start in (exchanges[0], min(exchanges, key=lambda B: _misfit(P, Q @ _turn(B)))):
        turn = start
        for _ in range(10):
            # In turn: the world's rotation for this body, mostly by positions, and the body's rotation for this world.
            R_world_truth = alignment(Q @ _turn(turn), P, 0.1)[:, :3]
            turn = orthonormal(np.einsum("nji,kj,nkl->il", Q[:, :, :3], R_world_truth, P[:, :, :3]))
        # Smaller turns are due to errors of the estimate, not to another convention.
        axes = start if angle(start.T @ turn) < MIN_TURN else turn
        said, other = words, bool(angle(axes) > MIN_TURN)
        if other:
            body = np.column_stack([mount[:, :3] @ axes, mount[:, 3]]).round(4) + 0.0
            said = [*words, f"its poses are those of a body with other axes: state truth.T_body_left = {body.tolist()}"]
        # Turned axes count as one change more than exchanged ones.
        changes = len(said) + (axes is turn)
        fits.append(ReadingFit(_misfit(P, Q @ _turn(axes)), changes, " and ".join(said)))
    return fits


def _turn(axes: Floats) -> Floats:
    """Matrix (4, 4) that turns the axes of the body, from the right, by a rotation (3, 3)."""
    return np.asarray(scipy.linalg.block_diag(axes, 1.0))


def _misfit(P: Floats, Q: Floats) -> float:
    """RMS misfit of poses Q (n, 3, 4) after the best alignment with P, over P's extent."""
    off = compose(alignment(Q, P, 1.0), Q) - P
    # An angle of one radian counts like a position error of the extent.
    return float(np.hypot(rms(off[:, :, 3]) / spread(P), rms(off[:, :, :3].reshape(len(P), 9)) / np.sqrt(2.0)))
