"""Where a path starts and ends: given ends checked, others chosen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.errors import InputError
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import HAZARDOUS, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path_ground import PathMaps
from rille.stages.planning.path_words import Maps, hazard_words
from rille.stages.planning.row_graph import nearest_middle, row_span

Point = tuple[float, float]
Cell = tuple[int, int]


def check_end(maps: Maps, lattice: Lattice, vehicle: Vehicle, name: str, point: Point) -> None:
    """Refuse a start or target outside the map, in a hazard or on unknown ground, with the figure that decides."""
    row, col = (int(v) for v in np.rint(lattice.index(point)))
    where = f"path.{name} ({point[0]:g}, {point[1]:g}) m"
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            "RIL-406",
            f"{where} is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )
    kind = maps["risk"][row, col]
    if kind == UNKNOWN:
        free = np.argwhere(maps["risk"] < HAZARDOUS)
        away = (
            f", the nearest ground to drive on is {_away(free, row, col, lattice.cell):.3g} m away" if len(free) else ""
        )
        raise InputError("RIL-407", f"{where} lies on unknown ground{away}", remedy=f"choose another {name}")
    if kind == HAZARDOUS:
        raise InputError(
            "RIL-408",
            f"{where} lies in a hazard: {hazard_words(maps, (row, col), vehicle)}",
            remedy=f"choose another {name}",
        )


def _away(cells: NDArray[np.intp], row: int, col: int, cell: float) -> float:
    return float(np.hypot(cells[:, 0] - row, cells[:, 1] - col).min()) * cell


def chosen(ground: PathMaps, below: str, start: Cell | None, target: Cell | None) -> tuple[Cell | None, Cell | None]:
    """Ends as given; else, of the connected ground over most rows (that of the end that is given), the cell nearest to
    the middle of the first row, and the one nearest to that of the last.

    Parameters
    ----------
    below : of :data:`rille.stages.planning.path_ground.GROUNDS`, what stays on known ground.
    """
    span = row_span(ground.ways(below) > 0)
    if span is None or (start is not None and target is not None):
        return (None, None) if span is None else (start, target)
    number, spans = ground.parts(below)
    given = start if start is not None else target
    part = int(number[given]) if given is not None else int(np.argmax(spans[:, 1] - spans[:, 0]))
    if part < 0:
        return start, target
    cells = number == part
    return start or nearest_middle(cells, span[1]), target or nearest_middle(cells, span[0])
