"""Local path on a risk map: the row-monotone graph, solved in one sweep (section 4.7).

Nodes are the free cells: safe, and farther than the vehicle's margin from every hazard. Each node of a row has edges to
three nodes of the next row (same column and its neighbours). The weight of an edge is the absolute height difference
between the places where a wheel would stand: means over the wheel's window, rounded to a step that means nothing to the
vehicle. Rounded heights are integers, so sums are exact and ties are ties: among equals the path with fewest sideways
moves wins, then the one whose last move is straight, else to the left, else to the right.

Since all edges lead from row to row, Dijkstra's algorithm is one sweep over the rows, O(N) in the number of cells, and
yields all targets of the far row at once (Figure 3).

Rows lie across the driving direction: the elevation model's own rows where it is heading-aligned (row 0 farthest), or
the rows of a grid turned by a heading or by the line from start to target, filled by nearest neighbour.

An elevation model is fan-shaped and ragged: the first and last rows with a free cell hold a few, which may lead
nowhere. So a start that is not given is, of the free cells within one vehicle length of the first row that lead on,
the one nearest to that row's middle; the target likewise at the last row. A path counts as found when it comes within
one vehicle length of the last row.

An obstacle hides part of itself, so the rim of unknown ground is less certain than its elevations say: what lies in the
dark belongs to the same wheel's window. A path that stays half a wheel away from unknown ground is preferred; where
there is none, unknown ground may be passed closely, but never entered.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt

from stages.declare import Array, Bundle, Inputs, Memory, Params, Stage
from stages.errors import InputError
from stages.lattice import Lattice
from stages.risk import HAZARDOUS, SAFE, UNKNOWN, window_cells
from stages.row_grid import RowGrid
from stages.vehicle import Vehicle
from stages.windows import window_mean

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Point = tuple[float, float]

UNREACHED = np.iinfo(np.int64).max // 4
MOVES = (0, 1, -1)
"""Column of the predecessor minus the cell's own, in order of preference: came straight, to the left, to the right."""


class PathParams(Params):
    """Parameters of ``path``. ``start`` and ``target`` concern the path over the whole map, not those of each stop."""

    start: Point | None = Field(
        default=None,
        description="m; x, y in the world frame; not set: the free cell nearest to the middle of the first row",
    )
    target: Point | None = Field(
        default=None,
        description="m; x, y in the world frame; not set: the free cell nearest to the middle of the last row",
    )
    height_step: float = Field(
        default=0.02, gt=0, le=1, description="share of max_step; smaller height differences count as none"
    )


@dataclass(frozen=True)
class Plan:
    """What the sweep found, in cells of its grid.

    ``cells`` (vertex, 2) row, column from start to target, empty where there is no path; ``cost`` (row, col) int64 of
    :func:`sweep`; ``reachable`` (col,) of ``target_row``; ``blocking_row`` the first row that cannot be entered and
    ``reason`` in words, both empty where a path was found. ``beside_unknown``: no path keeps half a wheel from unknown.
    """

    cells: Ints
    cost: Ints
    reachable: Mask
    target_row: int
    blocking_row: int | None = None
    reason: str = ""
    beside_unknown: bool = False


def free_cells(risk: NDArray[np.uint8], cell: float, margin: float, rim: float = 0.0) -> Mask:
    """Safe cells farther (centre to centre) than ``margin`` metres from hazardous and ``rim`` from unknown ones."""
    free = risk == SAFE
    for kind, distance in ((HAZARDOUS, margin), (UNKNOWN, rim)):
        blocked = risk == kind
        if distance > 0 and blocked.any():
            free &= distance_transform_edt(~blocked) * cell > distance
    return np.asarray(free)


def sweep(height: Ints, free: Mask, sources: Mask) -> tuple[Ints, NDArray[np.int8]]:
    """Least cost from any source to every cell of the row graph, towards row 0.

    Parameters
    ----------
    height : (row, col) int64, any unit.
    free, sources : (row, col) cells that may be entered; cells where a path may start.

    Returns
    -------
    Cost (row, col) int64: sum of absolute height differences times the number of rows, plus the sideways moves; and
    the index into :data:`MOVES` of the last move (-1 at sources and where not reached).
    """
    rows, cols = height.shape
    cost = np.where(sources & free, 0, UNREACHED).astype(np.int64)
    move = np.full((rows, cols), -1, dtype=np.int8)
    for r in range(rows - 2, -1, -1):
        before = np.pad(cost[r + 1], 1, constant_values=UNREACHED)
        level = np.pad(height[r + 1], 1)
        candidates = np.stack(
            [
                before[1 + m : 1 + m + cols] + np.abs(height[r] - level[1 + m : 1 + m + cols]) * rows + (m != 0)
                for m in MOVES
            ]
        )
        best = np.argmin(candidates, axis=0)
        least = candidates[best, np.arange(cols)]
        enter = free[r] & (least < UNREACHED) & (cost[r] == UNREACHED)
        cost[r, enter], move[r, enter] = least[enter], best[enter]
    return cost, move


def farthest_row(free: Mask) -> Ints:
    """Smallest row (row, col) that can be reached from each free cell; the number of rows where not free."""
    rows = free.shape[0]
    far = np.full(free.shape, rows, dtype=np.int64)
    for r in range(rows):
        ahead = np.full(free.shape[1], r)
        if r:
            next_row = np.pad(far[r - 1], 1, constant_values=rows)
            ahead = np.minimum(ahead, np.minimum(np.minimum(next_row[:-2], next_row[1:-1]), next_row[2:]))
        far[r] = np.where(free[r], ahead, rows)
    return far


def plan(
    height: Ints,
    free: Mask,
    tolerance: int = 0,
    start: tuple[int, int] | None = None,
    target: tuple[int, int] | None = None,
    span: tuple[int, int] | None = None,
) -> Plan:
    """Path from the nearest to the farthest row, or between given cells.

    Parameters
    ----------
    height : (row, col) int64 rounded heights. ``free`` : cells that may be entered. Row 0 is farthest.
    tolerance : rows by which a start or target that is not given may miss the nearest or farthest row with a free cell;
        at most a quarter of the rows between them.
    start, target : row and column, inside the grid.
    span : the farthest and the nearest row that count; None: those with a free cell.
    """
    rows, cols = free.shape
    first_last = span or row_span(free)
    nothing = Plan(np.empty((0, 2), dtype=np.int64), np.full(free.shape, UNREACHED), np.zeros(cols, dtype=bool), 0)
    for name, cell in (("start", start), ("target", target)):
        if cell is not None and not free[cell]:
            return _blocked(nothing, cell[0], f"the {name} is not a free cell")
    if first_last is None:
        return _blocked(nothing, rows - 1, "there is no free cell")
    farthest, nearest = first_last
    tolerance = min(tolerance, (nearest - farthest) // 4)
    limit = farthest + tolerance
    candidates = np.zeros_like(free)
    if start is not None:
        candidates[start] = True
    else:
        candidates[max(nearest - tolerance, 0) : nearest + 1] = free[max(nearest - tolerance, 0) : nearest + 1]
    allowed = free
    if target is not None:
        allowed = free.copy()
        allowed[: target[0] + 1] = False
        allowed[target], limit = True, target[0]
        candidates[: target[0] + 1] = False
        if not candidates.any():
            return _blocked(nothing, target[0], "the target is not ahead of the start")
    far = farthest_row(allowed)
    good = candidates & (far <= limit)
    if not good.any():
        cost, _ = sweep(height, allowed, candidates)
        stop = int(far[candidates].min()) - 1 if candidates.any() else nearest
        return _blocked(
            Plan(nothing.cells, cost, nothing.reachable, limit), stop, "no free cell of this row can be entered"
        )
    source = np.zeros_like(free)
    source[_nearest_middle(good, nearest)] = True
    cost, move = sweep(height, allowed, source)
    ends = cost < UNREACHED
    ends[limit + 1 :] = False
    row, col = _nearest_middle(ends, farthest)
    return Plan(_trace(move, row, col), cost, cost[row] < UNREACHED, row)


def row_span(free: Mask) -> tuple[int, int] | None:
    """The farthest and the nearest row with a free cell."""
    occupied = np.flatnonzero(free.any(axis=1))
    return (int(occupied[0]), int(occupied[-1])) if len(occupied) else None


def _blocked(at: Plan, row: int, reason: str) -> Plan:
    return replace(at, blocking_row=row, reason=reason)


def _nearest_middle(cells: Mask, row: int) -> tuple[int, int]:
    """The set cell with the fewest moves along rows and columns to the middle of a row; the first one among equals."""
    r, c = np.nonzero(cells)
    best = int(np.argmin(2 * np.abs(r - row) + np.abs(2 * c - (cells.shape[1] - 1))))
    return int(r[best]), int(c[best])


def _trace(move: NDArray[np.int8], row: int, col: int) -> Ints:
    """Cells (vertex, 2) from the source to the given cell."""
    cells = [(row, col)]
    while move[row, col] >= 0:
        row, col = row + 1, col + MOVES[move[row, col]]
        cells.append((row, col))
    return np.array(cells[::-1], dtype=np.int64)


def find_path(
    risk: NDArray[np.uint8],
    elevation: NDArray[np.float32],
    lattice: Lattice,
    vehicle: Vehicle,
    *,
    heading: Point = (0.0, 1.0),
    start: Point | None = None,
    target: Point | None = None,
    height_step: float = 0.02,
) -> tuple[Plan, RowGrid, Floats]:
    """Path over a risk map.

    Parameters
    ----------
    risk : (row, col) uint8 class. ``elevation`` : (row, col) float32 metres, closed, NaN unknown.
    heading : driving direction (dx, dy) in the frame of the lattice; start and target together override it.
    start, target : x, y, metres; None: see the module.
    height_step : rounding of heights, as a share of the vehicle's ``max_step``.

    Returns
    -------
    The plan, the grid it lies on, and its vertices (vertex, xyz) float64, metres; z is the mean height under a wheel.

    Raises
    ------
    InputError
        Start or target lies outside the map, or they are the same cell.
    """
    if start is not None and target is not None:
        heading = (target[0] - start[0], target[1] - start[1])
    grid = RowGrid.over(lattice, heading)
    ends = [
        None if point is None else _cell_of(grid, lattice, name, point)
        for name, point in (("start", start), ("target", target))
    ]
    free = grid.sample(lattice, free_cells(risk, lattice.cell, vehicle.margin), False)
    rim = 0.5 * vehicle.wheel_diameter
    clear = free & grid.sample(lattice, free_cells(risk, lattice.cell, 0.0, rim), False)
    stand = grid.sample(lattice, window_mean(elevation, window_cells(vehicle.wheel_diameter, lattice.cell)), np.nan)
    height = np.rint(np.where(free, stand, 0.0) / (height_step * vehicle.max_step)).astype(np.int64)
    tolerance = math.ceil((vehicle.wheel_base + vehicle.wheel_diameter) / lattice.cell)
    found = plan(height, clear, tolerance, start=ends[0], target=ends[1], span=row_span(free))
    if len(found.cells) == 0:
        found = replace(plan(height, free, tolerance, start=ends[0], target=ends[1]), beside_unknown=True)
    row, col = found.cells[:, 0], found.cells[:, 1]
    return found, grid, np.column_stack([grid.xy(row, col), stand[row, col]])


def _cell_of(grid: RowGrid, lattice: Lattice, name: str, point: Point) -> tuple[int, int]:
    row, col = grid.index(point)
    if not (0 <= row < grid.rows and 0 <= col < grid.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            f"path.{name} ({point[0]:g}, {point[1]:g}) m is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )
    return row, col


def _run(params: PathParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    source: Bundle = inputs["risk"]
    lattice, vehicle = Lattice.from_dict(source.meta["lattice"]), Vehicle.model_validate(source.meta["vehicle"])
    local = args.get("use") == "local"
    dx, dy = args.get("heading", (0.0, 1.0))
    risk = np.asarray(source["risk"])
    found, grid, xyz = find_path(
        risk,
        np.asarray(source["elevation"]),
        lattice,
        vehicle,
        heading=(dx, dy),
        start=None if local else params.start,
        target=None if local else params.target,
        height_step=params.height_step,
    )
    cost = found.cost // grid.rows * (params.height_step * vehicle.max_step)
    arrays: dict[str, NDArray[Any]] = {
        "path": xyz,
        "cost_to_go": np.where(found.cost < UNREACHED, cost, np.nan).astype(np.float32),
        "reachable": found.reachable.astype(np.uint8),
    }
    inclination = grid.sample(lattice, np.asarray(source["inclination"]), np.nan)[found.cells[:, 0], found.cells[:, 1]]
    return Bundle(arrays, _meta(found, grid, xyz, inclination) | {"frame": source.meta.get("frame", "local")})


def _meta(found: Plan, grid: RowGrid, xyz: Floats, inclination: NDArray[np.float32]) -> dict[str, Any]:
    meta: dict[str, Any] = {
        "found": len(xyz) > 0,
        "reason": found.reason,
        "blocking_row": found.blocking_row,
        "blocking_y": None if found.blocking_row is None else (grid.j0 - found.blocking_row) * grid.cell,
        "beside_unknown": found.beside_unknown,
        "target_row": found.target_row,
        "reachable_targets": int(found.reachable.sum()),
        "vertices": len(xyz),
        "grid": grid.to_dict(),
    }
    if len(xyz) == 0:
        return meta | dict.fromkeys(("length_m", "climb_m", "max_inclination", "start", "target"))
    steps = np.diff(xyz, axis=0)
    return meta | {
        "length_m": float(np.sqrt((steps**2).sum(axis=1)).sum()),
        "climb_m": float(np.maximum(steps[:, 2], 0.0).sum()),
        "max_inclination": float(inclination.max()),
        "start": [float(v) for v in xyz[0]],
        "target": [float(v) for v in xyz[-1]],
    }


STAGE = Stage(
    name="path",
    version=1,
    summary="path of least height differences over free cells, monotone in the rows across the heading",
    params=PathParams,
    inputs=("risk",),
    outputs=(
        Array("path", ("vertex", "xyz"), "float64", "m", "vertices from start to target; z = mean under a wheel"),
        Array("cost_to_go", ("row", "col"), "float32", "m", "height differences from the start to the cell", "nan"),
        Array("reachable", ("col",), "uint8", "1", "1 where the target row can be reached"),
    ),
    requires=("numpy", "scipy"),
    run=_run,
    memory=Memory(factor=12.0, lower=("locus.cell_size",)),
)
