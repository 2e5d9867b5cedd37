"""Checks of some images when a sequence is opened: range of samples, mosaics, fields, orientations."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from warnings import catch_warnings

import numpy as np
from PIL import Image

from rille.datasets.images import files
from rille.datasets.images.headers import orientation
from rille.datasets.images.patterns import fixed_pattern, mixed, overlaid
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.stages.core.declare import AnyArray, declared
from rille.stages.core.errors import InputError, RilleError, warning
from rille.stages.imaging import levels

FORMATS = ("JPEG", "TIFF", "PNG")
"""Pillow's names of formats with tags, or with several images in a file."""

SUCCESSIVE = 8
"""Left images in a row that are compared: of five, conversions of 24 to 30 frames a second mix one to four."""

BLOCK = 16
"""Side of a block, in cells of 2 x 2 pixels, whose four phases are compared."""


def examined(sequence: Sequence) -> Sequence:
    """The sequence with warnings about some of its images, and with levels for 16-bit images.

    Raises
    ------
    InputError
        The images of the two cameras have unlike EXIF orientations, samples whose bytes are exchanged, or several
        images a file.
    """
    there = [k for k in range(sequence.frames) if k not in sequence.lost]
    # 3 frames, spread over the sequence; `rille check` opens all.
    chosen = there[:: max(1, -(-len(there) // 3))]
    sources = {camera: [sequence.image(k, camera) for k in chosen] for camera in CAMERAS}
    images = {camera: [image for source in of for image in _images(source)] for camera, of in sources.items()}
    for source in [of[0] for camera, of in sources.items() if of and not images[camera] and "path" in of[0].hints]:
        files.read_grey(Path(source.hints["path"]))  # raises the error
    left, right = ({_orientation(source) for source in of} for of in sources.values())
    lines = _orientations(left, right)
    for camera, of in images.items():
        files.refuse_swapped(of, f"the {camera} images")
        if of and mosaic(of[0]):
            remedy = "convert them, as by cv2.cvtColor, COLOR_BayerRGGB2BGR"
            lines.append(warning("RIL-826", f"{camera} images are a mosaic of colours (Bayer): {remedy}"))
        # 0.2: moving scenes have at most 0.03, with a pattern of 8 grey levels in 256 0.25, of 25 levels 0.7.
        elif (share := fixed_pattern(of)) > 0.2:
            text = f"{share:.0%} of the finest detail of {camera} images keeps its place (fixed-pattern noise)"
            remedy = "subtract a dark frame, the mean of images that are taken with the lens covered"
            remedy += "; if a projector casts dots, switch it off"
            lines.append(warning("RIL-833", f"{text}: {remedy}"))
        elif share := overlaid(of):
            text = f"{share:.0%} of the detail of {camera} images keeps its place all over the view, the rest moves"
            remedy = "a reflection on a window or dome, or a pattern on it? What is tracked may be either"
            lines.append(warning("RIL-834", f"{text}: {remedy}"))
        if any(map(interlaced, of)):
            text = f"rows of {camera} images differ by turns, as of two moments: deinterlace them (ffmpeg -vf bwdif)"
            lines.append(warning("RIL-832", text))
    lines += _mixed(sequence, there)
    chosen_levels = levels.levels_of_sides(*images.values())
    if not any(chosen_levels):
        return replace(sequence, warnings=(*sequence.warnings, *lines))
    lines += [warning("RIL-827", line) for line in levels.words(chosen_levels)]
    of_camera = dict(zip(images, chosen_levels, strict=True))

    def image(frame: int, camera: str) -> Source:
        source, used = sequence.image(frame, camera), of_camera[camera]
        deep = used is not None and source.args["header"]["depth"] == 16
        return replace(source, args={**source.args, "levels": used}) if deep else source

    return replace(sequence, image=image, warnings=(*sequence.warnings, *lines))


def _mixed(sequence: Sequence, there: list[int]) -> list[str]:
    """A line if some of a few successive left images are sums of their neighbours; ``there``: frames with images."""
    # Videos are no larger.
    few = SUCCESSIVE if sequence.rig.left.width * sequence.rig.left.height < 10e6 else 0
    first = max(0, (len(there) - few) // 2)
    frames = there[first : first + few]
    sums = mixed([image for k in frames for image in _images(sequence.image(k, "left"))])
    if not sums:
        return []
    text = f"{len(sums)} of {len(frames)} left images from frame {frames[0]} on are sums of their neighbours, as a "
    remedy = "take the images out of the recording itself, as they were taken"
    return [warning("RIL-836", f"{text}conversion of the frame rate makes them; their poses are wrong: {remedy}")]


def _images(source: Source) -> list[AnyArray]:
    """The grey image (row, col); empty if it cannot be read, which its task reports."""
    with suppress(RilleError):
        stage = declared(import_module(source.module))
        assert stage is not None
        return [np.asarray(files.sound(stage.run(source.params, {**source.args, **source.hints}, {}))["image"])]
    return []


def _orientation(source: Source) -> int:
    """EXIF's orientation of an image file, 1 if it cannot be read.

    Raises
    ------
    InputError
        The file has a second image that is no mask or smaller copy of the first.
    """
    turned, several = 1, False
    with (
        catch_warnings(action="ignore"),
        suppress(Exception),  # parsers of a damaged directory raise anything, and the end of the file if one is alone
        Image.open(source.hints["path"], formats=FORMATS) as image,
    ):
        turned, size = orientation(image), image.size
        image.seek(1)
        # 254: TIFF's tag of a smaller copy (1) or a mask (4) of another image; pages of a stack have 2.
        several = image.size == size and not getattr(image, "tag_v2", {}).get(254, 0) & (1 | 4)
    if several:  # as stacks, and both views of a stereo camera
        text = f"{source.hints['path']} holds several images, and one is read of each file"
        raise InputError("RIL-831", text, remedy="take them apart, a folder a camera: magick FILE left/%06d.png")
    return turned


def mosaic(image: AnyArray) -> bool:
    """Whether a grey image (row, col) shows the colour filters of single pixels.

    In each block of cells of 2 x 2 pixels the means of the four phases differ, while in an ordinary image they agree.
    Alternating rows or columns, as of two fields or two amplifiers, are no mosaic.
    """
    rows, cols = (n // (2 * BLOCK) for n in image.shape)
    if rows * cols < 12:
        return False
    cut = image[: rows * 2 * BLOCK, : cols * 2 * BLOCK].astype(np.float32)
    cells = cut.reshape(rows, BLOCK, 2, cols, BLOCK, 2).transpose(2, 5, 0, 3, 1, 4).reshape(4, rows, cols, -1)
    a, b, c, d = cells

    def differ(halves: AnyArray) -> AnyArray:
        """Whether two halves of a cell differ: by a share of the grey value, and by standard deviations."""
        departs = np.abs(halves.mean(-1)) / 2
        return np.asarray((departs > 0.03 * cells.mean((0, 3))) & (departs > 3.0 * halves.std(-1) / BLOCK))

    # In ordinary images at most 0.01 of the blocks show a mosaic, in mosaics at least 0.87.
    diagonals, rows_differ, columns_differ = differ(a + d - b - c), differ(a + b - c - d), differ(a + c - b - d)
    return bool((diagonals | (rows_differ & columns_differ)).mean() > 0.4)


def interlaced(image: AnyArray) -> bool:
    """Whether rows of a grey image (row, col) are more like those two rows apart than like their neighbours, as with
    two fields of a moving scene, but columns are not, as in a mosaic."""

    def ratio(rows: AnyArray) -> float:
        """Differences of rows two apart over those of neighbours: 1.2 to 2 in ordinary images, 1 in noise alone."""
        return float(np.abs(rows[2:] - rows[:-2]).mean() / max(np.abs(rows[1:] - rows[:-1]).mean(), 1e-6))

    grey = image.astype(np.float32)
    return min(grey.shape) > 2 * BLOCK and ratio(grey) < 0.9 * min(1.0, ratio(grey.T))


def _orientations(left: set[int], right: set[int]) -> list[str]:
    """A line if all images have one orientation tag, which is ignored."""
    if left | right <= {1}:
        return []
    words = f"EXIF orientations are {sorted(left)} of left images and {sorted(right)} of right ones"
    if left != right or len(left) > 1:
        text = f"{words}: which pixels are those of the calibration is not known"
        remedy = "turn the pixels (magick mogrify -auto-orient FILES), or remove the tags: exiftool -Orientation= FILES"
        raise InputError("RIL-828", text, remedy=remedy)
    text = f"{words}: they are ignored, the calibration is taken for the pixels as they are stored"
    return [warning("RIL-829", text)]
