"""Stage ``disparity``: disparities of a left image by another program; and the assignment of its files to pairs.

Files are PFM, TIFF and npy of floating point, pixels, PNG of 16 bits as KITTI has them, or integers of a stated scale.
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

KINDS = "PFM, TIFF or npy of floating point (pixels), 16-bit PNG (256 a pixel), or integers of a stated scale"

USUAL_SCALES: Mapping[str, float | None] = {"floats": 1.0, "16-bit PNG": 256.0, "integers": None}
"""Values for a pixel, by the kind of a file: PNG of KITTI, DrivingStereo, Argoverse; Cityscapes' are one value more."""


def decode(data: bytes, size: tuple[int, int], name: str, scale: float = 1.0) -> Floats32:
    """Pixels of an encoded map (row, col), from the top; NaN where they are not finite, 0, or marked as no data.

    Parameters
    ----------
    size : required width and height, compared before anything is unpacked.
    name : for errors.
    scale : values for a pixel, negative where their sign is the other one.

    Raises
    ------
    InputError
        The file is damaged, of another kind or size, or most of its values are larger than the images are wide.
    """
    with _refusal(name):
        values = (_unpacker(BytesIO(data), size)[1]() / np.float32(scale)).astype(np.float32)
        known = np.isfinite(values) & (values != 0)
        usual = float(np.median(np.abs(values[known]))) if known.any() else 0.0
        if usual > size[0]:
            raise ValueError(f"its values are {usual:g} px, wider than the image: depths, or of another scale")
    return np.where(known, values, np.float32(np.nan))


def scales(paths: Mapping[Path, Path], size: tuple[int, int], stated: float | None) -> dict[Path, float | InputError]:
    """Values for a pixel, stated or usual, of each map (by left image, as :func:`find` gives them); the error of one
    that :func:`decode` refuses by its header, or whose scale is unknown."""
    found = dict[Path, float | InputError]()
    for left, path in paths.items():
        try:
            with _refusal(str(path)), path.open("rb") as file:
                usual = _unpacker(file, size)[0]
                if stated is None and usual is None:
                    raise ValueError("its values are integers: state scale, the values for a pixel (SGBM's are 16)")
                found[left] = stated or usual or 1.0
        except InputError as error:
            found[left] = error
    return found


@contextmanager
def _refusal(name: str) -> Iterator[None]:
    """Turn any error while a map is read into one that names it; parsers of a damaged file warn and raise anything."""
    try:
        with catch_warnings(action="ignore"):
            yield
    except Exception as error:
        text = f"{name} cannot be read as a map of disparities: {' '.join(str(error).split())[:100]}"
        raise InputError("RIL-900", text, remedy=f"give a map of the whole left image as {KINDS}") from error


def _unpacker(file: BinaryIO, size: tuple[int, int]) -> tuple[float | None, Callable[[], AnyArray]]:
    """Check the header of a map of this width and height; return its usual scale, and the function that unpacks it."""
    magic = file.read(6)
    file.seek(0)
    # First bytes of NumPy's files.
    found, kind, unpack = (_numpy if magic == b"\x93NUMPY" else _image)(file, size)
    if found != size:
        words = [" x ".join(map(str, sides)) for sides in (found, size)]
        raise ValueError(f"it has {words[0]} values, the left image {words[1]} pixels")
    if kind not in USUAL_SCALES:
        raise ValueError(f"its values are of a type ({kind}) that is not read")
    return USUAL_SCALES[kind], unpack


def _numpy(file: BinaryIO, size: tuple[int, int]) -> tuple[tuple[int, ...], str, Callable[[], AnyArray]]:
    """Size, kind and unpacker of NumPy's array, without execution of any content, and without more memory than the file
    has."""
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, by_columns, dtype = read_header[np.lib.format.read_magic(file)](file)
    shape = tuple(side for side in shape if side != 1)  # networks have one channel, and one image a batch
    kind = {"f": "floats", "i": "integers", "u": "integers"}.get(dtype.kind, str(dtype))
    order: Literal["F", "C"] = "F" if by_columns else "C"
    return shape[::-1], kind, lambda: np.frombuffer(file.read(), dtype, size[0] * size[1]).reshape(shape, order=order)


def _image(file: BinaryIO, size: tuple[int, int]) -> tuple[tuple[int, ...], str, Callable[[], AnyArray]]:
    """Size, kind and unpacker of an image of disparities."""
    image = opened(file)
    if image is None:
        raise ValueError("it is of no kind that is read")
    # Pillow's names of one channel.
    kinds = {"F": "floats", "L": "integers", "I;16": "integers", "I;16B": "integers", "I": "integers"}
    kind = "16-bit PNG" if (image.format, image.mode) == ("PNG", "I;16") else kinds.get(image.mode, image.mode)

    def pixels() -> AnyArray:
        values = np.asarray(image, np.float32)  # Pillow handles PFM's order of rows and bytes
        # GDAL's tag of TIFF: value of the pixels without data.
        if image.format == "TIFF" and 42113 in image.tag_v2:
            values = np.where(values == np.float32(image.tag_v2[42113].strip("\0 ")), np.float32(np.nan), values)
        return values

    return image.size, kind, pixels


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
    scales: Mapping[str, float],
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
            arrays[array] = decode(data, wanted, path.name, scales[array])
        except InputError as error:
            meta["damage"] = error.message
    if "damage" in meta:
        arrays = {array: np.full(wanted[::-1], np.nan, np.float32) for array in digests}
    if sigma is not None:
        arrays["disparity_std"] = np.full_like(arrays["column_disparity"], sigma)
    return Bundle(arrays, meta)
