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
    """Of the coarse levels: ``level``, ``alignment`` and ``ratio`` of brightness, band ``f`` and ``mu``, ``near_sign``
    (see ``hfvm.level.State``). Of the ending: epipolar lines ``f``, and ``terms`` of textureless planes."""

    level: int
    aligned: bool
    alignment: list[list[float]] | None
    ratio: list[list[float]] | None
    f: list[list[float]] | None
    mu: float
    near_sign: float
    terms: list[Any] | None
