"""What is claimed of the matcher, line by line, held against the figures of one run of ``benchmarks/matching.py``.

Shares of wrong pixels and times are claimed as multiples of those of OpenCV's SGBM 3WAY in the same run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PEER = "SGBM 3WAY"

BAD2 = {"accurate": {"motorcycle": 1.1, "cones": 1.0}, "default": {"motorcycle": 1.2, "cones": 1.2}}
"""Greatest ratio of bad-2 over all pixels, filled, ours by the vector."""

KNOCKED = 1.5
CONDITIONS = ("shift 2 px", "shift 4 px", "roll 0.5 deg", "roll 2 deg")
"""Under these bad-2 is at most so many times the peer's on the aligned pair; presets of :data:`BAD2`."""

NMAD, LEAST_COMPLETE = 0.12, 0.75
"""Pixels and share of the pixels with truth, of preset accurate on the mockup."""

WITHIN = (("within_1", "one", 0.68, 0.07), ("within_2", "two", 0.95, 0.04))
"""Share of the matched pixels that err by at most one and two of their standard deviations, and its tolerance."""
CALIBRATED = ("mockup", "motorcycle")

TIMES = {"default": {"street": 1.0, "1.4 megapixels": 0.7}, "fast": {"street": 0.5, "1.4 megapixels": 0.35}}
"""Greatest ratio of wall times, both directions of ours to one of the peer; its disparities: 128 and 224."""
RATIOS = (("min_ratio", "least times"), ("median_ratio", "median of the rounds"))
BIG = 1.3e6
"""Pixels: from here on a timed pair is the one of 1.4 megapixels."""

Figures = Mapping[str, Any]


@dataclass(frozen=True)
class Line:
    """One claim: what it is about, what was measured, and the limits that it is kept within."""

    words: str
    figure: float
    low: float
    high: float

    @property
    def kept(self) -> bool:
        """Whether the figure lies within the limits."""
        return self.low <= self.figure <= self.high

    @property
    def limit(self) -> str:
        """Limits in words."""
        if self.low == -math.inf:
            return f"<= {self.high:.3g}"
        if self.high == math.inf:
            return f">= {self.low:.3g}"
        return f"{self.low:.2f} .. {self.high:.2f}"


def lines(found: Mapping[str, Sequence[Figures]]) -> list[Line]:
    """Claims that these figures (by part of the benchmark) say something about, in a fixed order."""
    accuracy = {(f["pair"], f["method"]): f for f in found.get("accuracy", ())}
    return [
        *_bad2(accuracy),
        *_knocked(accuracy, found.get("misalignment", ())),
        *_sub_pixel(accuracy),
        *_calibration(accuracy),
        *_times(found.get("time", ())),
    ]


def _most(words: str, figure: float, high: float) -> Line:
    return Line(words, figure, -math.inf, high)


def _bad2(accuracy: Mapping[tuple[str, str], Figures]) -> Iterator[Line]:
    for preset, pairs in BAD2.items():
        for pair, limit in pairs.items():
            own, peer = accuracy.get((pair, f"HFVM {preset}")), accuracy.get((pair, PEER))
            if own and peer:
                yield _most(f"{preset}, {pair}: bad-2 / that of {PEER}", own["bad2"] / peer["bad2"], limit)


def _knocked(accuracy: Mapping[tuple[str, str], Figures], figures: Iterable[Figures]) -> Iterator[Line]:
    by_case = {(f["pair"], f["method"], f["condition"]): f["bad2"] for f in figures}
    for preset, pairs in BAD2.items():
        for pair in pairs:
            peer = by_case.get((pair, PEER, "aligned"))
            for condition in CONDITIONS:
                own = by_case.get((pair, f"HFVM {preset}", condition))
                if own is not None and peer:
                    words = f"{preset}, {pair}, {condition}: bad-2 / that of {PEER}, aligned"
                    yield _most(words, own / peer, KNOCKED)


def _sub_pixel(accuracy: Mapping[tuple[str, str], Figures]) -> Iterator[Line]:
    own = accuracy.get(("mockup", "HFVM accurate"))
    if own and own["nmad"] is not None:
        yield _most("accurate, mockup: NMAD of matched columns, px", own["nmad"], NMAD)
        yield Line("accurate, mockup: matched share", own["completeness"], LEAST_COMPLETE, math.inf)


def _calibration(accuracy: Mapping[tuple[str, str], Figures]) -> Iterator[Line]:
    for preset in BAD2:
        for pair in CALIBRATED:
            own = accuracy.get((pair, f"HFVM {preset}"))
            for key, words, share, tolerance in WITHIN:
                if own and own[key] is not None:
                    text = f"{preset}, {pair}: within {words} standard deviation{'s' * (words != 'one')}"
                    yield Line(text, own[key], share - tolerance, share + tolerance)


def _times(figures: Iterable[Figures]) -> Iterator[Line]:
    by_case = {}
    for f in figures:
        size = "1.4 megapixels" if f["size"][0] * f["size"][1] >= BIG else f["pair"]
        by_case[size, f["method"]] = f
    for preset, sizes in TIMES.items():
        for size, limit in sizes.items():
            own = by_case.get((size, f"HFVM {preset}"))
            # Ratios are those to the first method that was timed.
            if own and (size, PEER) in by_case and by_case[size, PEER]["min_ratio"] == 1.0:
                for key, words in RATIOS:
                    yield _most(f"{preset}, {size}: time / that of {PEER}, {words}", own[key], limit)
