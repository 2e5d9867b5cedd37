"""Width, height and depth of an image file from its header: what it would unpack to is known before it is unpacked.

A PNG of a hundred kilobytes may hold 900 megapixels. The formats here are those that are read at all, so that no other
decoder ever sees a file.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from io import SEEK_CUR
from typing import BinaryIO

from rille.stages.geometry.geometry import Sizes

Header = tuple[int, int, int]
"""Width and height, pixels, and bits a sample as they are decoded, 8 or 16 (more where they are no integers)."""

Headers = tuple[Header, Header]
"""Of the left and of the right images: two cameras need not be alike."""


def sizes_of(headers: Headers) -> Sizes:
    """Width and height of the left and of the right images, pixels."""
    return headers[0][:2], headers[1][:2]


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

NETPBM = re.compile(rb"P([1-6])(?:\s|#[^\r\n]{0,200}[\r\n]){1,50}(\d{1,9})(?:\s|#[^\r\n]{0,200}[\r\n]){1,50}(\d{1,9})")
NETPBM_WHITE = re.compile(rb"(?:\s|#[^\r\n]{0,200}[\r\n]){1,50}(\d{1,6})")

FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
"""JPEG markers of a frame header; the others of that row are tables."""

WIDTH, HEIGHT, BITS = 256, 257, 258
"""TIFF tags."""

INTEGERS: Mapping[int, str] = {3: "H", 4: "I", 16: "Q"}
"""TIFF's types of whole numbers."""

MOST_TAGS = 1000


def read_header(file: BinaryIO) -> Header | None:
    """Header of an image file, open at its beginning; None where the file is no PNG, JPEG, TIFF, PGM, PPM or BMP."""
    start = file.read(512)
    for begins, read in FORMATS:
        if re.match(begins, start):
            # A header that breaks off, or points beyond its file, is none: the decoder's refusal then says what is
            # wrong.
            with suppress(struct.error, ValueError, OverflowError):
                return read(file, start)
    return None


def _depth(bits: int) -> int:
    return 8 if bits <= 8 else 16 if bits <= 16 else bits


def _png(file: BinaryIO, start: bytes) -> Header | None:
    width, height, bits = struct.unpack_from(">IIB", start, 16)
    return width, height, _depth(bits)


def _jpeg(file: BinaryIO, start: bytes) -> Header | None:
    file.seek(2)
    while len(mark := file.read(4)) == 4 and mark[0] == 0xFF:
        if mark[1] == 0xFF:  # padding
            file.seek(-3, SEEK_CUR)
            continue
        if mark[1] in FRAMES:
            bits, height, width = struct.unpack(">BHH", file.read(5))
            return width, height, _depth(bits)
        (length,) = struct.unpack(">H", mark[2:])
        file.seek(max(length - 2, 0), SEEK_CUR)
    return None


def _tiff(file: BinaryIO, start: bytes) -> Header | None:
    order = "<" if start.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", start, 2)[0] == 43
    count_form, tag_form = (order + "Q", order + "HHQ8s") if big else (order + "H", order + "HHI4s")
    file.seek(struct.unpack_from(order + ("Q" if big else "I"), start, 8 if big else 4)[0])
    (count,) = struct.unpack(count_form, file.read(struct.calcsize(count_form)))
    size = struct.calcsize(tag_form)
    # The count of a BigTIFF has 64 bits, and would be read as so many bytes.
    tags = file.read(min(count, MOST_TAGS) * size)
    found: dict[int, int] = {}
    for at in range(0, len(tags) - size + 1, size):
        tag, kind, number, value = struct.unpack_from(tag_form, tags, at)
        if tag not in (WIDTH, HEIGHT, BITS) or kind not in INTEGERS:
            continue
        form = order + INTEGERS[kind]
        if number * struct.calcsize(form) > len(value):  # of several samples a pixel
            file.seek(struct.unpack(order + ("Q" if big else "I"), value)[0])
            value = file.read(struct.calcsize(form))
        found[tag] = struct.unpack_from(form, value)[0]
    return (found[WIDTH], found[HEIGHT], _depth(found.get(BITS, 1))) if {WIDTH, HEIGHT} <= set(found) else None


def _netpbm(file: BinaryIO, start: bytes) -> Header | None:
    size = NETPBM.match(start)
    if size is None:
        return None
    white = NETPBM_WHITE.match(start, size.end()) if size[1] not in (b"1", b"4") else None
    bits = 16 if white is not None and int(white[1]) > 255 else 8
    return int(size[2]), int(size[3]), bits


def _bmp(file: BinaryIO, start: bytes) -> Header | None:
    if struct.unpack_from("<I", start, 14)[0] == 12:
        width, height = struct.unpack_from("<HH", start, 18)
    else:
        width, height = struct.unpack_from("<ii", start, 18)
    return abs(width), abs(height), 8  # the sign of the height says which row is first


FORMATS: tuple[tuple[bytes, Callable[[BinaryIO, bytes], Header | None]], ...] = (
    (re.escape(PNG_SIGNATURE) + rb".{4}IHDR", _png),
    (rb"\xff\xd8\xff", _jpeg),
    (rb"II[*+]\0|MM\0[*+]", _tiff),
    (rb"P[1-6][\s#]", _netpbm),
    (rb"BM", _bmp),
)
"""How a file of each format begins, and the reader of its header."""
