"""Masks of a camera's pixels that never show the scene, such as the vehicle's own body.

A mask has the size of the camera's images, before any lens distortion is removed. Its bright pixels are used, its dark
ones are not, from matching to the map.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rille.datasets.facts import ImageFacts
from rille.datasets.images import files
from rille.datasets.protocol import Sequence, Source
from rille.stages.core.arrays import Bools
from rille.stages.core.declare import AnyArray, Bundle, NoParams, stage
from rille.stages.core.errors import InputError, warning


def usable(mask: AnyArray) -> Bools:
    """Usable pixels (row, col) of a mask: those brighter than half of its greatest value, whatever its scale."""
    return np.asarray(mask.astype(np.float32) > 0.5 * float(mask.max()))


def masked(sequence: Sequence, digests: files.Digests) -> Sequence:
    """The sequence without the masked pixels of its cameras.

    Raises
    ------
    InputError
        A mask cannot be read, does not have the size of the camera's images, or leaves hardly any pixel.
    """
    if not sequence.masks:
        return sequence
    notes, lines, masks = [], [], sequence.masks
    for side, path in masks.items():
        lens = (sequence.lenses or {}).get(side)
        camera = getattr(sequence.rig, side) if lens is None else lens.camera
        keep = usable(files.read_grey(path))
        place = f"{sequence.name}: masks.{side} = {path}"
        if keep.shape != (camera.height, camera.width):
            text = f"{place} is {keep.shape[1]} x {keep.shape[0]} pixels, the images {camera.width} x {camera.height}"
            raise InputError("RIL-904", text, remedy="draw the mask on an image as the camera gave it")
        # 0.05: least share of usable pixels; fewer cannot be matched.
        if keep.mean() < 0.05:
            text = f"{place} leaves {100 * keep.mean():.1f} % of the image"
            raise InputError("RIL-905", text, remedy="make bright what is to be used, and dark what is not")
        text = f"a mask leaves out {100 * (1 - keep.mean()):.1f} % of the {side} images ({path.name})"
        if keep.mean() < 0.5:
            lines.append(warning("RIL-909", f"{text}: is it the wrong way round? Bright pixels are used"))
        elif keep.all():
            lines.append(warning("RIL-799", f"{text}: is it drawn in its transparency? Only dark pixels are left out"))
        else:
            notes.append(text)

    def image(frame: int, camera: str) -> Source:
        source = sequence.image(frame, camera)
        if camera not in masks:
            return source
        args = {"frame": frame, "camera": camera, "sha256": digests.sha256(masks[camera])}
        hints = {"path": str(masks[camera].resolve())}
        return Source("rille.datasets.images.masks", NoParams(), args, hints, {"image": source})

    warnings = (*sequence.warnings, *lines)
    return replace(sequence, image=image, notes=(*sequence.notes, *notes), warnings=warnings)


@stage("masked_image", outputs=files.image_stage.outputs)
def masked_image_stage(
    params: NoParams, image: Bundle[ImageFacts], *, frame: int, camera: str, path: str, sha256: str
) -> Bundle[ImageFacts]:
    """One image without the pixels that its camera's mask leaves out."""
    name = f"mask of the {camera} camera {path}"
    mask = usable(files.decode(files.read_unchanged(Path(path), sha256, name), name))
    arrays = {key: np.asarray(array) for key, array in image.arrays.items()}
    arrays["valid"] = (mask & (arrays["valid"] != 0)).astype(np.uint8)
    return Bundle(arrays, image.meta)
