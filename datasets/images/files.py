"""Stage ``image``: one image file, checked and grey. Also checks of image files for readers of folders."""

from __future__ import annotations

import hashlib
import math
import os
import re
import threading
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.datasets.facts import ImageFacts
from rille.datasets.images.headers import Header, opened, orientation, read_header
from rille.datasets.images.kinds import KINDS, kind_of
from rille.datasets.protocol import Source
from rille.datasets.text.reading import mark, open_regular, read_bytes
from rille.stages.core.arrays import Bytes
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError
from rille.stages.imaging.levels import Levels, spread, swapped

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # errors here replace its messages on stderr

SUFFIXES = (".png", ".jpg", ".jpeg", ".jfif", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".bmp")
"""Endings of image files that are searched for without a pattern."""

MOST_PIXELS = 160_000_000
"""Most pixels of one image: the largest sensors have 150 million."""

MOST_BYTES = 2**29
"""Most bytes of one image file."""

FEWER_BITS = "save it with 8 or 16 bits a sample, without sign"
COPY_AGAIN = "copy the file again, or remove it"
EXCHANGE = 'python -c "import sys, cv2; [cv2.imwrite(f, cv2.imread(f, -1).byteswap()) for f in sys.argv[1:]]"'

PNG, JPEG, TIFF = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", (b"II", b"MM")
"""First bytes of files."""

ENDS = {PNG[:2]: b"IEND", JPEG: b"\xff\xd9"}
"""End markers by the first two bytes of a file."""

_STDERR = threading.Lock()

LIBJPEG = re.compile(
    rb"(Corrupt JPEG|Premature end of|Inconsistent progression|Invalid SOS|Unknown Adobe|Warning: unknown JFIF).*\n?"
)
"""Warnings of libjpeg (its ``jerror.h``)."""

COLOUR = Array(
    "colour", ("row", "col", "band"), "uint8", "grey", "red, green and blue of the left image", optional=True
)

Grey = Bytes | NDArray[np.uint16]


def _damage(data: bytes) -> str:
    """Damage of a file, in words; empty: none. Decoders may return partly black images of truncated files."""
    if not data:
        return "is empty"
    if data.startswith(PNG):
        try:
            opened(BytesIO(data)).verify()
        except Exception as error:  # parsers of damaged files raise anything
            return f"is damaged or truncated ({' '.join(str(error).split())[:100]})"
    return ""


def _damaged(text: str) -> InputError:
    return InputError("RIL-170", text, remedy=COPY_AGAIN)


def _unpacked(data: bytes) -> tuple[AnyArray | None, str]:
    """Image of an encoded file as stored, None if it cannot be decoded; and its damage, in words.

    libjpeg reports damage only on the process's stderr, where other threads may write too, and still returns an image.
    """
    if not data.startswith(JPEG):
        return _decoded(data), ""
    with _STDERR, TemporaryFile() as aside:
        try:
            kept = os.dup(2)
        except OSError:  # the program was started without stderr
            return _decoded(data), ""
        try:
            os.dup2(aside.fileno(), 2)
            image = _decoded(data)
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        aside.seek(0)
        said = aside.read()
    with suppress(OSError):
        os.write(2, LIBJPEG.sub(b"", said))
    complaints = "; ".join(match[0].decode(errors="replace").strip() for match in LIBJPEG.finditer(said))
    padding = re.fullmatch(r"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9", complaints)
    # 16: bytes before a JPEG's end marker that are no damage, since webcams pad their images.
    return image, "" if padding and int(padding[1]) <= 16 else complaints


def _decoded(data: bytes) -> AnyArray | None:
    # Netpbm's text may end with its last number, after which OpenCV needs white space.
    data = data + b"\n" if data[:2] in (b"P2", b"P3") else data
    try:
        # Unchanged: 16 bits stay 16, and orientation tags are ignored, since the calibration is of the stored image.
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    # OpenCV turns a TIFF by its tag nevertheless.
    if image is not None and data.startswith(TIFF):
        return _turned_back(image, orientation(opened(BytesIO(data))))
    return image


def _turned_back(image: AnyArray, tag: int) -> AnyArray:
    """The image as stored, from one that was turned by its orientation tag."""
    if tag in (6, 8):
        return np.rot90(image, 1 if tag == 6 else -1)
    if tag in (5, 7):
        image = image.swapaxes(0, 1)
    return image[:: -1 if tag in (3, 4, 7) else 1, :: -1 if tag in (2, 3, 7) else 1]


def decode(data: bytes, name: str, wanted: Header | None = None) -> Grey:
    """Grey image of an encoded file, see :func:`decode_colour`."""
    return decode_colour(data, name, wanted)[0]


def decode_colour(
    data: bytes, name: str, wanted: Header | None = None, levels: Levels | None = None
) -> tuple[Grey, Bytes | None]:
    """Grey image of an encoded file, and its colours if it has any.

    Colour becomes grey by ITU-R BT.601, 0.299 R + 0.587 G + 0.114 B; an alpha channel is dropped, an orientation tag
    ignored (the calibration is of the stored pixels).

    Parameters
    ----------
    data : the file's bytes.
    name : for errors.
    wanted : required width, height and bits; the header is compared before anything is unpacked.
    levels : by which samples are spread, for sequences whose 16-bit images use a small part of their range.

    Returns
    -------
    grey : (row, col), uint8 or uint16 as stored.
    colour : (row, col, 3) uint8 red, green, blue; None if the file, or all of its pixels, are grey.

    Raises
    ------
    InputError
        The file is truncated, damaged, of another kind, size or depth, or its samples are neither 8- nor 16-bit.
    """
    damage = _damage(data)
    if damage:
        raise _damaged(f"{name} {damage}")
    header = usable(read_header(BytesIO(data)), name)
    if wanted is not None:
        check_size(header._replace(depth=wanted.depth), wanted, name)
    image, complaint = _unpacked(data)
    if image is None:
        raise InputError("RIL-763", f"{name} cannot be decoded", remedy=f"{COPY_AGAIN}, or save a TIFF uncompressed")
    if complaint:
        raise InputError("RIL-192", f"{name} is damaged ({complaint})", remedy=COPY_AGAIN)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError("RIL-172", f"{name} has samples of type {image.dtype}", remedy=FEWER_BITS)
    image = spread(image, levels)
    colour: Bytes | None = None
    if image.ndim == 3 and image.shape[2] >= 3:
        three = np.ascontiguousarray(image[:, :, :3])
        # Many grey cameras save three equal bands, which are no colours.
        if (three != three[:, :, :1]).any():
            eight = three if three.dtype == np.uint8 else (three >> 8).astype(np.uint8)
            colour = np.ascontiguousarray(eight[:, :, ::-1])
        image = cv2.cvtColor(three, cv2.COLOR_BGR2GRAY)
    elif image.ndim == 3:
        image = image[:, :, 0]
    grey: Grey = np.ascontiguousarray(image)
    if wanted is not None:
        # The decoded image too, since a header may be wrong.
        check_size(Header(grey.shape[1], grey.shape[0], grey.dtype.itemsize * 8), wanted, name)
    return grey, colour


def usable(header: Header | None, name: str) -> Header:
    """The header, if its image may be decoded; else an error."""
    if header is None:
        kind = kind_of(name)
        text = f"{name} cannot be read as an image"
        read = "PNG, JPEG, TIFF and PGM of 8 or 16 bits, grey or RGB with interleaved bands, are read"
        remedy = f"{COPY_AGAIN}; {read}" if kind == "file" else KINDS[kind][1]
        raise InputError("RIL-171", text, remedy=remedy)
    width, height, bits = header
    if bits > 16:
        raise InputError("RIL-761", f"{name} has samples of {bits} bits", remedy=FEWER_BITS)
    if not 0 < width * height <= MOST_PIXELS:
        text = f"{name} has {width} x {height} pixels, 1 to {MOST_PIXELS / 1e6:g} million are read"
        raise InputError("RIL-762", text, remedy="leave its frame out, or give smaller images")
    return header


def read_grey(path: Path) -> Grey:
    """Grey image (row, col), uint8 or uint16, of a file (see :func:`decode`)."""
    return decode(read_bytes(path, "image", MOST_BYTES), str(path))


def refuse_swapped(images: Sequence[AnyArray], name: str) -> None:
    """Refuse grey images, called ``name``, if the bytes of 16-bit samples are exchanged in all of them.

    Raises
    ------
    InputError
        They are exchanged.
    """
    if images and all(map(swapped, images)):
        text = f"the samples of 16 bits of {name} have their bytes in the wrong order"
        raise InputError("RIL-830", text, remedy=f"exchange them: {EXCHANGE} FILES")


class Common(NamedTuple):
    """Header of most images of a camera, and for each other image why it cannot be used."""

    header: Header
    refused: dict[Path, str]


def common_header(paths: Sequence[Path]) -> Common:
    """Width, height and bits per sample of most images, and the images that have others or cannot be read.

    Raises
    ------
    InputError
        No image can be read, or most of them do not share one size and depth, or these are not supported.
    """
    headers, refused = dict[Path, Header](), dict[Path, InputError]()
    for path in paths:
        try:
            headers[path] = _header(path)
        except InputError as error:
            refused[path] = error
    wanted, count = next(iter(Counter(headers.values()).most_common(1)), (Header(0, 0, 0), 0))
    unlike = {path: _unlike(found, wanted, str(path)) for path, found in headers.items() if found != wanted}
    refused |= unlike
    if 2 * count <= len(headers):
        raise next(iter((unlike or refused).values()))
    usable(wanted, str(next(path for path in paths if path not in refused)))
    words = {p: why.message.replace(str(p), f"{p.parent.name}/{p.name}") for p, why in refused.items()}
    return Common(wanted, words)


def _header(path: Path) -> Header:
    """Header of an image file.

    Raises
    ------
    InputError
        It cannot be read, or is truncated.
    """
    with open_regular(path, "image", MOST_BYTES) as file:
        start, header = file.peek(2)[:2], read_header(file)
        size = file.seek(0, os.SEEK_END)
        # Padding may follow the end marker.
        file.seek(max(0, size - 4096))
        bands = {b"P5": 1, b"P6": 3, b"BM": 1}.get(start, 0)  # at least, of samples that are not packed
        if header is not None and size >= bands * math.prod(header) // 8 and ENDS.get(start, b"") in file.read():
            return header
    image = read_grey(path)  # raises the error
    return Header(image.shape[1], image.shape[0], 8 * image.itemsize)


class Digests:
    """SHA-256 of files, remembered by path, inode, size and times.

    With a ``memory`` file each new digest is appended there as a line, the digest first and the path last. It is only a
    memo: lines that do not parse are skipped, and errors of writing ignored.

    Attributes
    ----------
    growing : whether images are still arriving: those without a partner, and rows of tables for later images, are left
        out.
    """

    growing = False

    def __init__(self, memory: Path | None = None) -> None:
        self._memory = memory
        self._known: dict[str, str] = {}
        with suppress(OSError):  # in a shared cache it may be private to its owner
            if memory is not None and memory.is_file():
                lines = memory.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
                parts = (line.partition(" ") for line in lines)
                self._known = {key: digest for digest, _, key in parts if len(digest) == 64}

    def whole(self, path: Path) -> bool:
        """Whether an image file is complete, and not still being written."""
        return True

    def sha256(self, path: Path) -> str:
        """Hexadecimal digest of the file's bytes."""
        try:
            status = path.stat()
        except OSError as error:
            raise InputError("RIL-175", f"{path} cannot be read: {error.strerror}", remedy="check the path") from error
        key = f"{mark(status)} {path.resolve()}"
        if key not in self._known:
            with open_regular(path, "image", MOST_BYTES) as file:
                self._known[key] = hashlib.file_digest(file, "sha256").hexdigest()
            if self._memory is not None:
                # Appended, not rewritten: two runs at once both keep their digests, and a torn line is skipped.
                with suppress(OSError):
                    self._memory.parent.mkdir(parents=True, exist_ok=True)
                    with self._memory.open("a", encoding="utf-8", errors="surrogateescape") as memory:
                        memory.write(f"{self._known[key]} {key}\n")
        return self._known[key]


def image_source(path: Path, frame: int, camera: str, header: Header, digests: Digests) -> Source:
    """Source of one file with the required ``header``."""
    args = {"sha256": digests.sha256(path), "camera": camera, "frame": frame, "header": header._asdict()}
    return Source("rille.datasets.images.files", NoParams(), args, hints={"path": str(path.resolve())})


def read_unchanged(path: Path, sha256: str, name: str) -> bytes:
    """Content of a file whose digest is in the key of a task.

    Raises
    ------
    InputError
        It cannot be read, or its digest has changed, so that it must not be stored under the key of the former content.
    """
    data = read_bytes(path, "image", MOST_BYTES)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError("RIL-177", f"{name} has changed since the run began", remedy="run the same command again")
    return data


def check_size(found: Header, wanted: Header, name: str) -> None:
    """Refuse an image whose width, height or depth differs from those of its camera's other images."""
    if found != wanted:
        raise _unlike(found, wanted, name)


def _unlike(found: Header, wanted: Header, name: str) -> InputError:
    words = [f"{w} x {h}, {d} bits" for w, h, d in (found, wanted)]
    text = f"{name} is {words[0]}; others of its camera are {words[1]}"
    remedy = "all images of a camera must have one size and depth: leave the frame out, convert it, or state a pattern "
    remedy += "without thumbnails in a manifest (IMG_????.jpg)"
    return InputError("RIL-176", text, remedy=remedy)


@stage(
    "image",
    outputs=[
        Array("image", ("row", "col"), "uint8", "grey", "image", deep="uint16"),
        Array("valid", ("row", "col"), "uint8", "1", "1 = usable"),
        COLOUR,
    ],
)
def image_stage(
    params: NoParams,
    *,
    frame: int,
    camera: str,
    path: str,
    sha256: str,
    header: Header,
    levels: Levels | None = None,
) -> Bundle[ImageFacts]:
    """One image file, checked and grey."""
    data = read_unchanged(Path(path), sha256, f"frame {frame}, {camera} image {path}")
    try:
        # Without the path, which is not in the task's key.
        image, colour = decode_colour(data, f"{camera} image", header, levels)
    except InputError as error:
        return empty(frame, camera, header, error)
    meta: ImageFacts = {"frame": frame, "camera": camera}
    arrays: dict[str, AnyArray] = {"image": image, "valid": np.ones(image.shape, np.uint8)}
    # Colours of left images alone, since ortho images are made of these.
    return Bundle(arrays if colour is None or camera != "left" else arrays | {"colour": colour}, meta)


def empty(frame: int, camera: str, header: Header, damage: InputError) -> Bundle[ImageFacts]:
    """An image without a usable pixel instead of a damaged one, so that the frame is lost, not the run."""
    nothing = np.zeros((header.height, header.width), np.uint16 if header.depth > 8 else np.uint8)
    meta: ImageFacts = {"frame": frame, "camera": camera, "damage": damage.message}
    return Bundle({"image": nothing, "valid": nothing.astype(np.uint8)}, meta)


def sound(image: Bundle, path: str = "") -> Bundle:
    """The image of the file ``path``, unless it stands for a damaged one.

    Raises
    ------
    InputError
        Its file is damaged.
    """
    if "damage" in image.meta:
        raise _damaged(f"frame {image.meta['frame']}, {image.meta['damage']}" + (path and f": {path}"))
    return image
