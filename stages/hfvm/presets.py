"""Each preset as a list of steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rille.stages.hfvm import coarse, finest, level
from rille.stages.hfvm.level import LevelSteps
from rille.stages.hfvm.params import HfvmParams


@dataclass(frozen=True)
class Recipe:
    """A preset as a list of steps: of each level, of the start, and of the finest level after fractions of a pixel.

    ``half``: images are matched at half their resolution.
    """

    steps: LevelSteps
    begin: tuple[coarse.Step, ...]
    refinement: tuple[finest.Step, ...]
    planes: bool = True
    half: bool = False

    def less(self, without: tuple[str, ...]) -> Recipe:
        """The recipe without the steps of these names."""

        def kept(steps: tuple) -> tuple:
            return tuple(step for step in steps if step.__name__ not in without)

        steps = LevelSteps(kept(self.steps.every), kept(self.steps.finest), self.steps.rounds)
        refinement = kept(self.refinement)
        return Recipe(steps, kept(self.begin), refinement, self.planes and "planes" not in without, self.half)


DEFAULT = Recipe(
    LevelSteps((level.search, level.propagate, level.median), (level.edges,), rounds=(2, 2)),
    (coarse.even, coarse.known, coarse.align, coarse.turn),
    (finest.check, finest.refine, finest.landing, finest.speckles, finest.blanks),
)
FAST = replace(DEFAULT, planes=False, half=True)
ACCURATE = Recipe(
    LevelSteps((level.search, level.propagate, level.paths, level.median), (level.edges,), rounds=(4, 4)),
    (coarse.even, coarse.known, coarse.align, coarse.turn),
    (finest.check, finest.refine, finest.smooth, finest.landing, finest.speckles, finest.blanks),
)
RECIPES: Mapping[str, Recipe] = {"default": DEFAULT, "fast": FAST, "accurate": ACCURATE}

WHOLE = ("paper",)
"""Presets with a method of their own, see :mod:`rille.stages.hfvm.paper`."""


def recipe_of(params: HfvmParams) -> Recipe:
    """Steps of the preset, but for those that the parameters leave out."""
    return RECIPES.get(params.preset, DEFAULT).less(params.without)


def local(params: HfvmParams) -> bool:
    """Whether all steps look at the surroundings of a pixel alone; paths and the relief reach over whole images."""
    recipe = recipe_of(params)
    reaching = level.paths in recipe.steps.every or finest.smooth in recipe.refinement
    return params.preset not in WHOLE and not reaching


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
