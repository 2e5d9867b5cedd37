"""One-level solver of preset ``accurate``: the fast search, then propagation along paths with two feature sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.coarse_to_fine import paths
from rille.stages.hfvm.coarse_to_fine.hierarchy import Band, FastSolver, Fine, Map, Solver, solver
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import Patch
from rille.stages.hfvm.images.window import Shape
from rille.stages.hfvm.level import compact


@dataclass(frozen=True)
class AccurateSolver:
    """A :class:`FastSolver` whose maps are improved along paths, which cross the whole image."""

    fast: FastSolver
    params: HfvmParams
    uses_band: bool = True

    def rounds(self, level: int) -> int:
        """Rounds of propagation at a level."""
        return self.fast.rounds(level)

    def match(self, level: int, a: Patch, b: Patch, shapes: tuple[Shape, Shape], up: Map | None, band: Band) -> Map:
        """Integer map of a level."""
        p, found = self.params, self.fast.match(level, a, b, shapes, up, band)
        u, v = paths.propagate(
            _view(a),
            _view(b),
            (np.asarray(found.u), np.asarray(found.v)),
            None if up is None else (np.asarray(up.u), np.asarray(up.v)),
            (band.lines(a.window), band.mu),
            paths.Weights(p.path_compact, p.path_small, p.path_large, p.path_grey),
            p.path_rounds,
        )
        return Map(u, v, found.undefined)

    def fine(self, a: Patch, b: Patch, m: Map, wanted: AnyArray) -> Fine:
        """Sub-pixel map from summed distances."""
        return self.fast.fine(a, b, m, wanted)

    def reverse(self) -> AccurateSolver:
        """The matcher from right to left."""
        return AccurateSolver(self.fast.reverse(), self.params)


def choose(params: HfvmParams) -> Solver:
    """The solver of a preset: with propagation along paths where there are rounds of it."""
    plain = solver(params)
    if params.path_rounds == 0 or not isinstance(plain, FastSolver):
        return plain
    return AccurateSolver(plain, params)


def _view(patch: Patch) -> paths.LevelView:
    return paths.LevelView(patch.words, compact.pack(patch.grey), patch.grey)
