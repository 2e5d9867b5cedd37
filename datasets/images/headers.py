"""Width, height and depth of an image file from its header, before it is unpacked.

A PNG of a hundred kilobytes may hold 900 megapixels. Only the formats here are read, so that no other decoder gets a
file.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from warnings import catch_warnings

from rille.stages.geometry.geometry import Sizes


class Header(NamedTuple):
    """Width and height, pixels, and bits per decoded sample, 8 or 16 (more for other types than integers)."""

    width: int
    height: int
    depth: int


Headers = tuple[Header, Header]
"""Of the left and of the right images, which may differ."""

FORMATS = ("PNG", "JPEG", "TIFF", "PPM", "BMP")
"""Pillow's names of the formats."""


def sizes_of(headers: Headers) -> Sizes:
    """Width and height of the left and of the right images, pixels."""
    return headers[0][:2], headers[1][:2]


def read_header(file: BinaryIO) -> Header | None:
    """Header of an image file, open at its start; None if it is no supported PNG, JPEG, TIFF, PGM, PPM or BMP."""
    # Parsers of a damaged header warn and raise anything; the decoder reports the error later.
    with catch_warnings(action="ignore"), suppress(Exception):
        image = opened(file)
        if image is not None:
            bits = _bits(image)
            if image.format == "TIFF" and bits > 8 and image.tag_v2.get(284) == 2 and image.tag_v2.get(277, 1) > 1:
                return None  # planar bands, whose rows OpenCV would mix
            # Pillow exchanges width and height if an orientation tag says that the image is turned.
            width, height = (image.tag_v2[k] for k in (256, 257)) if image.format == "TIFF" else image.size
            return Header(width, height, 8 if bits <= 8 else 16 if bits <= 16 else bits)
    return None


def opened(file: BinaryIO) -> Any:
    """Pillow's image of a file, with only its header read, of any size; None if it has another format."""
    # Each reader registers its format; `Image.init` would import those of forty others.
    from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, PpmImagePlugin, TiffImagePlugin  # noqa: F401

    start = file.read(16)
    file.seek(0)
    # Not by `Image.open`, which has its own limit of pixels.
    fits = (Image.OPEN[name] for name in FORMATS)
    return next((factory(file, "") for factory, accepts in fits if accepts is None or accepts(start)), None)


def orientation(image: Any) -> int:
    """EXIF's orientation of an image of Pillow, 2 to 8; 1 if it states none or another."""
    # Parsers of damaged tags raise anything.
    with catch_warnings(action="ignore"), suppress(Exception):
        # 0x0112: EXIF's orientation: 1 as stored, 3 upside down, 6 and 8 turned by a quarter, others mirrored.
        # Not for a PNG without EXIF, which Pillow would decode as a whole to search for it.
        stated = int(image.getexif().get(0x0112, 1)) if image.format != "PNG" or "exif" in image.info else 1
        return stated if 1 <= stated <= 8 else 1
    return 1


def located(path: Path) -> bool:
    """Whether EXIF of an image file states a latitude and a longitude."""
    with catch_warnings(action="ignore"), suppress(Exception), path.open("rb") as file:
        image = opened(file)
        return image.format in ("JPEG", "TIFF") and {2, 4} <= image.getexif().get_ifd(0x8825).keys()
    return False


def _bits(image: Any) -> int:
    """Bits per sample."""
    if image.format == "TIFF":
        return int(image.tag_v2.get(258, (1,))[0])  # BitsPerSample
    if image.format in ("JPEG", "MPO", "BMP"):  # MPO: Pillow's name of a JPEG with a preview after it, as of drones
        return 8
    # Names of layouts with two bytes per sample have "16"; a netpbm file's layout has its greatest value.
    layout = image.tile[0].args
    return 16 if (layout[1] > 255 if isinstance(layout, tuple) else "16" in layout) else 8
