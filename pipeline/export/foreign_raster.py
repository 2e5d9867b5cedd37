"""Rasters that others may have written, opened so that no file, nor one beside it, can name another that is then read.

GDAL opens what a file says by any of its drivers: tiles of other files, addresses in the net. So the driver is given,
one whose files hold all that they show; and what may lie beside a file (``.msk``, ``.ovr``, ``.aux.xml``) is not read.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rille.datasets.text.reading import open_regular

TIFF = (b"II", b"MM")
"""How a TIFF begins; what begins otherwise is read as an ESRI ASCII grid."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what rasterio prints of GDAL's complaints that quote bytes which are no UTF-8."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """A GeoTIFF or ESRI ASCII grid, open for reading.

    Raises
    ------
    rasterio.errors.RasterioError
        It cannot be read.
    InputError
        It is a pipe or a device, on which GDAL would wait for ever.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

    with open_regular(path, "raster", sys.maxsize) as head:
        driver = "GTiff" if head.peek(2).startswith(TIFF) else "AAIGrid"
    with warnings.catch_warnings():
        # Whoever needs a place refuses the file in a line of their own.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            # By these settings GDAL looks for no masks, overviews and notes beside a file.
            alone = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO")
            with _quiet(), alone, rasterio.open(path, driver=driver) as file:
                yield file
        except UnicodeDecodeError as error:
            raise RasterioIOError("a text in it is not UTF-8") from error
