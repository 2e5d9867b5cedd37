"""Stage ``misalign`` for images of 16 bits a sample: a stage declares one type for an array."""

from __future__ import annotations

from dataclasses import replace

from rille.datasets.images import misalign
from rille.stages.core.declare import Array

STAGE = replace(
    misalign.STAGE,
    summary="right image of 16 bits a sample as a knocked camera would have taken it",
    outputs=(Array("image", ("row", "col"), "uint16", "grey", "image, white = 65535"), misalign.STAGE.outputs[1]),
)
