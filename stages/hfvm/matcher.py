"""The matcher on one page: the paper's steps (4.3) and ours, and each preset as a list of steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.geometry.scale import other_size
from rille.stages.hfvm import brightness, enlarge, finest, level, plane, start, textureless, viewpoint
from rille.stages.hfvm.finest import Ending, Work
from rille.stages.hfvm.image import Image, view
from rille.stages.hfvm.level import State, Steps, Views, descend, sample
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.windows import whole
from rille.stages.imaging.pyramid import Pyramid

Tell = Callable[[float, str], None]
"""Called with the share of the work done, 0..1, and what comes next in words."""

COARSE = 2
"""Level whose matches decide on brightness, alignment by a plane, and turned views."""

TOO_FEW = 0.45
"""Share of consistent pixels below which the images may be turned: chance alone makes up to .23 of them so, with preset
``accurate``, which smooths more, up to .40."""

ENOUGH, CORRECTIONS = 0.85, 2
"""Share of consistent pixels from which on no other brightness is guessed, and how often matches correct it."""

LEFT_OVER = 0.95
"""Share of the consistent pixels that must stay so when brightness is corrected by them: a few change anyway."""


@dataclass(frozen=True)
class Recipe:
    """A preset as a list of steps: of each level, of the start, and of the finest level after fractions of a pixel.

    ``half``: images are matched at half their resolution.
    """

    steps: Steps
    begin: tuple[Callable[..., Begun], ...]
    refinement: tuple[finest.Step, ...]
    planes: bool = True
    half: bool = False

    def less(self, without: tuple[str, ...]) -> Recipe:
        """The recipe without the steps of these names."""

        def kept(steps: tuple) -> tuple:
            return tuple(step for step in steps if step.__name__ not in without)

        steps = Steps(kept(self.steps.every), kept(self.steps.finest), self.steps.rounds)
        refinement = kept(self.refinement)
        return Recipe(steps, kept(self.begin), refinement, self.planes and "planes" not in without, self.half)


@dataclass(frozen=True)
class Begun:
    """The coarse levels: images (the right one aligned, if it is) and matches; the right image as it is, the ratio of
    brightness that is corrected in it, and the homography that it was aligned by."""

    views: Views
    state: State
    right: Image
    ratio: Floats | None = None
    alignment: plane.Matrix | None = None
    prior: start.Prior | None = None

    def anew(self, matched: Image, **changed: object) -> Begun:
        """Coarse levels of another right image, and other facts changed."""
        views = replace(self.views, right=matched)
        return replace(self, views=views, state=descend(views, COARSE, None, self.state.near_sign), **changed)  # type: ignore[arg-type]


def even(begun: Begun) -> Begun:
    """Brightness ratio of both images undone in the right one, first by a guess where little matches."""
    left, right = begun.views.left, begun.right
    if begun.state.share < ENOUGH:
        guess = brightness.guess(left, right, min(COARSE + 2, begun.views.levels - 1))
        if brightness.greatest(guess) > brightness.NOTABLE:
            other = brightness.levelled(right, guess)
            tried = begun.anew(other, right=other, ratio=guess)
            begun = tried if tried.state.share > begun.state.share else begun
    for _ in range(CORRECTIONS):
        ratio = brightness.matched(left, right, begun.state)
        before = 0.0 if begun.ratio is None else begun.ratio
        if ratio is None or brightness.greatest(ratio - before) <= brightness.NOTABLE:
            break
        other = brightness.levelled(right, ratio)
        tried = begun.anew(other, right=other, ratio=ratio)
        if tried.state.share < LEFT_OVER * begun.state.share:
            break
        begun = tried
    return begun


def known(begun: Begun) -> Begun:
    """Disparities known beforehand in the place of those found."""
    prior = start.aligned(begun.prior, begun.alignment)
    return replace(begun, state=start.impose(begun.views, begun.state, prior))


def align(begun: Begun) -> Begun:
    """The right image aligned by the dominant plane, where one explains the matches."""
    h = plane.find(sample(begun.views, begun.state), begun.state.level, begun.views.left.shapes)
    return begun if h is None else known(begun.anew(plane.aligned(begun.right, h, begun.views.left), alignment=h))


def turn(begun: Begun) -> Begun:
    """The right image turned and scaled by keypoints, where hardly a pixel matches and that helps."""
    # A plane may also be fitted to the few matches that chance makes.
    sizes = begun.views.left.shapes[0], begun.right.shapes[0]
    few = begun.state.share <= TOO_FEW or (begun.alignment is None and other_size(*sizes))
    h = viewpoint.find(begun.views.left, begun.right) if few and begun.prior is None else None
    if h is None:
        return begun
    upright = replace(begun, state=replace(begun.state, near_sign=0.0))
    turned = upright.anew(plane.aligned(begun.right, h, begun.views.left), alignment=h)
    return turned if turned.state.share > begun.state.share else begun


DEFAULT = Recipe(
    Steps((level.search, level.propagate, level.median), (level.edges,), rounds=(2, 2)),
    (even, known, align, turn),
    (finest.check, finest.refine, finest.landing, finest.speckles, finest.blanks),
)
FAST = replace(DEFAULT, planes=False, half=True)
ACCURATE = Recipe(
    Steps((level.search, level.propagate, level.paths, level.median), (level.edges,), rounds=(4, 4)),
    (even, known, align, turn),
    (finest.check, finest.refine, finest.smooth, finest.landing, finest.speckles, finest.blanks),
)
RECIPES: Mapping[str, Recipe] = {"default": DEFAULT, "fast": FAST, "accurate": ACCURATE}

WHOLE = ("paper",)
"""Presets with a method of their own, see :mod:`rille.stages.hfvm.paper`."""


@dataclass(frozen=True)
class Found:
    """Arrays of :class:`rille.stages.hfvm.stage.Disparity` by name, and whether the right image was aligned."""

    arrays: dict[str, AnyArray]
    aligned: bool


def match(left: Pyramid, right: Pyramid, params: HfvmParams, prior: start.Prior | None, tell: Tell) -> Found:
    """Dense displacements from the left image to the right one (4.3), step by step."""
    recipe = recipe_of(params)
    if halves(recipe, left.levels, right.levels):
        return enlarged(match(left.above(1), right.above(1), halved(params), start.halved(prior), tell), left, right)
    tell(0.0, "coarse levels")
    begun = begin(view(left, params), view(right, params), params, recipe, prior)  # 4.3.1 features, 4.3.4 hierarchy
    tell(0.15, "fine levels")
    state = descend(begun.views, 0, begun.state)  # 4.3.4: search, propagate, check, band, level by level
    tell(0.65, "refinement")
    work = finest_work(begun, state)
    fine = finest.subpixel(work)  # 4.3.2
    for step in recipe.refinement:  # 4.3.3 back-matching, refinement, validation
        fine = step(work, fine)
    tell(0.9, "filling")
    found = asdict(fine)
    ending = end(begun, found, recipe, state.near_sign)
    arrays = finest.complete(found, begun.views.left.layers[0].valid, whole(left.shape), params, ending)  # 4.3.4
    return Found(arrays, begun.alignment is not None)


def recipe_of(params: HfvmParams) -> Recipe:
    """Steps of the preset, but for those that the parameters leave out."""
    return RECIPES.get(params.preset, DEFAULT).less(params.without)


def begin(left: Image, right: Image, params: HfvmParams, recipe: Recipe, prior: start.Prior | None) -> Begun:
    """The coarse levels, brightness and alignment."""
    views = Views(left, right, params, recipe.steps)
    begun = Begun(views, descend(views, COARSE), right, prior=prior)
    for step in recipe.begin:
        begun = step(begun)
    return begun


def finest_work(begun: Begun, state: State) -> Work:
    """The finest level as its steps take it, whole images."""
    views, right = begun.views, begun.right.layers[0]
    noise = views.left.noise, views.right.noise
    b = views.right.layers[0]
    maps = state.left, state.right
    return Work(views.left.layers[0], b, right, *maps, views.params, begun.alignment, noise, views.left.shapes[0])


def end(begun: Begun, found: Mapping[str, AnyArray], recipe: Recipe, near_sign: float) -> Ending:
    """What the matches of the whole image tell: their epipolar lines, and planes without texture."""
    left, right, alignment = begun.views.left, begun.views.right, begun.alignment
    # Without a band rows are free: they are not to be set by lines.
    free = begun.views.params.band == 0 or begun.views.levels <= textureless.LEVEL
    f = None if free else finest.lines(found, (left.shapes[0], right.shapes[0]))
    planes = finest.planes((left, right), found, f, near_sign) if f is not None and recipe.planes else None
    return Ending(near_sign, alignment, f, planes, left.shapes[0])


def halves(recipe: Recipe, *levels: int) -> bool:
    """Whether images with so many levels are matched at half their resolution."""
    return recipe.half and min(levels) > 1


def halved(params: HfvmParams) -> HfvmParams:
    """Parameters of a match at half the resolution."""
    # At half the side an area has a quarter of the pixels.
    return params.model_copy(
        update={
            "preset": "default",
            "without": (*params.without, "planes"),
            "speckle": max(params.speckle // 4, 1),
            "fill_reach": params.fill_reach // 2,
        }
    )


def enlarged(found: Found, left: Pyramid, right: Pyramid) -> Found:
    """Results of half the resolution at the full one: each displacement, doubled, for 2 x 2 pixels."""
    return Found(enlarge.doubled(found.arrays, left.valid[0], right.shape, (0, 0)), found.aligned)
