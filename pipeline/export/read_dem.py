"""Read elevation models from a GeoTIFF, an ESRI ASCII grid or a run's folder, and ortho images.

Others may have written them: no file, nor one beside it, may make GDAL read another, as by its drivers for tiles of
other files or addresses in the net. So one of two drivers is given, whose files hold all their data, and files beside
(``.msk``, ``.ovr``, ``.aux.xml``) are not read.
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from affine import Affine
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.datasets.text.reading import TABLE, Search, open_regular, read_lines, read_text
from rille.pipeline.engine.memory import free, words
from rille.pipeline.export.writers import ENGINEERING_CRS
from rille.stages.core.errors import InputError, warning
from rille.stages.terrain.relief.grid import Grid

MAX_CELLS = 500_000_000
"""Most cells of an elevation model."""

OURS = "give a run as Rille writes it"

TIFF = (b"II", b"MM")
"""First bytes of a TIFF; any other file is read as an ESRI ASCII grid."""


METRE = ("m", "metre", "metres", "meter", "meters")


@dataclass(frozen=True)
class DemFile:
    """An elevation model of any program.

    ``grid`` of elevations, metres, NaN unknown, in the CRS. ``crs`` WKT, empty if the file states none.
    ``viewpoints`` (n, 2) positions of the cameras in the CRS, if known. ``sigma`` (rows, cols) standard deviation of
    the elevations, metres, if known. ``warnings``: suspicious but possible properties. ``frame`` in words, if Rille
    wrote it.
    """

    name: str
    grid: Grid
    crs: str
    viewpoints: NDArray[np.float64] | None = None
    sigma: NDArray[np.float64] | None = None
    warnings: tuple[str, ...] = ()
    frame: str = ""


def transform_of(grid: Grid) -> Affine:
    """Transform of a raster from (column, row), corners of cells at integers, to the CRS."""
    return Affine(*grid.matrix.ravel()) @ Affine.translation(-0.5, -0.5)


def _placed(values: NDArray[Any], transform: Affine) -> Grid:
    """Values on the cells of a raster."""
    centres = np.asarray(transform @ Affine.translation(0.5, 0.5), np.float64).reshape(3, 3)[:2]
    return Grid(np.asarray(values, np.float64), centres)


def read_elevation(path: Path) -> DemFile:
    """Read an elevation model.

    Parameters
    ----------
    path : GeoTIFF (its first band) or ESRI ASCII grid (``.asc``), or folder of a run (its ``dem.tif``, with the cameras
        of ``trajectory.kitti``).

    Raises
    ------
    InputError
        There is no such file, it is none of these, its unit is not the metre, or it has no known cell.
    """
    if not path.exists():
        remedy = "give a GeoTIFF or ESRI ASCII grid, or the folder of a run"
        raise InputError("RIL-627", f"{path} does not exist", remedy=remedy)
    dem = _without_marks(_of_run(path) if path.is_dir() else read_raster(path))
    _check_known(path, dem.grid)
    return dem


def _check_known(path: Path, grid: Grid) -> None:
    if not np.isfinite(grid.values).any():
        raise InputError("RIL-628", f"{path} has no known cell among {grid.values.size}", remedy="give another")


def _without_marks(dem: DemFile) -> DemFile:
    """The model without values that mark unknown cells although the file does not declare them, each with a warning.

    Such a value is the least or the greatest, and differs from all others by more than ground can rise within a cell:
    by more than the height of any wall, or, if several cells have it, by a nearly vertical rise that exceeds the range
    of all others. Seas, quarries and plateaus have slopes around, or differ less. For a usual mark a tenth of that is
    enough, if its cells are scattered; a sea below a cliff stays, with a warning.
    """
    values, cell = dem.grid.values, dem.grid.cell
    least, most = np.nanmin(values, initial=np.inf), np.nanmax(values, initial=-np.inf)
    if least >= most:
        return dem
    between = values[(values > least) & (values < most)]
    if not between.size:  # two values: the mark is the rarer one
        between = np.nanmedian(values, keepdims=True)
    low, high = between.min(), between.max()
    gap, mark = max((low - least, least), (most - high, most))
    marked = values == mark
    several, apart = marked.sum() > 1, gap > high - low
    usual = apart and gap > 30.0 * cell and mark in (0.0, -1.0, -99.0, -999.0, 255.0, 999.0)
    inner = scipy.ndimage.binary_erosion(marked, np.ones((3, 3)), border_value=1)
    # No ground rises by 300 cells, or by 1500 m, within one cell.
    steep = gap > 300.0 * cell and several and apart
    others = f"the others are {low:.6g} to {high:.6g} m"
    text = f"{dem.name}: {mark:.9g} in {marked.sum()} cells {{}}, {others}: taken as {{}}"
    if not (steep or (gap > 1500.0 and (several or apart)) or (usual and 2 * inner.sum() < marked.sum())):
        doubt = text.format("may be no elevation", "one; if it marks what is unknown, state it in the file, as NODATA")
        return replace(dem, warnings=(*dem.warnings, warning("RIL-726", doubt))) if usual else dem
    line = warning("RIL-725", text.format("is no elevation", "unknown; state it in the file, as NODATA"))
    # There may be another such value.
    known = Grid(np.where(marked, np.nan, values), dem.grid.matrix)
    return _without_marks(replace(dem, grid=known, warnings=(*dem.warnings, line)))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress what rasterio prints about GDAL's messages that quote bytes other than UTF-8."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def opened_raster(path: Path) -> Iterator[Any]:
    """A GeoTIFF or ESRI ASCII grid, open for reading.

    Raises
    ------
    InputError
        It cannot be read, or is a pipe or a device, for which GDAL would wait for ever.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with open_regular(path, "raster", sys.maxsize) as head:
        driver = "GTiff" if head.peek(2).startswith(TIFF) else "AAIGrid"
    # With these settings GDAL reads no masks, overviews and metadata beside a file.
    alone = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO")
    with warnings.catch_warnings(), _quiet(), alone:
        # Callers that need a geotransform refuse the file with their own message.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with rasterio.open(path, driver=driver) as file:
                yield file
        except (RasterioError, UnicodeDecodeError) as error:
            remedy = "give a GeoTIFF, or an ESRI ASCII grid as text without a byte order mark"
            if error.__cause__:  # GDAL has opened it, but not read all of it
                remedy = "it breaks off or is damaged: copy it again"
            text = f"{path} cannot be read as a raster ({error.__cause__ or error})"
            raise InputError("RIL-629", text, remedy=remedy) from error


def read_raster(path: Path, holds: str = "elevation") -> DemFile:
    """First band of a GeoTIFF, or an ESRI ASCII grid.

    Parameters
    ----------
    holds : name of the band in a raster of Rille's own.

    Raises
    ------
    InputError
        It cannot be read, has no geotransform, another unit, or holds something else.
    """
    with opened_raster(path) as file:
        _check_cells(path, file.shape)
        # Integers may have a scale and an offset, which rasterio does not apply.
        tags, coloured = file.tags(), "red" in {band.name for band in file.colorinterp}
        # Tags of Rille's rasters: of a run, and of a comparison.
        if coloured or (file.descriptions[0] != holds and not tags.keys().isdisjoint(("FRAME", "ERROR"))):
            text = f"{path} has {'colours' if coloured else file.descriptions[0]}, no {holds}"
            remedy = "give an elevation model, of a run dem.tif; rille localize takes images by --ortho"
            raise InputError("RIL-636", text, remedy=remedy)
        values = file.read(1, out_dtype="float64", masked=True).filled(np.nan) * file.scales[0] + file.offsets[0]
        crs, transform, unit, frame = file.crs, file.transform, file.units[0], tags.get("FRAME", "")
    wkt = _checked_system(path, transform, crs)
    # Lengths of the cell's sides, not a and e, because a raster may be turned.
    across, down = np.hypot(transform.a, transform.d), np.hypot(transform.b, transform.e)
    if not (0.0 < abs(transform.determinant) < math.inf and np.isclose(across, down, rtol=1e-6, atol=0.0)):
        remedy = "resample it to square cells, e.g. with gdalwarp -tr"
        raise InputError("RIL-631", f"{path} has cells of {across:g} x {down:g}", remedy=remedy)
    if unit and unit.lower() not in METRE:
        remedy = "convert it, e.g. with gdal_calc"
        raise InputError("RIL-632", f"{path} has elevations in {unit!r}, not in metres", remedy=remedy)
    doubt = warning("RIL-962", f"{path} states no unit of its elevations: taken as metres")
    return DemFile(str(path), _placed(values, transform), wkt, warnings=() if unit else (doubt,), frame=frame)


def read_ortho(path: Path) -> tuple[Grid, str]:
    """Grey image of the ground, the mean of the bands of a GeoTIFF, and its CRS (WKT), empty if it states none.

    Raises
    ------
    InputError
        It cannot be read, has no geotransform, no known cell, or is not in metres.
    """
    with opened_raster(path) as file:
        _check_cells(path, file.shape)
        grey, known = file.read(out_dtype="float32").mean(axis=0), file.dataset_mask() != 0
        t, crs = file.transform, file.crs
    wkt = _checked_system(path, t, crs)
    grid = _placed(np.where(known, grey, np.nan), t)
    _check_known(path, grid)
    return grid, wkt


def _check_cells(path: Path, shape: tuple[int, ...]) -> None:
    """Refuse more cells than memory, or a file of that size, can hold."""
    stored = path.stat().st_size
    # 100: bytes for a cell while it is read, and compared or exported.
    most = min(MAX_CELLS, free() // 100, max(4_000_000, 50 * stored))
    if math.prod(shape) > most:
        size = f"{' x '.join(map(str, shape))} cells in {words(stored)}"
        text = f"{path} has {size}, at most {most / 1e6:.3g} million are read"
        raise InputError("RIL-981", text, remedy="cut it, or resample it to larger cells")


def _checked_system(path: Path, transform: Affine, crs: Any) -> str:
    """WKT of the CRS of a raster, empty if it states none."""
    if transform == Affine.identity():
        remedy = "give a raster that says itself where its cells are"
        raise InputError("RIL-630", f"{path} has no geotransform", remedy=remedy)
    if crs is None:
        return ""
    if crs.is_geographic:
        remedy = "project it, e.g. with gdalwarp -t_srs"
        raise InputError("RIL-633", f"{path} is in degrees ({crs.to_string()})", remedy=remedy)
    # rasterio has units of projected systems alone; engineering systems are assumed to be in metres.
    unit, factor = crs.linear_units_factor if crs.is_projected else ("metre", 1.0)
    if factor != 1.0:
        raise InputError("RIL-634", f"{path} has coordinates in {unit} of {factor:.6g} m", remedy="give one in metres")
    return str(crs.to_wkt(version="WKT2_2019"))


def crs_name(wkt: str) -> str:
    """Name of a CRS (WKT)."""
    return wkt.split('"')[1] if '"' in wkt else wkt


def refuse_unlike_systems(stated: Mapping[str, str]) -> None:
    """Refuse models and images of unlike CRS.

    Parameters
    ----------
    stated : CRS of each by its name, WKT or as users write it; empty if it states none.

    Raises
    ------
    InputError
        Two CRS differ.
    """
    from rasterio.crs import CRS

    own = crs_name(ENGINEERING_CRS)
    for (a, first), (b, second) in pairwise((name, crs) for name, crs in stated.items() if crs):
        names = crs_name(first), crs_name(second)
        if first != second and set(names) != {own} and CRS.from_user_input(first) != CRS.from_user_input(second):
            text = f"{a} is in {names[0]}, {b} in {names[1]}"
            remedy = "bring one to the other's system: a raster by gdalwarp -t_srs, a run by its manifest's [world]"
            if own in names:
                remedy = "rille localize RUN MAP finds a run's place; state it in the manifest ([world]), and run again"
            raise InputError("RIL-615", text, remedy=remedy)


def no_ground(name: str) -> InputError:
    """Error for elevations that are not heights of ground, where these are needed."""
    text = f"elevations of {name} are distances from a plane that is no ground"
    return InputError("RIL-842", text, remedy="run it with --set terrain.reference=ground")


def _of_run(path: Path) -> DemFile:
    if not (path / "dem.tif").is_file():
        remedy = "give a GeoTIFF, or a whole run: the report of this one says what it lacks, or was not asked for"
        raise InputError("RIL-635", f"{path} has no dem.tif", remedy=remedy)
    dem, beside = read_raster(path / "dem.tif"), path / "dem_sigma.tif"
    sigma = read_raster(beside, "elevation_std").grid.values if beside.is_file() else None
    # A raster of other cells belongs to another model.
    sigma = sigma if sigma is not None and sigma.shape == dem.grid.values.shape else None
    return replace(dem, name=str(path), viewpoints=_cameras(path), sigma=sigma)


def _cameras(run: Path) -> NDArray[np.float64] | None:
    """Positions (n, 2) of the left camera in the CRS of the run's rasters."""
    if not all((run / name).exists() for name in ("trajectory.kitti", "frames.json")):
        return None
    # Read outside of the try: an unreadable file is an error, while one with other content just has no cameras.
    lines = read_lines(run / "trajectory.kitti", "trajectory")
    frames = read_text(run / "frames.json", "frames.json", TABLE)
    try:
        poses, place = np.loadtxt(lines, ndmin=2), georeference_in(json.loads(frames))
        centres = poses[:, [3, 7, 11]][np.isfinite(poses[:, 3])]
        return np.asarray((centres if place is None else place.apply(centres))[:, :2], np.float64)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None


def frames_of(path: Path) -> dict[str, Any]:
    """Content of a run's ``frames.json``; empty if there is none."""
    return dict(json.loads(read_text(path, "frames.json", TABLE))) if path.exists() else {}


def georeference_in(frames: Mapping[str, Any]) -> Georeference | None:
    """Place of a run's world frame on Earth by its :func:`frames_of`; None: it has none."""
    stated = frames.get("georeference")
    return None if stated is None else Georeference.from_dict(stated)


def check_group(path: Path) -> None:
    """Refuse a zarr group with larger axes or chunks than Rille writes, with other codecs, or with links or pipes.

    Raises
    ------
    InputError
        It has such an array, or one that might unpack to any size, or a link, or a pipe, for which zarr would wait for
        ever.
    ValueError, OSError, KeyError, TypeError
        It is no zarr group.
    """
    import zarr
    from zarr.storage import LocalStore

    refuse_irregular(path)
    for name, array in zarr.open_group(store=LocalStore(path, read_only=True), mode="r").arrays():
        # 10_000_000: longest axis, because coordinates are always read whole.
        if max(array.shape, default=0) > 10_000_000 or math.prod(array.chunks) > MAX_CELLS:
            size = " x ".join(map(str, array.shape))
            raise InputError("RIL-982", f"{path}: {name} has {size} values, too many to be read", remedy=OURS)
        packed = max((file.stat().st_size for file in (path / name).iterdir()), default=0)
        codecs = {getattr(codec, "codec_id", "") for codec in (*array.filters, *array.compressors)}
        # 4_000_000 bytes of a packed chunk of 512 x 512 values: zlib unpacks a byte to at most 1000, blosc to 255.
        if array.metadata.zarr_format != 2 or codecs - {"zlib", "blosc"} or packed > 4_000_000:
            text = f"{path}: {name} is packed as Rille packs nothing, and may unpack to any size"
            raise InputError("RIL-997", text, remedy=OURS)


def refuse_irregular(path: Path) -> None:
    """Refuse a path of a run with links or pipes in it: Rille writes none, and a link's target is no part of the run.

    Raises
    ------
    InputError
        There is one.
    """
    for file in (path, *(Path(entry.path) for _, entries in Search().below(path, hidden=True) for entry in entries)):
        if file.is_symlink() or not (file.is_file() or file.is_dir()):
            raise InputError("RIL-723", f"{file} is no regular file", remedy=OURS)
