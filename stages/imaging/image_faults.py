"""Faults of images: blur, noise and faint or missing grey values, by the figures of all images of a camera.

The figures are those of ``glance`` of :mod:`rille.stages.imaging.image_quality`, here ``looks`` of several images and
``seen`` of one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rille.stages.imaging.image_quality import ALONG, MAX_GREY_ROWS

MIN_NOISE_SHARPNESS, MIN_NOISE_DETAIL = 4.3, 0.18
"""Of uncorrelated noise alone, whose sharpness is 4.6 and whose detail is 0.19 (``texture``); photographs have a
sharpness of about 1, or, with strong noise, a smaller detail: their grey values deviate by more than the noise."""

AROUND = 8
"""Images before and after one with which its sharpness is compared: more than a shake or a drop of rain blurs."""


class Blur(NamedTuple):
    """Share of the usual sharpness that an image has, detail counted twice: 1 usual; and the figure in words."""

    share: float
    words: str


def blurs(looks: Sequence[Mapping[str, Any]]) -> list[Blur]:
    """How blurred the images of a camera are, in their order; ``looks``: figures of ``glance``.

    Usual is the median of the images around: what a camera sees changes, and with it the figures.
    """
    out = []
    for k, seen in enumerate(looks):
        near = looks[max(k - AROUND, 0) : k + AROUND + 1]
        # Noise is sharper than any photograph.
        shown = [one for one in near if not drowned(one)]
        worst = Blur(math.inf, "")
        for what, times in (*dict.fromkeys(ALONG, 1).items(), ("detail", 2)):
            known = [one[what] for one in shown if one[what] is not None]
            usual = float(np.median(known)) if len(known) > 2 else 0.0
            share = seen[what] / usual if seen[what] is not None and usual > 0 else 1.0
            words = f"{share:.0%} of the usual {what.replace('_', ' along the ')}"
            worst = min(worst, Blur(times * share, words), key=lambda blur: blur.share)
        out.append(worst)
    return out


def drowned(seen: Mapping[str, Any]) -> bool:
    """Whether all fine detail of an image is uncorrelated noise; ``seen``: by ``glance``."""
    return seen["sharpness"] is not None and seen["sharpness"] > MIN_NOISE_SHARPNESS


def noise_alone(seen: Mapping[str, Any]) -> bool:
    """Whether an image shows uncorrelated noise and nothing else, as behind a lens cap; ``seen``: by ``glance``."""
    return drowned(seen) and seen["detail"] > MIN_NOISE_DETAIL


def grey_rows(sides: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Warnings about cameras whose images have rows of one grey value that the other's of the same frames do not have.

    ``sides``: figures of ``glance`` of the left and of the right images. A sky of one value is in both.
    """
    lines = []
    shares = {side: np.array([seen.get("grey_rows", 0.0) for seen in looks]) for side, looks in sides.items()}
    for side, other in (("left", "right"), ("right", "left")):
        odd = shares[side] - shares[other] > MAX_GREY_ROWS
        if odd.any():
            which = f"{int(odd.sum())} of {len(odd)} {side} images"
            rows = f"show one grey value in {shares[side][odd].mean():.0%} of their rows"
            lines.append(
                f"{which} {rows}, the {other} ones do not: nothing is measured there; did sensor or transmission fail?"
            )
    return lines


def faint(sides: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Warnings about cameras most of whose images are nearly uniform; ``sides``: as of :func:`grey_rows`."""
    lines = []
    for side, looks in sides.items():
        deviation = float(np.median([seen["deviation"] for seen in looks])) if looks else math.inf
        # 2.5: of 255, below which noise and rounding hide landmarks: rendered ground with noise of 0.8 gave all poses
        # down to 2.8, and none from 2.4 on.
        if deviation < 2.5:
            lines.append(
                f"the {side} images are faint: their grey values deviate by {deviation:.1f} of 255 (median), so that "
                "landmarks drown in noise: give more light, a longer exposure or images of more bits"
            )
    return lines
