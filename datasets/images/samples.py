"""Some images of a sequence, looked at when it is opened: range of samples, mosaics of colours, orientations."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from warnings import catch_warnings

import numpy as np
from PIL import Image

from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.datasets.text.warning import warning
from rille.stages.core.declare import AnyArray, declared
from rille.stages.core.errors import InputError, RilleError
from rille.stages.imaging import levels

LOOKED_AT = 3
"""Frames, spread over the sequence; `rille check` looks at all."""

ORIENTATION = 0x0112
"""EXIF's tag: 1 as stored, 3 upside down, 6 and 8 turned by a quarter, others mirrored."""

BLOCK = 16
"""Cells of 2 x 2 pixels along a side of a block whose four phases are compared."""
DEPARTS, SURELY = 0.03, 6.0
"""Share of the grey value, and standard deviations, by which phases differ in a block that shows a mosaic."""
MOSAIC, FEWEST = 0.4, 12
"""Share of such blocks of at least so many; ordinary images have at most 0.12, mosaics at least 0.74."""


def examined(sequence: Sequence) -> Sequence:
    """The sequence with warnings of what some of its images show, and with the levels that its 16-bit images need.

    Raises
    ------
    InputError
        The images of the two cameras have unlike EXIF orientations.
    """
    there = [k for k in range(sequence.frames) if k not in sequence.lost]
    chosen = there[:: max(1, -(-len(there) // LOOKED_AT))]
    sources = {camera: [sequence.image(k, camera) for k in chosen] for camera in CAMERAS}
    images = {camera: [image for source in of for image in _images(source)] for camera, of in sources.items()}
    lines = _orientations(sources)
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


def mosaic(image: AnyArray) -> bool:
    """Whether a grey image (row, col) shows the colour filters of single pixels.

    In each block of cells of 2 x 2 pixels the means of the four phases differ, where in an ordinary image they agree.
    """
    rows, cols = (n // (2 * BLOCK) for n in image.shape)
    if rows * cols < FEWEST:
        return False
    cut = image[: rows * 2 * BLOCK, : cols * 2 * BLOCK].astype(np.float32)
    cells = cut.reshape(rows, BLOCK, 2, cols, BLOCK, 2).transpose(2, 5, 0, 3, 1, 4).reshape(4, rows, cols, -1)
    a, b, c, d = cells
    phases = np.stack([(a + d - b - c) / 2, a - d, b - c])
    departs = np.abs(phases.mean(-1))
    found = (departs > DEPARTS * cells.mean((0, 3))) & (departs > SURELY * phases.std(-1) / BLOCK)
    return bool(found.any(0).mean() > MOSAIC)


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
    with (
        catch_warnings(action="ignore"),
        suppress(Exception),  # of a damaged tag: whatever the parsers of three formats come upon
        Image.open(source.hints["path"], formats=("JPEG", "TIFF", "PNG")) as image,
    ):
        # Pillow decodes a whole PNG in search of what it does not have.
        return int(image.getexif().get(ORIENTATION, 1)) if image.format != "PNG" or "exif" in image.info else 1
    return 1
