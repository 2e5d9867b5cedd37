"""Stage ``image`` for files of 16 bits a sample: the same reader; a stage declares one type for an array."""

from __future__ import annotations

from dataclasses import replace

from rille.datasets.images import files
from rille.stages.core.declare import Array

STAGE = replace(
    files.STAGE,
    summary="one image file of 16 bits a sample, checked and grey",
    outputs=(Array("image", ("row", "col"), "uint16", "grey", "image, white = 65535"), *files.STAGE.outputs[1:]),
)
