"""Reference plane of a stereo pair, straight from the disparity, and the part of it that the pair can reconstruct.

The inverse depth 1/Z of a plane n . X = -h (camera frame, n up, h the camera's height above it) is linear in the ray r
= (x, y, 1): 1/Z = theta . r with theta = -n / h. And the error of 1/Z is the disparity's, the same near and far. So the
plane is a linear fit with uniform noise ("v-disparity" and its kin, Labayrade et al. 2002,
doi:10.1109/IVS.2002.1188024), for any rig: the inverse depth comes from the projection on the local epipolar line.

Any plane of the scene is fitted alike; its normal decides whether it may be the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.epipolar import inverse_depth
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.scale import coarser_focal
from rille.stages.numeric.least_squares import irls
from rille.stages.terrain.points import MIN_DEPTH_SIGMAS


class NoGroundError(DegenerateError):
    """The disparity shows no ground."""


class CoarseGroundError(NoGroundError):
    """The disparity shows ground, but not well enough for cells of the wanted size."""


@dataclass(frozen=True)
class GroundPlane:
    """Plane of the left camera frame: ``up`` unit normal (3,), ``height`` of the camera above it in metres.

    ``inliers``: share of the points that lie on it; ``reach``: distance up to which nine tenths of these do, heights.
    """

    up: Floats
    height: float
    inliers: float = 0.0
    reach: float = 0.0


class Samples(NamedTuple):
    """Sampled pixels of a pair's left camera.

    ``rays`` (n, 3) with z = 1; inverse depths ``rho`` (n,) and their standard deviations ``sigma`` (n,), 1/m, by an
    error of the disparity of ``sigma_px``; ``focal``, px, of the camera with the coarser pixels.
    """

    rays: Floats
    rho: Floats
    sigma: Floats
    sigma_px: float
    focal: float

    def take(self, which: Bools) -> Samples:
        """The chosen points."""
        return self._replace(rays=self.rays[which], rho=self.rho[which], sigma=self.sigma[which])


def fit_plane(samples: Samples, allowed: Callable[[Floats], Bools]) -> GroundPlane:
    """Robust ground plane: RANSAC among the allowed normals, then iteratively re-weighted least squares.

    Parameters
    ----------
    allowed : which of the normals (m, 3) pointing up may be the ground's.

    Raises
    ------
    DegenerateError
        No allowed plane holds a twentieth of the points.
    """
    rays, rho, sigma = samples.rays, samples.rho, samples.sigma
    if rays.shape[0] < MIN_POINTS:
        raise DegenerateError(
            "RIL-342",
            f"only {rays.shape[0]} sampled pixels are matched: left and right have no texture in common",
            remedy="check exposure and focus, and that left and right show one scene",
        )
    # dh of height changes 1/Z by the share dh/h.
    # Ground lies within 0.02 of the camera's height of the plane.
    tolerance = np.sqrt((2.0 * sigma) ** 2 + (0.02 * rho) ** 2)
    theta = _consensus(samples, tolerance, allowed)
    if theta is not None:
        # Tukey's weight of the residual over twice the tolerance, on that of the observation.
        weight = tolerance**-2.0
        theta = irls(rays, rho, lambda r: weight * np.maximum(0.0, 1.0 - 0.25 * r**2 * weight) ** 2, start=theta)
        expected = rays @ theta
        on = (expected > MIN_HORIZON_SIGMAS * sigma) & (np.abs(rho - expected) < tolerance)
        # theta = -n / h: its length is one over the height.
        share, length = float(np.mean(on)), float(np.linalg.norm(theta))
        # 0.05: ground is a plane that at least so many of the pixels below the horizon lie on.
        if share >= 0.05 and bool(allowed(-theta[None] / length)[0]):
            reach = length * float(np.quantile(np.linalg.norm(rays[on], axis=1) / expected[on], 0.9))
            return GroundPlane(-theta / length, 1.0 / length, share, reach)
    raise NoGroundError("RIL-343", "the disparity shows no ground plane below the camera")


MIN_POINTS = 100
"""Fewest points among which a plane is looked for."""
MIN_HORIZON_SIGMAS = 5.0  # an inverse depth of fewer of its sigmas agrees with any plane, and is not counted


def _consensus(samples: Samples, tolerance: Floats, allowed: Callable[[Floats], Bools]) -> Floats | None:
    """The allowed plane through three points that most points agree with; None: none is allowed."""
    rays, rho, sigma = samples.rays, samples.rho, samples.sigma
    # An all-ground sample of three is among a thousand (p > .999) where a fifth of the pixels are ground.
    triples = np.random.default_rng(1999).integers(0, rays.shape[0], size=(1000, 3))
    volume = np.abs(np.linalg.det(rays[triples]))
    # Three rays that lie nearly in one plane with the camera do not fix the ground.
    triples = triples[volume > 1e-3 * np.ptp(rays[:, 0]) * np.ptp(rays[:, 1])]
    if not len(triples):
        return None
    theta = np.linalg.solve(rays[triples], rho[triples][..., None])[..., 0]
    length = np.maximum(np.linalg.norm(theta, axis=1, keepdims=True), 1e-300)
    theta = theta[allowed(-theta / length)]
    if not len(theta):
        return None
    # Planes are compared on some 1200 points; the best one is then fitted to all.
    scored = slice(None, None, max(1, len(rays) // 1200))
    expected = theta @ rays[scored].T
    agreement = 1.0 - ((rho[scored] - expected) / tolerance[scored]) ** 2
    seen = (expected > MIN_HORIZON_SIGMAS * sigma[scored]) & (agreement > 0.0)
    # Truncated quadratic agreement with the points.
    best = np.argmax(np.sum(agreement, axis=1, where=seen))
    return np.asarray(theta[int(best)], dtype=np.float64)


@dataclass(frozen=True)
class PlaneView:
    """View of a plane by a pair: points on it, of pixels sampled where both cameras see it, or of matched pixels.

    ``xyz`` (n, 3) metres, local frame; ``slant`` (n,) distance from the left camera, m; ``along``, ``across`` (n,)
    size on the plane of one pixel, m per pixel, of the right camera where its pixels are the coarser ones; ``slope``
    (n,) ds/dZ, pixels of disparity per metre of elevation. ``stray``: share of the points at either end of an axis that
    count as mismatches.
    """

    xyz: Floats
    slant: Floats
    along: Floats
    across: Floats
    slope: Floats
    stray: float = 0.0

    def cell_size(self) -> float:
        """Pixel footprint (geometric mean of both directions) at twice the nearest distance, to 1, 2 or 5."""
        # Farther pixels cover more, and would make cells too coarse for the near ground.
        near = self.slant <= 2.0 * self.slant.min()
        return rounded_cell(float(np.sqrt(self.along * self.across)[near].max()))

    def sure_cell(self, sigma_d: float) -> float:
        """The least of 1, 2, 5 ... that is no less than the error of elevation, at ``sigma_d`` pixels of disparity, of
        half of the plane up to twice the nearest distance."""
        least = float(np.median((sigma_d / self.slope)[self.slant <= 2.0 * self.slant.min()]))
        cell = rounded_cell(least)
        return cell if cell >= least else rounded_cell(2.2 * cell)

    def footprint(self, cell: float, max_cells: float, sigma_d: float, max_sigma: float) -> list[float]:
        """Extent x_min, x_max, y_min, y_max, metres, of the plane that is seen well enough.

        ``max_cells``: a pixel may cover so many cells along the range; ``max_sigma``: error of elevation, m, at
        ``sigma_d`` pixels of disparity.
        """
        good = (self.along <= max_cells * cell) & (sigma_d <= max_sigma * self.slope)
        if np.count_nonzero(good) < 3:
            # A limit that is not stated is the cell.
            stated = max_sigma != cell
            by_cell = np.sort(np.maximum(self.along / max_cells, 0.0 if stated else sigma_d / self.slope))[:3][-1]
            by_sigma = np.sort((sigma_d / self.slope)[self.along <= max_cells * max(cell, by_cell)])[:3][-1]
            needs = (("cell_size", cell, by_cell), ("max_sigma", max_sigma, by_sigma if stated else 0.0))
            least = ((n, float(f"{1.1 * need:.2g}")) for n, has, need in needs if need > has)
            remedy = " and ".join(f"locus.{n} to {need:g} m or more" for n, need in least)
            text = f"no ground is seen well enough for cells of {cell:g} m"
            raise CoarseGroundError("RIL-344", text, remedy=f"set {remedy}")
        low, high = np.quantile(self.xyz[good, :2], [self.stray, 1.0 - self.stray], axis=0)
        return [float(low[0]), float(high[0]), float(low[1]), float(high[1])]


def rounded_cell(size: float) -> float:
    """The cell size of 1, 2 or 5 times a power of ten, m, that is nearest to ``size``."""
    first = math.floor(math.log10(size))
    steps = (m * 10.0**e for e in (first, first + 1) for m in (1.0, 2.0, 5.0))
    return min(steps, key=lambda step: abs(math.log(step / size)))


def view_points(samples: Samples, T_local_left: RigidTransform, slopes: Sequence[float] = (0.0, 0.0)) -> PlaneView:
    """View of a plane by points, each on a surface parallel to it: z = a x + b y of the local frame (``slopes`` a, b).

    On the ray r of a pixel (z = 1), which gains r . (-a, -b, 1) of height over the plane with each metre of depth,
    depth 1/rho with the error sigma / rho^2 has that part of it as error of elevation; and a pixel, 1 / (rho f) wide
    there, covers as much of the plane over that gain.
    """
    rays, rho, sigma = samples.rays, samples.rho, samples.sigma
    gain = np.maximum(np.abs(rays @ (np.array([-slopes[0], -slopes[1], 1.0]) @ T_local_left.rotation)), 1e-3)
    # The range grows along the ray: beside the middle of the image longer than depth, and the width is across the ray.
    aside = np.hypot(1.0, rays @ T_local_left.rotation[0])
    points, across = rays / rho[:, None], 1.0 / (rho * samples.focal * aside)
    slant = np.asarray(np.linalg.norm(points, axis=1))
    slope = samples.sigma_px * rho**2 / (sigma * gain)
    return PlaneView(T_local_left.apply(points), slant, across * aside**2 / gain, across, slope)


def view_matches(samples: Samples, T_local_left: RigidTransform) -> PlaneView:
    """View of the plane z = 0 of the local frame by matched pixels."""
    near = samples.take(samples.rho > MIN_DEPTH_SIGMAS * samples.sigma)
    return replace(view_points(near, T_local_left), stray=0.005)


def view_ground(rig: Rig, R_local_left: Floats, plane: Sequence[float]) -> PlaneView:
    """Compute the view of the plane z = c + a x + b y (``plane`` = a, b, c) of the local frame.

    Raises
    ------
    DegenerateError
        No pixel of the left camera sees the plane where the right one does, too.
    """
    a, b, c = plane
    cam = rig.left
    # Many rows, few columns: ground grows far from row to row, and changes little along one.
    cols, rows = np.linspace(1, cam.width - 2, 48), np.linspace(1, cam.height - 2, 256)
    pixels = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)
    rays = cam.rays(pixels)
    rho = rays @ (np.array([-a, -b, 1.0]) @ R_local_left) / c
    with np.errstate(divide="ignore", invalid="ignore"):
        right = rig.right.project(rig.T_right_left.apply(rays / rho[:, None]))
        in_both = (rho > 0) & rig.right.holds(right)
    if not in_both.any():
        raise DegenerateError(
            "RIL-345",
            "the two cameras see no common ground",
            remedy="check the pitch, the left/right order and T_right_left",
        )
    _, per_pixel = inverse_depth(rig, pixels[in_both], (right - pixels)[in_both])
    samples = Samples(rays[in_both], rho[in_both], per_pixel, 1.0, coarser_focal(rig))
    return view_points(samples, RigidTransform(R_local_left, np.zeros(3)), (a, b))
