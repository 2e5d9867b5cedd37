"""``rille merge RUN RUN``: the terrains of several runs of one place as one, in the world frame of the first."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from rille.datasets.georeference import Georeference
from rille.pipeline.commands.results.run_terrain import Terrain
from rille.pipeline.engine.plain import warn
from rille.pipeline.export.read_dem import refuse_unlike_systems
from rille.pipeline.export.writers import Meaning, check_folder, write_json, write_raster
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import RUNS, Output, Run, Runs
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import ConfigError, DegenerateError, InputError, warning
from rille.stages.core.quantities import metres
from rille.stages.evaluation import dem_comparison
from rille.stages.evaluation.dem_comparison import Alignment
from rille.stages.evaluation.place import register
from rille.stages.geometry.geometry import RigidTransform, heading_of, rotation_exp, rotation_log
from rille.stages.geometry.lattice import Lattice, union
from rille.stages.terrain.map_localization import Placement, independent_cells
from rille.stages.terrain.merge import EXACT, MergeParams, ModelLayer, Placed
from rille.stages.terrain.merge import merge as merge_layers
from rille.stages.terrain.relief.grid import Grid
from rille.stages.terrain.shading import gradient


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


def merge(run: Run, *more: Run, output: Annotated[Path, Output], runs: Runs = RUNS) -> None:
    """Merge the terrains of several runs of one place: dem.tif, dem_sigma.tif and ortho.tif in the first run's frame.

    Runs with georeferences in one system are laid by these, others by ortho images or relief; then elevations decide,
    with stated standard deviations, which those of the merged terrain contain. Prints how far the runs differ.

    Parameters
    ----------
    more
        Others.
    output
        Folder to write.
    """
    folders = [lookup.find(name, runs) for name in (run, *more)]
    if len(set(folders)) < 2:
        raise ConfigError("RIL-849", "one run alone is merged with nothing", remedy="name two runs of one place")
    check_folder(output, "merge.json")
    first, *others = terrains = [Terrain.of(folder) for folder in dict.fromkeys(folders)]
    for a, b in combinations(terrains, 2):
        if np.array_equal(a.arrays["elevation"], b.arrays["elevation"], equal_nan=True):
            text = f"{a.name} and {b.name} are one terrain, to the bit, which would count twice"
            raise InputError("RIL-968", text, remedy="name one of them")
    for line in lookup.shared_images(dict.fromkeys(folders)):
        warn(line)
    sessions = [_registered(first, other) for other in others]
    lattice = union([first.lattice, *(one.covered(first.lattice.cell) for one in sessions)])
    layers = [_layer(0, first.lattice, first.arrays)]
    layers += [_laid(number, first, one) for number, one in enumerate(sessions, start=1)]
    merged = merge_layers(layers, lattice, MergeParams.model_validate({}))
    height = merged.elevation if first.place is None else merged.elevation + first.place.origin[2]
    # First, since it marks the folder as ours, so that the same command can continue after a kill.
    facts = {"frame_of": first.name, "runs": [dict(one.facts) for one in sessions]}
    write_json(output / "merge.json", facts)
    for name, band, values, unit in (
        ("dem.tif", "elevation", height, "m"),
        ("dem_sigma.tif", "elevation_std", merged.elevation_std, "m"),
        ("ortho.tif", "ortho", merged.ortho, ""),
    ):
        write_raster(output / name, {band: np.asarray(values, np.float32)}, lattice, Meaning(unit), first.place)
    for one in sessions:
        print(_line(one))
    known, several = int(np.isfinite(merged.elevation).sum()), int((merged.count > 1).sum())
    cells = f"{known} cells of {lattice.cell:g} m, {several} of several runs"
    print(f"{output}: dem.tif, dem_sigma.tif, ortho.tif, merge.json: {cells}")


def _registered(first: Terrain, other: Terrain) -> Session:
    """Register a run to the first one.

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
    placed = _placed(first, other)
    start, stated = placed.pose, first.place is not None and other.place is not None
    alignment = _aligned(other.grid, first.grid, start)
    error = dem_comparison.errors(other.grid, first.grid, start if alignment is None else alignment.pose)
    shared = np.isfinite(error)
    if not shared.any() or (alignment is None and not stated):
        text = f"{other.name} and {first.name} have too little ground in common to be laid on each other"
        raise DegenerateError("RIL-853", text, remedy="choose runs that share more ground")
    if alignment is None:
        text = f"elevations do not tell how {other.name} lies: it is as the georeferences state, without a sigma"
        warn(warning("RIL-855", text))
        alignment = Alignment(start, start.apply(other.grid.points()[shared]).mean(axis=0), np.zeros(6))
    # Errors of neighbours correlate: there are fewer independent ones than cells.
    sigma = alignment.sigma * math.sqrt(shared.sum() / max(independent_cells(error), 1.0))
    rough = np.sqrt(np.diag(placed.covariance))
    sigma = np.where((sigma == 0.0) & np.isfinite(rough), rough, sigma)
    # Within three standard deviations georeferences are used unchanged, without resampling if the lattices fit.
    moved, pose = alignment.pose @ start.inverse(), alignment.pose
    motion = np.array([*(moved.apply(alignment.centre) - alignment.centre), *rotation_log(moved.rotation)])
    by = placed.by
    if stated and (np.abs(motion) <= 3.0 * sigma).all():
        pose = start
    elif stated:
        by += f", {metres(float(np.linalg.norm(motion[:3])))} off by the elevations, which decide"
    facts = {
        "run": other.name,
        "by": by,
        "T_first_world": pose.to_list(),
        "sigma_m_rad": sigma.tolist(),
        "overlap": dem_comparison.figures(error),
    }
    return Session(other, pose, sigma, alignment.centre, facts)


def _placed(first: Terrain, other: Terrain) -> Placement:
    """Placement of a run in the first one by the georeferences of both, else by ortho images or relief."""
    a, b = first.place, other.place
    if a is None or b is None:
        return register((other.image, first.image), (other.grid, first.grid))
    refuse_unlike_systems({other.name: b.crs, first.name: a.crs})
    return Placement(_in_system(a).inverse() @ _in_system(b), np.zeros((6, 6)), "georeferences")


def _in_system(place: Georeference) -> RigidTransform:
    """T_system_world of a georeference."""
    return RigidTransform(rotation_exp([0.0, 0.0, -place.azimuth]), np.array(place.origin))


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


def _line(one: Session) -> str:
    """Line on the registration of a run and its differences."""
    x, y, z = one.pose.translation
    overlap = one.facts["overlap"]
    turned, turn = math.degrees(heading_of(one.pose)), math.degrees(one.sigma[5])
    sigma = f"sigma {', '.join(map(metres, one.sigma[:3]))}, {turn:.2g} degrees; by {one.facts['by']}"
    median, nmad, p95 = (metres(overlap[name], signed=name == "median") for name in ("median", "nmad", "p95"))
    common = f"{overlap['cells']:.0f} cells in common: median {median}, NMAD {nmad}, 95 % {p95}"
    return f"{one.terrain.name}: at {x:.4g}, {y:.4g}, {z:.4g} m, turned by {turned:.3f} degrees ({sigma}); {common}"
