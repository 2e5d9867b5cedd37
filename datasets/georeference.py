"""Places on Earth or another body: the georeference of a sequence's world frame, and tables of places.

A georeference is a projected CRS, an origin and a heading.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rille.datasets.text.columns import POSITION, geocentric, have_rotation, meanings
from rille.datasets.text.tables import TextTable
from rille.datasets.text.units import unitless
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError

EARTH_RADIUS = 6_371_008.8
"""m; its mean: the ellipsoid departs from it by .5 %."""

FORMS = re.compile(
    r"(?i)(EPSG|ESRI|IAU_\d+|IGNF|OGC|urn:ogc:def:crs:EPSG:):|[+{]"
    r"|(PROJ|PROJECTED|GEOG|GEOD|GEODETIC|GEOGRAPHIC|GEOC|LOCAL_|ENG|BOUND|COMPOUND|COMPD_)(CS|CRS)\["
    r"|(WGS84|WGS72|NAD27|NAD83|CRS84)$"
)
"""Beginnings of CRS texts that GDAL does not look for in a file of that name."""


@dataclass(frozen=True)
class Georeference:
    """Place of the world frame in a projected CRS whose axes are easting and northing in metres.

    ``origin``: easting, northing, height (m) of the world's origin, the first left camera's centre. ``azimuth``:
    direction of the world's y axis (the first optical axis, projected to the horizontal), radians clockwise from grid
    north. World metres are used as metres of the grid: a projection's scale (0.9996 to 1.001 in UTM) is not applied.
    """

    crs: str
    origin: tuple[float, float, float]
    azimuth: float

    def __post_init__(self) -> None:
        _refuse_places(self.crs)

    @property
    def rotation(self) -> Floats:
        """2 x 2: (easting, northing) = rotation @ (x, y) + origin."""
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        return np.array([[c, s], [-s, c]])

    def apply(self, points: ArrayLike) -> Floats:
        """Easting, northing and height (..., 3) of points (..., 3) of the world frame, metres."""
        p = np.asarray(points, dtype=np.float64)
        turned = np.concatenate([p[..., :2] @ self.rotation.T, p[..., 2:]], axis=-1)
        return np.asarray(turned + np.array(self.origin), np.float64)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"crs": self.crs, "origin": list(self.origin), "azimuth": self.azimuth}

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> Georeference:
        """Inverse of :meth:`to_dict`."""
        return Georeference(d["crs"], tuple(d["origin"]), d["azimuth"])


def _refuse_places(crs: str) -> None:
    """Refuse, by a ValueError, texts by which GDAL might read a file, a pipe, or an address in the net."""
    if not FORMS.match(crs):
        raise ValueError("no file or address is read: give the CRS itself, e.g. EPSG:32633")


def are_degrees(crs: str, origin: Sequence[float]) -> bool:
    """Whether an origin looks like longitude and latitude: in registered CRS it would be far from any vehicle.

    In a CRS of one's own the origin may lie anywhere.
    """
    from rasterio.crs import CRS

    x, y = map(abs, origin[:2])
    return 0 < min(x, y) <= 90 and max(x, y) <= 180 and CRS.from_user_input(crs).to_epsg() is not None


def scale_at(crs: str, origin: Sequence[float]) -> float | None:
    """Metres of the Earth, about, that a metre of a CRS is at an origin; 0: the origin is outside it, None: unknown.

    Of a metre to the east and one to the north that which is farther from 1. Another body's is unknown.
    """
    from rasterio.crs import CRS
    from rasterio.warp import transform

    east, north = origin[:2]
    try:
        places: Any = transform(crs, "OGC:CRS84", [east, east + 1000.0, east], [north, north, north + 1000.0])
    except Exception:  # GDAL's have no public class
        return None if CRS.from_user_input(crs).to_epsg() is None else 0.0
    longitude, latitude = np.radians(places)
    ways = np.hypot((longitude[1:] - longitude[0]) * np.cos(latitude[0]), latitude[1:] - latitude[0]) * EARTH_RADIUS
    return float(max(ways / 1000.0, key=lambda scale: abs(scale - 1.0)))


def metric_crs(text: str) -> str:
    """The CRS as given; ValueError if it is unknown, not projected or not in metres."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    _refuse_places(text)
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise ValueError("it is no known CRS: give e.g. EPSG:32633 (UTM zone 33 north)") from error
    if not crs.is_projected:
        raise ValueError("it is not projected: give one in metres, e.g. EPSG:32633 (UTM zone 33 north)")
    unit, factor = crs.linear_units_factor
    if factor != 1.0:
        raise ValueError(f"it is in {unit} of {factor:.6g} m: give one in metres")
    return text


def projected(table: TextTable, crs: str) -> TextTable:
    """The table with easting and northing, m, in the columns of longitude and latitude, or of coordinates from the
    Earth's centre, whose third has the height above the ellipsoid.

    In ``crs``, or, if that is empty, in the UTM zone of its first place. Rows without a place (no number, or 0 and 0)
    have NaN there. Unchanged if no row has such coordinates, or columns of metres stand beside degrees.

    Raises
    ------
    InputError
        A place lies where ``crs`` has none.
    """
    meant = meanings(table)
    from_centre = _from_centre(table, meant)
    degrees = meant.keys() >= {"lat", "lon"} and not meant.keys() >= {"x", "y"}
    at = from_centre or ([meant["lon"], meant["lat"]] if degrees else [])
    if not at:
        return table
    from rasterio import warp

    transform: Any = warp.transform
    places = table.values(at)
    there = np.asarray(np.isfinite(places).all(axis=1) & places.any(axis=1))
    if from_centre:
        places[there] = np.transpose(transform("EPSG:4978", "EPSG:4979", *places[there].T))
    there &= (np.abs(places[:, :2]) <= (180, 90)).all(axis=1)
    if not there.any():
        return table
    longitude, latitude = places[there][0, :2]
    crs = crs or f"EPSG:{326 if latitude >= 0 else 327}{int(longitude + 180) // 6 % 60 + 1:02d}"
    places[~there] = np.nan
    try:
        places[there, :2] = np.transpose(transform("OGC:CRS84", crs, *places[there, :2].T))
    except Exception as error:  # GDAL's have no public class
        raise InputError("RIL-776", f"{table.name} has places beyond {crs}", remedy="correct or remove them") from error
    cells = (dict(zip(at, map(str, place), strict=True)) for place in places.tolist())
    rows = tuple(tuple((dict(enumerate(row)) | of).values()) for row, of in zip(table.rows, cells, strict=True))
    header = tuple(unitless(name) if k in at else name for k, name in enumerate(table.header))
    return replace(table, rows=rows, header=header, crs=crs)


def _from_centre(table: TextTable, meant: Mapping[str, int]) -> list[int]:
    """Columns x, y and z of positions from the Earth's centre, by their names, or their distance alone; empty: none."""
    named = geocentric(table)
    columns = named if named.keys() >= set(POSITION) else meant
    if "lat" in meant or not columns.keys() >= set(POSITION) or have_rotation(meant):
        return []
    at = [columns[axis] for axis in POSITION]
    places = table.values(at)
    places = places[np.isfinite(places).all(axis=1) & places.any(axis=1)]
    # .006: the ground departs from the mean radius by .5 %.
    on_ground = np.abs(np.linalg.norm(places, axis=1) / EARTH_RADIUS - 1.0) < 0.006
    # A northing may be as large, but no height is 100 km.
    on_earth = on_ground & (bool(named) | (np.abs(places[:, 2]) > 1e5))
    return at if len(places) and on_earth.all() else []
