"""Some images of a sequence, looked at when it is opened: range of samples, mosaics of colours, orientations."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from warnings import catch_warnings

import numpy as np
from PIL import Image

from rille.datasets.images import files
from rille.datasets.images.headers import orientation
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.datasets.text.warning import warning
from rille.stages.core.declare import AnyArray, declared
from rille.stages.core.errors import InputError, RilleError
from rille.stages.imaging import levels

FORMATS = ("JPEG", "TIFF", "PNG")
"""Pillow's names of formats that have tags, and may hold several images."""

BLOCK = 16
"""Cells of 2 x 2 pixels along a side of a block whose four phases are compared."""


def examined(sequence: Sequence) -> Sequence:
    """The sequence with warnings of what some of its images show, and with the levels that its 16-bit images need.

    Raises
    ------
    InputError
        The images of the two cameras have unlike EXIF orientations, samples whose bytes are exchanged, or several
        images a file.
    """
    there = [k for k in range(sequence.frames) if k not in sequence.lost]
    # Frames, spread over the sequence; `rille check` looks at all
    chosen = there[:: max(1, -(-len(there) // 3))]
    sources = {camera: [sequence.image(k, camera) for k in chosen] for camera in CAMERAS}
    images = {camera: [image for source in of for image in _images(source)] for camera, of in sources.items()}
    _refuse_several(sources)
    lines = _orientations(sources)
    for camera, of in images.items():
        files.refuse_swapped(of, f"the {camera} images")
    for camera in [camera for camera, of in images.items() if of and mosaic(of[0])]:
        text = f"{camera} images are a mosaic of colours (Bayer): convert them, as by cv2.cvtColor, COLOR_BayerRGGB2BGR"
        lines.append(warning("RIL-826", text))
    chosen_levels = levels.levels_of(image for of in images.values() for image in of)
    if chosen_levels is None:
        return replace(sequence, warnings=(*sequence.warnings, *lines))
    lines.append(warning("RIL-827", levels.words(chosen_levels)))

    def image(frame: int, camera: str) -> Source:
        source = sequence.image(frame, camera)
        return (
            replace(source, args={**source.args, "levels": chosen_levels})
            if source.args["header"]["depth"] == 16
            else source
        )

    return replace(sequence, image=image, warnings=(*sequence.warnings, *lines))


def _images(source: Source) -> list[AnyArray]:
    """The grey image (row, col); none of one that cannot be read, which its own task says."""
    with suppress(RilleError):
        stage = declared(import_module(source.module))
        assert stage is not None
        return [np.asarray(stage.run(source.params, {**source.args, **source.hints}, {})["image"])]
    return []


def _refuse_several(sources: Mapping[str, list[Source]]) -> None:
    """Refuse files that hold several images of one size, as stacks and both views of a stereo camera."""
    for source in (source for of in sources.values() for source in of):
        count = _count(source)
        if count > 1:
            text = f"{source.hints['path']} holds {count} images, and one is read of each file"
            raise InputError("RIL-831", text, remedy="take them apart, a folder a camera: magick FILE left/%06d.png")


def _count(source: Source) -> int:
    """How many images of the size of the first one a file holds, apart from masks; 1 where it cannot be read."""
    with (
        catch_warnings(action="ignore"),
        suppress(Exception),  # of a damaged directory: whatever the parsers come upon
        Image.open(source.hints["path"], formats=FORMATS) as image,
    ):
        size, count = image.size, getattr(image, "n_frames", 1)
        if count > 1:
            image.seek(1)
        # TIFF's tag of images that are a smaller copy, or a mask, of another one
        return count if image.size == size and not getattr(image, "tag_v2", {}).get(254, 0) else 1
    return 1


def mosaic(image: AnyArray) -> bool:
    """Whether a grey image (row, col) shows the colour filters of single pixels.

    In each block of cells of 2 x 2 pixels the means of the four phases differ, where in an ordinary image they agree.
    """
    rows, cols = (n // (2 * BLOCK) for n in image.shape)
    if rows * cols < 12:
        return False
    cut = image[: rows * 2 * BLOCK, : cols * 2 * BLOCK].astype(np.float32)
    cells = cut.reshape(rows, BLOCK, 2, cols, BLOCK, 2).transpose(2, 5, 0, 3, 1, 4).reshape(4, rows, cols, -1)
    a, b, c, d = cells
    phases = np.stack([(a + d - b - c) / 2, a - d, b - c])
    departs = np.abs(phases.mean(-1))
    # By a share of the grey value, and by standard deviations.
    differ = (departs > 0.03 * cells.mean((0, 3))) & (departs > 6.0 * phases.std(-1) / BLOCK)
    # In ordinary images at most 0.12 of the blocks show a mosaic, in mosaics at least 0.74.
    return bool(differ.any(0).mean() > 0.4)


def _orientations(sources: Mapping[str, list[Source]]) -> list[str]:
    """A line where all images are turned alike: they are taken as they are stored."""
    left, right = (sorted({_orientation(source) for source in of}) for of in sources.values())
    if {*left, *right} <= {1}:
        return []
    words = f"EXIF orientations are {left} of left images and {right} of right ones"
    if left != right or len(left) > 1:
        remedy = (
            "turn the pixels (magick mogrify -auto-orient FILES), or remove the tags (exiftool -Orientation= FILES)"
        )
        raise InputError("RIL-828", f"{words}: which pixels are those of the calibration is not known", remedy=remedy)
    return [
        warning("RIL-829", f"{words}: they are ignored, the calibration is taken for the pixels as they are stored")
    ]


def _orientation(source: Source) -> int:
    """EXIF's orientation of an image file; 1 where it states none."""
    with suppress(Exception), Image.open(source.hints["path"], formats=FORMATS) as image:
        return orientation(image)
    return 1
