"""Facts of disparities."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts


class DisparityFacts(Facts):
    """``preset``; whether the right image was ``aligned`` by a plane; how many pixels are ``usable``, and of these
    the share that is matched; ``blur``, px, where the images differ by it (``hfvm.coarse.ImageDifference``)."""

    preset: str
    aligned: bool
    usable: int
    match_rate: float | None
    blur: NotRequired[float]


class TileFacts(Facts, total=False):
    """Of the coarse levels: ``level``, cost ``mu`` of the band, sign of depth ``near_sign`` (``hfvm.level.State``),
    ``blur`` of both images, and how the right one is ``unlike`` the left one (``hfvm.coarse``). Of the ending:
    ``terms`` of textureless planes."""

    level: int
    unlike: tuple[bool, float]
    mu: float
    near_sign: float
    blur: list[float]
    terms: list[Any]
