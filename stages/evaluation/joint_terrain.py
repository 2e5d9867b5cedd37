"""Terrain of a run in a larger map; and terrains of several runs of one place as one, in the world of the first.

A run is laid on the first one by the georeferences of both, or else by ortho images or relief
(:mod:`rille.stages.evaluation.place`); then elevations decide, with standard deviations, which those of the merged
terrain contain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import DegenerateError, InputError, warning
from rille.stages.core.quantities import metres
from rille.stages.evaluation import dem_comparison
from rille.stages.evaluation.dem_comparison import Alignment
from rille.stages.evaluation.place import place, register
from rille.stages.geometry.geometry import RigidTransform, from_above, heading_of, rotation_exp, rotation_log
from rille.stages.geometry.lattice import Lattice, union
from rille.stages.terrain.map_localization import MapLocalizationParams, Placement, SearchArea, fix, independent_cells
from rille.stages.terrain.merge import EXACT, Merged, MergeParams, ModelLayer, Placed, merge
from rille.stages.terrain.relief.grid import Grid
from rille.stages.terrain.shading import gradient

TURN_DEG = 20.0
"""Degrees to either side of a given heading that are searched."""

NAMES = ("x_m", "y_m", "z_m", "about_x_deg", "about_y_deg", "yaw_deg")


@dataclass(frozen=True)
class Terrain:
    """Merged terrain of a run, of this name.

    ``arrays`` (row, col) on ``lattice``: ``elevation``, its standard deviation ``elevation_std``, m, and grey values
    ``ortho``.
    """

    name: str
    arrays: Mapping[str, Floats]
    lattice: Lattice

    @property
    def grid(self) -> Grid:
        """The elevations in the world frame."""
        return Grid.on(self.lattice, self.arrays["elevation"])

    @property
    def image(self) -> Grid:
        """The ortho image in the world frame."""
        return Grid.on(self.lattice, self.arrays["ortho"])


def locate(
    terrain: Terrain,
    image: Grid | None,
    heights: Grid | None,
    around: SearchArea | None,
    sigma_tilt_deg: float,
    tell: Callable[[str], None],
) -> Placement:
    """Placement of a run in a larger map, by its ortho ``image``, if there is one, then by its ``heights``, if there
    are any.

    Parameters
    ----------
    around : searched part of the map; None: all of it.
    sigma_tilt_deg : standard deviation of the vertical of the run about each axis, degrees.
    tell : takes a line on an image that does not determine the place.

    Raises
    ------
    DegenerateError
        They do not determine the place.
    """
    by_image = None
    if image is not None:
        if around is not None and around.distance < math.inf:
            away = np.linalg.norm(image.centres() - [around.x, around.y], axis=-1)
            near = away <= around.distance + terrain.lattice.radius
            image = replace(image, values=np.where(near, image.values, np.nan))
        try:
            by_image = place(terrain.image, image)
        except DegenerateError as error:
            if heights is None:
                raise
            tell(f"{error.code}: {error}; by the elevations alone")
    if heights is None:
        assert by_image is not None
        return by_image
    if by_image is not None:
        # Elevations and ortho images must agree on a place within ten cells of the map.
        around = SearchArea(*from_above(by_image.pose), 10.0 * heights.cell, math.radians(TURN_DEG))
    params = MapLocalizationParams.model_validate({"sigma_tilt_deg": sigma_tilt_deg})
    found = fix(terrain.grid, heights, around, params)
    return found if by_image is None else replace(found, figures={**found.figures, **by_image.figures})


def numbers(placed: Placement) -> dict[str, tuple[float, float]]:
    """Known numbers of a place by name, with standard deviations: position, tilts about the map's axes, yaw."""
    R, sigma = placed.pose.rotation, np.sqrt(np.diag(placed.covariance))
    heading = heading_of(placed.pose)
    tilts = np.degrees(rotation_log(R @ rotation_exp([0.0, 0.0, -heading])))[:2]
    values = *placed.pose.translation, *tilts, math.degrees(heading)
    sigmas = *sigma[:3], *np.degrees(sigma[3:])
    return {name: (float(v), float(s)) for name, v, s in zip(NAMES, values, sigmas, strict=True) if s < math.inf}


@dataclass(frozen=True)
class Session:
    """Terrain of a run and its registration: ``pose`` T_first_world, standard deviations ``sigma`` (6,) of x, y, z, m,
    and of turns about them, rad, at ``centre`` (3,), m, and its facts for the JSON file."""

    terrain: Terrain
    pose: RigidTransform
    sigma: Floats
    centre: Floats
    facts: Mapping[str, Any]

    def covered(self, cell: float) -> Lattice:
        """Part of the first run's lattice that it may cover."""
        x0, x1, y0, y1 = self.terrain.lattice.bounds
        x, y, _ = self.pose.apply([[x, y, self.level] for x in (x0, x1) for y in (y0, y1)]).T
        return Lattice.snap((x.min(), x.max(), y.min(), y.max()), cell)

    @property
    def level(self) -> float:
        """Middle elevation of its terrain in its own frame, m."""
        return float(np.nanmedian(self.terrain.arrays["elevation"]))


def joined(first: Terrain, sessions: Sequence[Session]) -> tuple[Lattice, Merged]:
    """The first terrain merged with those that are registered to it, and the lattice of all."""
    lattice = union([first.lattice, *(one.covered(first.lattice.cell) for one in sessions)])
    layers = [_layer(0, first.lattice, first.arrays)]
    layers += [_laid(number, first, one) for number, one in enumerate(sessions, start=1)]
    return lattice, merge(layers, lattice, MergeParams.model_validate({}))


def registered(first: Terrain, other: Terrain, stated: RigidTransform | None, tell: Callable[[str], None]) -> Session:
    """Register a run to the first one.

    Parameters
    ----------
    stated : T_first_world by the georeferences of both.
    tell : takes a line on elevations that do not determine it.

    Raises
    ------
    DegenerateError
        Neither ortho images nor relief determine one common place.
    InputError
        Their cells are too unlike, or they have no ground in common.
    """
    ratio = other.lattice.cell / first.lattice.cell
    # 1.5: largest ratio of two runs' cell sizes, since the merge interpolates in coarser cells and skips finer ones.
    if not 1.0 / 1.5 < ratio < 1.5:
        text = f"cells of {other.name} are {other.lattice.cell:g} m wide, of {first.name} {first.lattice.cell:g} m"
        raise InputError("RIL-851", text, remedy=f"run one again with --set locus.cell_size={first.lattice.cell:g}")
    placed = Placement(stated or RigidTransform.identity(), np.zeros((6, 6)), "georeferences")
    if stated is None:
        placed = register((other.image, first.image), (other.grid, first.grid))
    start = placed.pose
    alignment = _aligned(other.grid, first.grid, start)
    error = dem_comparison.errors(other.grid, first.grid, start if alignment is None else alignment.pose)
    shared = np.isfinite(error)
    if not shared.any() or (alignment is None and stated is None):
        text = f"{other.name} and {first.name} have too little ground in common to be laid on each other"
        raise DegenerateError("RIL-853", text, remedy="choose runs that share more ground")
    if alignment is None:
        text = f"elevations do not tell how {other.name} lies: it is as the georeferences state, without a sigma"
        tell(warning("RIL-855", text))
        alignment = Alignment(start, start.apply(other.grid.points()[shared]).mean(axis=0), np.zeros(6))
    # Errors of neighbours correlate: there are fewer independent ones than cells.
    sigma = alignment.sigma * math.sqrt(shared.sum() / max(independent_cells(error), 1.0))
    rough = np.sqrt(np.diag(placed.covariance))
    sigma = np.where((sigma == 0.0) & np.isfinite(rough), rough, sigma)
    # Within three standard deviations georeferences are used unchanged, without resampling if the lattices fit.
    moved, pose = alignment.pose @ start.inverse(), alignment.pose
    motion = np.array([*(moved.apply(alignment.centre) - alignment.centre), *rotation_log(moved.rotation)])
    by = placed.by
    if stated is not None and (np.abs(motion) <= 3.0 * sigma).all():
        pose = start
    elif stated is not None:
        by += f", {metres(float(np.linalg.norm(motion[:3])))} off by the elevations, which decide"
    facts = {
        "run": other.name,
        "by": by,
        "T_first_world": pose.to_list(),
        "sigma_m_rad": sigma.tolist(),
        "overlap": dem_comparison.figures(error),
    }
    return Session(other, pose, sigma, alignment.centre, facts)


def _aligned(one: Grid, two: Grid, start: RigidTransform) -> Alignment | None:
    """Motion of the first grid onto the second, of height and tilt alone if the terrain determines no more."""
    for kind in ("rigid", "tilt"):
        with suppress(DegenerateError):
            return dem_comparison.align(one, two, kind, start)
    return None


def _layer(
    number: int, lattice: Lattice, arrays: Mapping[str, Floats], gain: float = 1.0, pose: Placed = EXACT
) -> ModelLayer:
    """A layer of the merge."""
    parts = {name: values.astype(np.float32) for name, values in arrays.items()}
    return ModelLayer(number, lattice, lambda name, window: parts[name][window], gain, pose)


def _laid(number: int, first: Terrain, session: Session) -> ModelLayer:
    """The terrain of a run on the first one's lattice, interpolated once, with the sigma of its placement."""
    terrain, lattice, pose = session.terrain, session.covered(first.lattice.cell), session.pose
    grid, back, xy = terrain.grid, session.pose.inverse(), lattice.xy()
    z = np.full(lattice.shape, float(pose.apply([0.0, 0.0, session.level])[2]))
    # The point of a tilted model above a cell depends on its height: fixed-point iteration.
    for _ in range(4):
        own = back.apply(np.concatenate([xy, z[..., None]], axis=-1))[..., :2]
        there = grid.at(own)
        height = pose.apply(np.concatenate([own, there[..., None]], axis=-1))[..., 2]
        z = np.where(np.isfinite(height), height, z)
    slopes = np.nan_to_num(gradient(height, lattice.cell))
    arm, sigma = xy - session.centre[:2], session.sigma
    sideways = (slopes[0] * np.hypot(sigma[0], sigma[5] * arm[..., 1])) ** 2
    sideways += (slopes[1] * np.hypot(sigma[1], sigma[5] * arm[..., 0])) ** 2
    std = np.sqrt(grid.at(own, terrain.arrays["elevation_std"]) ** 2 + sideways)
    ortho = grid.at(own, terrain.arrays["ortho"])
    common = lattice.intersection(first.lattice)
    gain = 1.0
    if common is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(first.arrays["ortho"][first.lattice.window(common)] / ortho[lattice.window(common)])
        gain = math.exp(float(np.median(ratio[np.isfinite(ratio)]))) if np.isfinite(ratio).any() else 1.0
    placed = Placed(session.centre, np.diag([sigma[2], sigma[3], sigma[4]]) ** 2)
    return _layer(number, lattice, {"elevation": height, "elevation_std": std, "ortho": ortho}, gain, placed)
