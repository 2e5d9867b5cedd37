"""Stage ``disparity``: disparities of a left image by another program; and the assignment of its files to pairs.

Files are PFM, TIFF and npy of floating point, pixels, or PNG of 16 bits as KITTI has them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Literal
from warnings import catch_warnings

import numpy as np

from rille.datasets.facts import ImageFacts
from rille.datasets.images import files
from rille.datasets.images.headers import opened
from rille.datasets.text.names import ends
from rille.datasets.text.order import natural
from rille.datasets.text.reading import Search
from rille.datasets.text.sides import without_side
from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError, within
from rille.stages.core.quantities import count

Sign = Literal["left-right", "right-left"]

KINDS = "PFM, TIFF or npy of floating point (pixels), or 16-bit PNG (256 a pixel, 0 unknown)"


def decode(data: bytes, size: tuple[int, int], name: str) -> Floats32:
    """Values of an encoded map (row, col), from the top; NaN where they are not finite, 0, or marked as no data.

    Parameters
    ----------
    size : required width and height, compared before anything is unpacked.
    name : for errors.

    Raises
    ------
    InputError
        The file is damaged, of another kind or size, or its values are of another type.
    """
    with _refusal(name):
        values = _unpacker(BytesIO(data), size)().astype(np.float32)
    return np.where(np.isfinite(values) & (values != 0), values, np.float32(np.nan))


def refused(paths: Mapping[Path, Path], size: tuple[int, int]) -> dict[Path, InputError]:
    """Errors of the maps (by left image, as :func:`find` gives them) that :func:`decode` refuses by their headers."""
    errors = dict[Path, InputError]()
    for left, path in paths.items():
        try:
            with _refusal(str(path)), path.open("rb") as file:
                _unpacker(file, size)
        except InputError as error:
            errors[left] = error
    return errors


@contextmanager
def _refusal(name: str) -> Iterator[None]:
    """Turn any error while a map is read into one that names it; parsers of a damaged file warn and raise anything."""
    try:
        with catch_warnings(action="ignore"):
            yield
    except Exception as error:
        text = f"{name} cannot be read as a map of disparities: {' '.join(str(error).split())[:100]}"
        raise InputError("RIL-900", text, remedy=f"give a map of the whole left image as {KINDS}") from error


def _unpacker(file: BinaryIO, size: tuple[int, int]) -> Callable[[], AnyArray]:
    """Check the header of a map of this width and height; return the function that unpacks its values."""
    magic = file.read(6)
    file.seek(0)
    # First bytes of NumPy's files.
    return _numpy(file, size) if magic == b"\x93NUMPY" else _image(file, size)


def _check(size: tuple[int, ...], wanted: tuple[int, int], floating: bool) -> None:
    """Refuse, by a ``ValueError``, a map of another size, or of integers, whose unit is unknown."""
    if size != wanted:
        words = [" x ".join(map(str, sides)) for sides in (size, wanted)]
        raise ValueError(f"it has {words[0]} values, the left image {words[1]} pixels")
    if not floating:
        raise ValueError("its values are of a type whose unit is not known")


def _numpy(file: BinaryIO, size: tuple[int, int]) -> Callable[[], AnyArray]:
    """Unpacker of NumPy's array, without execution of any content, and without more memory than the file has."""
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, by_columns, dtype = read_header[np.lib.format.read_magic(file)](file)
    shape = tuple(side for side in shape if side != 1)  # networks have one channel, and one image a batch
    _check(shape[::-1], size, dtype.kind == "f")
    order: Literal["F", "C"] = "F" if by_columns else "C"
    return lambda: np.frombuffer(file.read(), dtype, size[0] * size[1]).reshape(shape, order=order)


def _image(file: BinaryIO, size: tuple[int, int]) -> Callable[[], AnyArray]:
    """Unpacker of an image of disparities."""
    image = opened(file)
    if image is None:
        raise ValueError("it is of no kind that is read")
    coded = image.format == "PNG" and image.mode == "I;16"
    _check(image.size, size, coded or image.mode == "F")

    def pixels() -> AnyArray:
        # 256: values of a 16-bit PNG for one pixel. Pillow handles PFM's order of rows and bytes.
        values = np.asarray(image, np.float32) / (256 if coded else 1)
        # GDAL's tag of TIFF: value of the pixels without data.
        if image.format == "TIFF" and 42113 in image.tag_v2:
            values[values == np.float32(image.tag_v2[42113].strip("\0 "))] = np.nan
        return values

    return pixels


def find(pattern: str, root: Path, lefts: Sequence[Path], key: str) -> dict[Path, Path]:
    """The map of each left image that has one, by name (without sides' tokens) or number, whichever finds more.

    By order, if names have nothing in common.

    Parameters
    ----------
    pattern : of the maps below ``root``.
    key : name of the manifest's entry, for errors.

    Raises
    ------
    InputError
        No image has a map, maps are counted from another number than images are, or the pattern is none.
    """
    with within(key):
        maps = sorted(Search().matching(root, pattern), key=lambda path: natural(path.name))
    found: dict[Path, Path] = {}
    for name in (lambda path: without_side(path.stem, 0), last_number):
        ours, theirs = ({name(path): path for path in paths} for paths in (maps, lefts))
        if len(ours) == len(maps) and len(theirs) == len(lefts):  # else keys are not unique
            found = max(found, {path: ours[one] for one, path in theirs.items() if one in ours}, key=len)
    if len(maps) == len(lefts) and len(found) < len(maps):
        in_order = dict(zip(lefts, maps, strict=True))
        if len(maps) == 1 or not found:
            found = in_order
        # As many, counted from another number: each would be of another image.
        elif len({last_number(one) - last_number(left) for left, one in in_order.items()}) == 1:
            found = {}
    if found:
        return found
    those = ends(maps) if maps else f"none in {root}"
    text = f"{key} = {pattern!r}: {count(len(maps), 'map')} ({those}) for {count(len(lefts), 'left image')}"
    remedy = f"give one map a pair, named or numbered as the left images are ({ends(lefts)})"
    raise InputError("RIL-901", text, remedy=remedy)


def last_number(path: Path) -> int:
    """The last number in a file's name; -1: none."""
    return int(["-1", *re.findall(r"\d+", path.stem)][-1])


@stage(
    "disparity",
    outputs=[
        Array("column_disparity", ("row", "col"), "float32", "px", "column in the right image minus column", "nan"),
        Array("disparity_std", ("row", "col"), "float32", "px", "its standard deviation", "nan", optional=True),
    ],
)
def disparity_stage(
    params: NoParams,
    *,
    frame: int,
    size: tuple[int, int],
    sign: Sign,
    sigma: float | None,
    digests: Mapping[str, str],
    paths: Mapping[str, str],
) -> Bundle[ImageFacts]:
    """Disparities of a left image that another program wrote; unknown everywhere if a file is damaged."""
    meta: ImageFacts = {"frame": frame, "camera": "left"}
    wanted, arrays = (size[0], size[1]), dict[str, AnyArray]()
    for array, digest in digests.items():
        path = Path(paths[array])
        data = files.read_unchanged(path, digest, f"frame {frame}, map {path}")
        try:
            # Without its folder, which is not in the task's key.
            arrays[array] = decode(data, wanted, path.name)
        except InputError as error:
            meta["damage"] = error.message
    if "damage" in meta:
        arrays = {array: np.full(wanted[::-1], np.nan, np.float32) for array in digests}
    if sign == "left-right":
        arrays["column_disparity"] *= -1
    if sigma is not None:
        arrays["disparity_std"] = np.full_like(arrays["column_disparity"], sigma)
    return Bundle(arrays, meta)
