"""3-D coordinates of interest points of the key frame: from the disparity, or from the elevation model.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2: "the 3D coordinates of the Interest Points on Frame N are
calculated from the DEM and the calibration matrix of Frame N". The triangulation of the matched point itself is our
alternative: it skips one interpolation. Both give the local frame's coordinates and how uncertain they are along the
ray, ``sigma_Z = sigma_d / |dp_r/dZ|`` (the familiar ``Z^2 / (f B) sigma_d`` of a parallel rig).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.odometry.affinity import known, solve_3

MATCHED = np.uint8(Validity.MATCHED)
CONSISTENT = 1.0
"""Pixels: neighbours whose disparities differ by more lie on two surfaces; also the bound of back-matching (4.3.3)."""
TEMPLATE = 5
"""Half the side of a template, pixels (see stages.odometry.affine_lk): what its relief is taken over."""


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of a basic pair, with the derivative and the standard deviation of their coordinates.

    Attributes
    ----------
    position : (n, 3) in the local frame, m; NaN if a landmark has no coordinates.
    per_pixel : (n, 3) motion along the ray, away from the camera, for a change of the disparity by a pixel, m/pixel.
    sigma : (n,) standard deviation of the disparity, pixels.
    lost : number of landmarks without coordinates, by reason.
    """

    position: Floats
    per_pixel: Floats
    sigma: Floats
    lost: dict[str, int]

    def summary(self) -> str:
        """The counts in words."""
        return ", ".join(f"{count} {reason}" for reason, count in self.lost.items() if count) or "none lost"

    def take(self, which: NDArray[np.intp]) -> Landmarks:
        """Some of them."""
        return Landmarks(self.position[which], self.per_pixel[which], self.sigma[which], self.lost)


def landmarks_from_disparity(
    points: Floats,
    maps: tuple[Floats32, Floats32, Bytes],
    rig: Rig,
    T_local_left: RigidTransform,
    disparity_sigma: Floats,
    *,
    max_depth_ratio: float,
) -> Landmarks:
    """Triangulate the stereo matches of points (n, 2) column, row of the left key image; ``maps`` (rows, cols): column
    and row disparity, pixels, and validity.

    A point needs four matched (not filled) neighbours on one surface, rays that meet within a pixel in front of both
    cameras, and a distance whose standard deviation is below ``max_depth_ratio`` of it. ``disparity_sigma`` (n,) is in
    pixels; NaN refuses a point (see :func:`relief`).
    """
    disparity, matched = matches_at(points, *maps)
    rays = rig.left.rays(points)
    depth = _triangulate(rays, points + disparity, rig)
    right, _ = _right_image(rays, depth, rig)
    miss = np.sqrt(((right - points - disparity) ** 2).sum(-1))
    meets = matched & (depth > 0) & (miss <= CONSISTENT)
    lost = {
        "without a consistent stereo match": int((~matched).sum()),
        "whose rays do not meet": int((matched & ~meets).sum()),
    }
    return _landmarks(rays, np.where(meets, depth, np.nan), rig, T_local_left, disparity_sigma, max_depth_ratio, lost)


def triangulated(
    points: Floats, right: Floats, rig: Rig, T_local_left: RigidTransform, disparity_sigma: Floats
) -> Landmarks:
    """Landmarks of matches (n, 2) in both images; NaN where the rays do not meet in front of the cameras."""
    rays = rig.left.rays(points)
    depth = _triangulate(rays, right, rig)
    return _landmarks(rays, np.where(depth > 0, depth, np.nan), rig, T_local_left, disparity_sigma, np.inf, {})


def matches_at(points: Floats, column: Floats32, row: Floats32, validity: Bytes) -> tuple[Floats, Bools]:
    """Disparity vectors (n, 2) by bilinear interpolation, and whether the four neighbours are matched and agree."""
    rows, cols = column.shape
    there = known(points)
    p = np.where(there[:, None], points, 0.0)
    inside = there & (p >= 0).all(1) & (p[:, 0] <= cols - 1) & (p[:, 1] <= rows - 1)
    x = np.clip(np.floor(p[:, 0]), 0, cols - 2).astype(np.intp)
    y = np.clip(np.floor(p[:, 1]), 0, rows - 2).astype(np.intp)
    fx, fy = p[:, 0] - x, p[:, 1] - y
    # Bilinear by hand: scipy's would mix what is not matched into its neighbours, where here the whole point is
    # refused.
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    y4, x4 = y[:, None] + np.array([0, 0, 1, 1]), x[:, None] + np.array([0, 1, 0, 1])
    corners = np.stack([column[y4, x4], row[y4, x4]], -1).astype(np.float64)
    # A corner of weight 0 (the point is on the pixel grid) may be anything.
    needed = weights > 1e-9
    good = (((validity[y4, x4] & MATCHED) != 0) & np.isfinite(corners).all(-1)) | ~needed
    corners = np.where(needed[..., None] & good[..., None], corners, np.nan)
    ok = inside & good.all(1)
    corners[~ok] = 0.0
    # Between two surfaces an interpolated disparity is that of neither.
    apart = np.nanmax(corners, axis=1) - np.nanmin(corners, axis=1)
    value = np.einsum("nk,nki->ni", weights, np.where(np.isfinite(corners), corners, 0.0))
    return value, ok & (apart <= CONSISTENT).all(1)


def relief(points: Floats, column: Floats32, row: Floats32, validity: Bytes) -> Floats:
    """Compute the relief under each template: RMS (n,) of the disparities about their plane, pixels.

    A template on a rock's edge follows the rock or the ground, not the pixel at its centre; both the stereo match and
    the track are then uncertain by the relief inside the template. NaN where that is beyond :data:`CONSISTENT`, since
    then there are two surfaces, or where less than half of the template is matched.
    """
    there = known(points)
    centre = np.floor(np.where(there[:, None], points, 0.0) + 0.5).astype(np.int64)
    rms = np.full(len(points), np.nan)
    _relief(centre, np.asarray(column), np.asarray(row), np.asarray(validity), rms)
    return np.where(there & (rms <= CONSISTENT), rms, np.nan)


@njit(cache=True, nogil=True)
def _relief(centre, column, row, validity, rms):  # type: ignore[no-untyped-def]
    """Rms about the fitted plane under each template of which at least half is matched."""
    rows, cols = column.shape
    a, b = np.empty((3, 3)), np.empty((3, 2))
    # Half of the template, rounded up.
    half = ((2 * TEMPLATE + 1) ** 2 + 1) // 2
    for n in range(len(centre)):
        a[:], b[:] = 0.0, 0.0
        x0, y0 = centre[n]
        for j in range(max(y0 - TEMPLATE, 0), min(y0 + TEMPLATE + 1, rows)):
            for i in range(max(x0 - TEMPLATE, 0), min(x0 + TEMPLATE + 1, cols)):
                u, v = np.float64(column[j, i]), np.float64(row[j, i])
                if validity[j, i] & MATCHED and np.isfinite(u) and np.isfinite(v):
                    # In units of the template, so that all sums are of the same size.
                    p, q = (i - x0) / TEMPLATE, (j - y0) / TEMPLATE
                    a[0, 0] += 1.0
                    a[0, 1] += p
                    a[0, 2] += q
                    a[1, 1] += p * p
                    a[1, 2] += p * q
                    a[2, 2] += q * q
                    b[0, 0] += u
                    b[1, 0] += p * u
                    b[2, 0] += q * u
                    b[0, 1] += v
                    b[1, 1] += p * v
                    b[2, 1] += q * v
        count = a[0, 0]
        if count < half:
            continue
        a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
        for k in range(3):
            # Matched pixels on a line leave the slope across open: it is 0 then.
            a[k, k] += 1e-9
        solve_3(a, b)
        plane = b  # solved in place
        total = 0.0
        for j in range(max(y0 - TEMPLATE, 0), min(y0 + TEMPLATE + 1, rows)):
            for i in range(max(x0 - TEMPLATE, 0), min(x0 + TEMPLATE + 1, cols)):
                u, v = np.float64(column[j, i]), np.float64(row[j, i])
                if validity[j, i] & MATCHED and np.isfinite(u) and np.isfinite(v):
                    p, q = (i - x0) / TEMPLATE, (j - y0) / TEMPLATE
                    total += (u - plane[0, 0] - p * plane[1, 0] - q * plane[2, 0]) ** 2
                    total += (v - plane[0, 1] - p * plane[1, 1] - q * plane[2, 1]) ** 2
        rms[n] = np.sqrt(total / count)


def _triangulate(rays: Floats, right: Floats, rig: Rig) -> Floats:
    """Depth (n,) in the left camera, m, of least distance in the right image; NaN where the rays do not meet."""
    a = rays @ rig.T_right_left.rotation.T
    t = rig.T_right_left.translation
    xy = rig.right.rays(right)[:, :2]
    # (Z a + t) x (x, y, 1) = 0, two linear equations in Z; then Gauss-Newton on the pixel distance itself.
    left_side = a[:, :2] - xy * a[:, 2:]
    right_side = xy * t[2] - t[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (left_side * right_side).sum(-1) / (left_side**2).sum(-1)
        # The linear solution minimises no distance in the image; from there two steps reach rounding.
        for _ in range(2):
            p, slope = _right_image(rays, depth, rig)
            depth = depth + ((right - p) * slope).sum(-1) / (slope**2).sum(-1)
    return np.where(np.isfinite(depth), depth, np.nan)


def _right_image(rays: Floats, depth: Floats, rig: Rig) -> tuple[Floats, Floats]:
    """Right image (n, 2) of points at a depth on left rays, pixels, and its derivative, pixels/m."""
    a = rays @ rig.T_right_left.rotation.T
    x = depth[:, None] * a + rig.T_right_left.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(x[:, 2] > 0, x[:, 2], np.nan)[:, None]
        focal = np.array([rig.right.fx, rig.right.fy])
        # Along the ray only: by one parameter, depth, not by the three of a point.
        slope = focal * (a[:, :2] * z - x[:, :2] * a[:, 2:]) / z**2
    return rig.right.project(x), slope


def _landmarks(
    rays: Floats,
    depth: Floats,
    rig: Rig,
    T_local_left: RigidTransform,
    disparity_sigma: Floats,
    max_depth_ratio: float,
    lost: dict[str, int],
) -> Landmarks:
    """Coordinates from depths (n,), NaN none, unless too uncertain."""
    found = np.isfinite(depth)
    _, slope = _right_image(rays, np.where(found, depth, 1.0), rig)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_pixel = 1.0 / np.sqrt((slope**2).sum(-1))
        spread = disparity_sigma * per_pixel
    smooth = found & np.isfinite(disparity_sigma)
    near = np.zeros(len(depth), bool)
    # Beyond, depth is no longer normal though disparity is, and first-order covariances are wrong.
    near[smooth] = spread[smooth] <= max_depth_ratio * depth[smooth]
    position = T_local_left.apply(rays * np.where(near, depth, np.nan)[:, None])
    along = np.where(near, per_pixel, np.nan)[:, None] * (rays @ T_local_left.rotation.T)
    border = {"on a depth edge or the border of what was matched": int((found & ~smooth).sum())}
    far = {"too far for the baseline": int((smooth & ~near).sum())}
    return Landmarks(position, along, np.where(near, disparity_sigma, np.nan), lost | border | far)


def landmarks_from_dem(
    points: Floats,
    elevation: Floats32,
    lattice: Lattice,
    rig: Rig,
    T_local_left: RigidTransform,
    disparity_sigma: Floats,
    *,
    max_depth_ratio: float,
) -> Landmarks:
    """Meet the rays of points (n, 2) column, row of the left key image with its elevation model (rows, cols), m.

    The uncertainty is that of the stereo pair which made the model: ``disparity_sigma`` (n,) pixels.
    """
    there = known(points)
    rays = rig.left.rays(np.where(there[:, None], points, 0.0))
    depth = intersect(elevation, lattice, T_local_left.translation, rays @ T_local_left.rotation.T)
    depth = np.where(there, depth, np.nan)
    lost = {"whose ray misses the elevation model": int((~np.isfinite(depth)).sum())}
    return _landmarks(rays, depth, rig, T_local_left, disparity_sigma, max_depth_ratio, lost)


def intersect(elevation: Floats32, lattice: Lattice, origin: Floats, directions: Floats) -> Floats:
    """Intersect rays with a surface of bilinear cells: distance (n,) in units of ``directions``; NaN without a hit.

    Starts above the highest cell, goes half a cell at a time and refines by bisection. A hole forgets what was
    before it: a ray that comes out of one below the surface has passed under it and is rejected.

    Parameters
    ----------
    elevation : (rows, cols), m; NaN undefined.
    origin : (3,) common origin of the rays in the frame of the lattice, m.
    directions : (n, 3) of any length.
    """
    out = np.full(len(directions), np.nan)
    if not np.isfinite(elevation).any():
        return out
    low, high = float(np.nanmin(elevation)), float(np.nanmax(elevation))
    x, y = lattice.xs(), lattice.ys()
    box = np.array([[x[0], x[-1]], [y[-1], y[0]], [low - lattice.cell, high + lattice.cell]])
    for i, direction in enumerate(directions):
        span = _span(box, origin, direction)
        if span is None:
            continue
        first, last = span
        step = 0.5 * lattice.cell / float(np.sqrt((direction**2).sum()))
        # No farther than the box: beyond it the surface would be extrapolated.
        s = np.minimum(np.arange(first, last + step, step), last)
        height = _height(elevation, lattice, origin, direction, s)
        seen = np.isfinite(height)
        below = np.flatnonzero(seen & (height <= 0))
        # Came out of a hole below the surface, or started there: it passed under, not through.
        if below.size == 0 or below[0] == 0 or not seen[below[0] - 1]:
            continue
        out[i] = _bisect(elevation, lattice, origin, direction, s[below[0] - 1], s[below[0]])
    return out


def _span(box: Floats, origin: Floats, direction: Floats) -> tuple[float, float] | None:
    """First and last parameter of the ray inside a box (3, 2), least and greatest coordinates; None: it misses."""
    first, last = 0.0, np.inf
    for axis in range(3):
        # A ray along an axis stays in or out of the box there.
        if direction[axis] == 0.0:
            if not box[axis, 0] <= origin[axis] <= box[axis, 1]:
                return None
            continue
        a, b = sorted((box[axis] - origin[axis]) / direction[axis])
        first, last = max(first, float(a)), min(last, float(b))
    return (first, last) if first < last < np.inf else None


def _height(elevation: Floats32, lattice: Lattice, origin: Floats, direction: Floats, s: Floats) -> Floats:
    """Height of the ray above the bilinear surface at parameters s (k,), m; NaN over holes."""
    p = origin + s[:, None] * direction
    index = lattice.index(p[:, :2])
    row = np.clip(np.floor(index[:, 0]), 0, max(lattice.rows - 2, 0)).astype(np.intp)
    col = np.clip(np.floor(index[:, 1]), 0, max(lattice.cols - 2, 0)).astype(np.intp)
    fr, fc = index[:, 0] - row, index[:, 1] - col
    below, right = np.minimum(row + 1, lattice.rows - 1), np.minimum(col + 1, lattice.cols - 1)
    top = elevation[row, col] * (1 - fc) + elevation[row, right] * fc
    bottom = elevation[below, col] * (1 - fc) + elevation[below, right] * fc
    return np.asarray(p[:, 2] - (top * (1 - fr) + bottom * fr))


def _bisect(
    elevation: Floats32, lattice: Lattice, origin: Floats, direction: Floats, above: float, below: float
) -> float:
    for _ in range(30):
        middle = 0.5 * (above + below)
        height = float(_height(elevation, lattice, origin, direction, np.array([middle]))[0])
        if not np.isfinite(height):
            return float("nan")
        above, below = (middle, below) if height > 0 else (above, middle)
    return 0.5 * (above + below)
