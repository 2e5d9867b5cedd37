"""Facts of the stages that read, record or simulate images."""

from typing import NotRequired

from rille.stages.core.declare import Facts


class ImageFacts(Facts):
    """Number of the ``frame``, and the ``camera``: ``left`` or ``right``. ``damage``: reason for an empty image, if its
    file is damaged."""

    frame: int
    camera: str
    damage: NotRequired[str]
