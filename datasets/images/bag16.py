"""Stage ``image`` for images in bags of 16 bits a sample: the same reader; a stage declares one type for an array."""

from __future__ import annotations

from dataclasses import replace

from rille.datasets.images import bag, files16

STAGE = replace(bag.STAGE, summary="one image of 16 bits of a bag, checked and grey", outputs=files16.STAGE.outputs)
