"""Stage ``misalign`` for images of 16 bits a sample: a stage declares one type for an array."""

from __future__ import annotations

from dataclasses import replace

from rille.datasets.images import files16, misalign

STAGE = replace(
    misalign.STAGE,
    summary="right image of 16 bits a sample as a knocked camera would have taken it",
    outputs=files16.STAGE.outputs[:2],
)
