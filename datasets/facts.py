"""Facts of the stages that read, record or simulate images."""

from rille.stages.core.declare import Facts


class ImageFacts(Facts):
    """Number of the ``frame``, and the ``camera``: ``left`` or ``right``."""

    frame: int
    camera: str
