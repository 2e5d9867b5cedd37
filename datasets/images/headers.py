"""Width, height and depth of an image file from its header: what it would unpack to is known before it is unpacked.

A PNG of a hundred kilobytes may hold 900 megapixels. The formats here are those that are read at all, so that no other
decoder ever sees a file.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any, BinaryIO, NamedTuple
from warnings import catch_warnings

from rille.stages.geometry.geometry import Sizes


class Header(NamedTuple):
    """Width and height, pixels, and bits a sample as they are decoded, 8 or 16 (more where they are no integers)."""

    width: int
    height: int
    depth: int


Headers = tuple[Header, Header]
"""Of the left and of the right images: two cameras need not be alike."""

FORMATS = ("PNG", "JPEG", "TIFF", "PPM", "BMP")
"""Pillow's names of the formats."""


def sizes_of(headers: Headers) -> Sizes:
    """Width and height of the left and of the right images, pixels."""
    return headers[0][:2], headers[1][:2]


def read_header(file: BinaryIO) -> Header | None:
    """Header of an image file, open at its start; None of what is no PNG, JPEG, TIFF, PGM, PPM or BMP that is read."""
    # Of a damaged header whatever its parser warns of or comes upon: the decoder's refusal then says what is wrong.
    with catch_warnings(action="ignore"), suppress(Exception):
        image = opened(file)
        if image is not None:
            bits = _bits(image)
            if image.format == "TIFF" and bits > 8 and image.tag_v2.get(284) == 2 and image.tag_v2.get(277, 1) > 1:
                return None  # bands one behind the other, of which OpenCV would mix the rows
            # Pillow exchanges width and height where a tag says that the image is turned.
            width, height = (image.tag_v2[k] for k in (256, 257)) if image.format == "TIFF" else image.size
            return Header(width, height, 8 if bits <= 8 else 16 if bits <= 16 else bits)
    return None


def opened(file: BinaryIO) -> Any:
    """Pillow's image of a file of which the header alone is read, of any size; None where it is of another format."""
    # Each reader enters its format; `Image.init` would import those of forty others.
    from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, PpmImagePlugin, TiffImagePlugin  # noqa: F401

    start = file.read(16)
    file.seek(0)
    # Not by `Image.open`, which refuses by a limit of its own how many pixels are too many.
    fits = (Image.OPEN[name] for name in FORMATS)
    return next((factory(file, "") for factory, accepts in fits if accepts is None or accepts(start)), None)


def orientation(image: Any) -> int:
    """EXIF's orientation of an image of Pillow; 1 where it states none."""
    # Of a damaged tag: whatever the parsers of three formats come upon.
    with catch_warnings(action="ignore"), suppress(Exception):
        # EXIF's tag of the orientation: 1 as stored, 3 upside down, 6 and 8 turned by a quarter, others mirrored
        # Pillow decodes a whole PNG in search of what it does not have.
        return int(image.getexif().get(0x0112, 1)) if image.format != "PNG" or "exif" in image.info else 1
    return 1


def _bits(image: Any) -> int:
    """Bits a sample."""
    if image.format == "TIFF":
        return int(image.tag_v2.get(258, (1,))[0])  # BitsPerSample
    if image.format in ("JPEG", "MPO", "BMP"):  # Pillow's name of a JPEG with a preview behind it, as drones write
        return 8
    # Layouts of two bytes a sample have "16" in their names; beside others stands a netpbm file's greatest value.
    layout = image.tile[0].args
    return 16 if (layout[1] > 255 if isinstance(layout, tuple) else "16" in layout) else 8
