"""Where on Earth (or another body) a sequence's world frame lies: a projected CRS, an origin and a heading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rille.stages.core.errors import InputError


@dataclass(frozen=True)
class Georeference:
    """Place of the world frame in a projected CRS whose axes are easting and northing in metres.

    ``origin``: easting, northing, height (m) of the world's origin, the first left camera's centre. ``azimuth``:
    direction of the world's y axis (the first optical axis, projected to the horizontal), radians clockwise from grid
    north. World metres are taken as metres of the grid: a projection's scale (0.9996 to 1.001 in UTM) is not applied.
    """

    crs: str
    origin: tuple[float, float, float]
    azimuth: float

    @property
    def rotation(self) -> NDArray[np.float64]:
        """2 x 2: (easting, northing) = rotation @ (x, y) + origin."""
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        return np.array([[c, s], [-s, c]])

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Easting, northing and height (..., 3) of points (..., 3) of the world frame, metres."""
        p = np.asarray(points, dtype=np.float64)
        turned = np.concatenate([p[..., :2] @ self.rotation.T, p[..., 2:]], axis=-1)
        return np.asarray(turned + np.array(self.origin), np.float64)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"crs": self.crs, "origin": list(self.origin), "azimuth": self.azimuth}


def georeference(
    crs: str | None, origin: tuple[float, float, float] | None, azimuth_deg: float | None, where: str
) -> Georeference | None:
    """The place that a manifest states; None where it states none.

    Raises
    ------
    InputError
        One of the three is missing, or the CRS is unknown, not projected or not in metres.
    """
    given = {"crs": crs, "origin": origin, "azimuth_deg": azimuth_deg}
    missing = [name for name, value in given.items() if value is None]
    if len(missing) == len(given):
        return None
    if crs is None or origin is None or azimuth_deg is None:
        raise InputError(
            "RIL-180",
            f"{where}: world.{' and world.'.join(missing)} missing: a place needs crs, origin and azimuth_deg",
            remedy='e.g. crs = "EPSG:32633", origin = [easting, northing, height], azimuth_deg = 90 for looking east',
        )
    _check_crs(crs, where)
    return Georeference(crs, origin, math.radians(azimuth_deg))


def _check_crs(text: str, where: str) -> None:
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    remedy = 'give a projected one in metres, e.g. "EPSG:32633" (UTM zone 33 north)'
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise InputError("RIL-181", f"{where}: world.crs = {text!r} is no known CRS", remedy=remedy) from error
    if not crs.is_projected:
        raise InputError("RIL-182", f"{where}: world.crs = {text!r} is not projected", remedy=remedy)
    unit, factor = crs.linear_units_factor
    if factor != 1.0:
        raise InputError("RIL-183", f"{where}: world.crs = {text!r} is in {unit} of {factor:.6g} m", remedy=remedy)
