"""``rille mask``: draw masks of still parts of a sequence's images, such as the vehicle's own body."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np

from rille.datasets.protocol import CAMERAS
from rille.datasets.text.names import shell_word
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.python.sequence import open as open_sequence
from rille.pipeline.runs.options import Output, check_new
from rille.stages.core.errors import InputError
from rille.stages.core.quantities import count
from rille.stages.imaging.pyramid import grey
from rille.stages.imaging.still import MIN_IMAGES, still

MAX_STILL = 0.95
"""Share of an image that keeps its place, beyond which the camera stood; no mask may leave out more."""


def mask(seq: str, *, output: Annotated[Path, Output] = Path()) -> None:
    """Write masks of what keeps its place in the images, such as the vehicle's own body, for `[masks]` of a manifest.

    Twenty images of each camera, spread over the sequence, are compared; where the vehicle stood, all keeps its place.
    Beside each mask lies a picture to look at, with what the mask leaves out in red.

    Parameters
    ----------
    seq
        A name from `rille datasets list`, a folder or a manifest (.toml).
    output
        Folder to write to.
    """
    paths = {camera: output / f"mask_{camera}.png" for camera in CAMERAS}
    for path in paths.values():
        check_new(path)
    pairs = list(open_sequence(seq))
    if len(pairs) < MIN_IMAGES:
        text = f"{seq} has {count(len(pairs), 'pair')}, {MIN_IMAGES} are needed to see what keeps its place"
        raise InputError("RIL-906", text, remedy="draw the mask by hand")
    # 20 images: more would not change the mask.
    pairs = [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, 20).round().astype(int))]
    taken = {camera: [pair.taken(camera) for pair in pairs] for camera in CAMERAS}
    bodies = {camera: still(images) for camera, images in taken.items()}
    for camera, body in bodies.items():
        if body.mean() > MAX_STILL:
            text = f"{100 * body.mean():.0f} % of the {camera} images of {seq} keeps its place: the camera stood"
            raise InputError("RIL-910", text, remedy="give images of a drive, or draw the mask by hand")
    written = []
    for camera, path in paths.items():
        images, body = taken[camera], bodies[camera]
        if not body.any():
            print(f"{camera:12s} nothing keeps its place in {len(images)} images")
            continue
        seen = cv2.cvtColor(np.rint(grey(images[0])).astype(np.uint8), cv2.COLOR_GRAY2BGR)
        seen[body] = seen[body] // 2 + np.array([0, 0, 127], np.uint8)
        for name, picture in ((path, np.where(body, 0, 255).astype(np.uint8)), (path.with_suffix(".look.png"), seen)):
            atomic.write(name, cv2.imencode(".png", picture)[1].tobytes())
        print(f"{camera:12s} {100 * body.mean():.1f} % keeps its place in {len(images)} images: {path}")
        written.append(f'{camera} = "{path.resolve()}"')
    if written:
        first = f" (rille init {shell_word(seq)} --force writes one)" if Path(seq).is_dir() else ""
        print(f"next         look at the .look.png; then in the manifest{first}:\n\n[masks]")
        print("\n".join(written))
