"""Whether the images of a pair fit the rig once one of them is mirrored."""

from __future__ import annotations

from itertools import product

import numpy as np

from rille.stages.calibration.relative_orientation import MIN_MATCHES
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import MirrorFacts
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.sides import fits
from rille.stages.imaging.features import extract, matched_points


@stage("mirror_check")
def mirror_check_stage(params: NoParams, left: Bundle, right: Bundle, *, rig: Rig) -> Bundle[MirrorFacts]:
    """Which image of a pair, mirrored which way, makes most matches of their features fit the rig.

    Features match whichever way an image is turned: the rig tells which way is right. Of parallel cameras either image
    fits, mirrored top to bottom: then nothing tells which.
    """
    sides = {"left": left, "right": right}
    images = {camera: [np.asarray(one[name]) for name in ("image", "valid")] for camera, one in sides.items()}
    features = {camera: extract(*of) for camera, of in images.items()}
    fitting = dict[str, float]()
    for (camera, of), (axis, way) in product(images.items(), enumerate(("top to bottom", "left to right"))):
        mirrored = extract(*(np.ascontiguousarray(np.flip(array, axis)) for array in of))
        points = matched_points(*(features | {camera: mirrored}).values())
        share = fits(rig, *points) if len(points[0]) >= MIN_MATCHES else 0.0
        if share > 0.5:
            fitting[f"the {camera} one is mirrored {way}"] = share
    return Bundle({}, {"fitting": fitting})
