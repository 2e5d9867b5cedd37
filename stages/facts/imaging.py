"""Facts of images and pyramids."""

from typing import Any

from rille.stages.core.declare import Facts


class PyramidFacts(Facts):
    """``levels`` of the pyramid, and the standard deviation of the ``noise``, grey."""

    levels: int
    noise: float | None


class QualityFacts(Facts):
    """Of each image of a frame: what :func:`rille.stages.imaging.image_quality.glance` gives, and its ``damage``."""

    frame: int
    left: dict[str, Any]
    right: dict[str, Any]
