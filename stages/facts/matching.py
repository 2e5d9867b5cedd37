"""Facts of disparities."""

from typing import Any

from rille.stages.core.declare import Facts


class DisparityFacts(Facts):
    """``preset``; whether the right image was ``aligned`` by a plane; how many pixels are ``usable``, of these the
    share that is matched, and ``counts`` by reason."""

    preset: str
    aligned: bool
    usable: int
    match_rate: float | None
    counts: dict[str, int]


class TileFacts(Facts, total=False):
    """Of the coarse levels: ``level``, cost ``mu`` of the band, sign of depth ``near_sign`` (``hfvm.level.State``),
    ``blur`` of both images (``hfvm.coarse.focus``). Of the ending: ``terms`` of textureless planes."""

    level: int
    aligned: bool
    mu: float
    near_sign: float
    blur: list[float]
    terms: list[Any]
