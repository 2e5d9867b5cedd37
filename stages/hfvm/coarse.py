"""The coarse levels of a pair: both images made alike, in brightness and by a plane or keypoints, and matched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from rille.stages.core.arrays import Floats
from rille.stages.geometry.scale import other_size
from rille.stages.hfvm import brightness, plane, start, viewpoint
from rille.stages.hfvm.image import Image
from rille.stages.hfvm.level import State, Views, descend, sample

COARSE_LEVEL = 2
"""Level whose matches decide on brightness, alignment by a plane, and turned views."""

MIN_UPRIGHT_SHARE = 0.45
"""Share of consistent pixels below which the images may be turned: chance alone makes up to .23 of them so, with preset
``accurate``, which smooths more, up to .40."""

MIN_EVEN_SHARE = 0.85
"""Share of consistent pixels from which on no other brightness is guessed."""


@dataclass(frozen=True)
class Coarse:
    """A pair of images and its matches at a coarse level, ``state``.

    ``views``: the images as they are matched: the right one in the left one's brightness, divided by ``ratio``, and
    aligned by the homography ``alignment`` (None: neither). ``right``: as it is before it is aligned. ``prior``:
    disparities known beforehand.
    """

    views: Views
    state: State
    right: Image
    ratio: Floats | None = None
    alignment: plane.Matrix | None = None
    prior: start.PriorDisparities | None = None

    def with_threads(self, threads: int) -> Coarse:
        """The same, to be matched on by so many threads."""
        return replace(self, views=replace(self.views, threads=threads))

    @staticmethod
    def again(views: Views, state: State, ratio: Floats | None, alignment: plane.Matrix | None) -> Coarse:
        """As it was when these were its state, ratio and alignment; ``views``: the images as they are."""
        right = brightness.levelled(views.right, ratio)
        matched = right if alignment is None else plane.aligned(right, alignment, views.left)
        return Coarse(replace(views, right=matched), state, right, ratio, alignment)

    def anew(self, matched: Image, **changed: object) -> Coarse:
        """Coarse levels of another right image, and other facts changed."""
        views = replace(self.views, right=matched)
        return replace(self, views=views, state=descend(views, COARSE_LEVEL, None, self.state.near_sign), **changed)  # type: ignore[arg-type]


def even(coarse: Coarse) -> Coarse:
    """Brightness ratio of both images undone in the right one, first by a guess where little matches."""
    left, right = coarse.views.left, coarse.right
    if coarse.state.share < MIN_EVEN_SHARE:
        guess = brightness.guess(left, right, min(COARSE_LEVEL + 2, coarse.views.levels - 1))
        if brightness.greatest(guess) > brightness.MIN_LOG_RATIO:
            other = brightness.levelled(right, guess)
            tried = coarse.anew(other, right=other, ratio=guess)
            coarse = tried if tried.state.share > coarse.state.share else coarse
    for _ in range(2):  # matches correct the ratio, and those of the corrected image once more
        ratio = brightness.matched(left, right, coarse.state)
        before = 0.0 if coarse.ratio is None else coarse.ratio
        if ratio is None or brightness.greatest(ratio - before) <= brightness.MIN_LOG_RATIO:
            break
        other = brightness.levelled(right, ratio)
        tried = coarse.anew(other, right=other, ratio=ratio)
        # Of the consistent pixels a few change anyway.
        if tried.state.share < 0.95 * coarse.state.share:
            break
        coarse = tried
    return coarse


def known(coarse: Coarse) -> Coarse:
    """Disparities known beforehand in the place of those found."""
    prior = start.aligned(coarse.prior, coarse.alignment)
    return replace(coarse, state=start.impose(coarse.views, coarse.state, prior))


def align(coarse: Coarse) -> Coarse:
    """The right image aligned by the dominant plane, where one explains the matches."""
    h = plane.find(sample(coarse.views, coarse.state), coarse.state.level, coarse.views.left.shapes)
    return coarse if h is None else known(coarse.anew(plane.aligned(coarse.right, h, coarse.views.left), alignment=h))


def turn(coarse: Coarse) -> Coarse:
    """The right image turned and scaled by keypoints, where hardly a pixel matches and that helps."""
    # A plane may also be fitted to the few matches that chance makes.
    sizes = coarse.views.left.shapes[0], coarse.right.shapes[0]
    few = coarse.state.share <= MIN_UPRIGHT_SHARE or (coarse.alignment is None and other_size(*sizes))
    h = viewpoint.find(coarse.views.left, coarse.right) if few and coarse.prior is None else None
    if h is None:
        return coarse
    upright = replace(coarse, state=replace(coarse.state, near_sign=0.0))
    turned = upright.anew(plane.aligned(coarse.right, h, coarse.views.left), alignment=h)
    return turned if turned.state.share > coarse.state.share else coarse


Step = Callable[[Coarse], Coarse]


def begin(views: Views, steps: tuple[Step, ...], prior: start.PriorDisparities | None = None) -> Coarse:
    """The coarse levels of two images as they are, down to level 1 or, of small images, to the top."""
    coarse = Coarse(views, descend(views, COARSE_LEVEL), views.right, prior=prior)
    for step in steps:
        coarse = step(coarse)
    return replace(coarse, state=descend(coarse.views, 1, coarse.state))
