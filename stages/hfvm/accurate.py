"""One-level solver of preset ``accurate``: the fast search, then propagation along paths with two feature sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stages.declare import AnyArray
from stages.hfvm import compact, paths
from stages.hfvm.hierarchy import Band, FastSolver, Fine, Map, Prepared
from stages.hfvm.params import HfvmParams
from stages.pyramid import Pyramid, filled


@dataclass(frozen=True)
class AccurateSolver:
    """A :class:`FastSolver` whose maps are improved along paths; ``left, right``: every level of both images."""

    fast: FastSolver
    left: tuple[paths.View, ...]
    right: tuple[paths.View, ...]
    params: HfvmParams
    uses_band: bool = True

    def match(self, level: int, up: Map | None, band: Band) -> Map:
        """Integer map of a level."""
        p, found = self.params, self.fast.match(level, up, band)
        u, v = paths.propagate(
            self.left[level],
            self.right[level],
            (found.u, found.v),
            None if up is None else (up.u, up.v),
            band.lines(found.u.shape),
            band.mu,
            paths.Weights(p.path_compact, p.path_small, p.path_large, p.path_grey),
            p.path_rounds,
        )
        return Map(u, v, found.undefined)

    def fine(self, level: int, m: Map, wanted: AnyArray) -> Fine:
        """Sub-pixel map from summed distances."""
        return self.fast.fine(level, m, wanted)

    def reverse(self) -> AccurateSolver:
        """The matcher from right to left."""
        return AccurateSolver(self.fast.reverse(), self.right, self.left, self.params)


def extend(pair: Prepared, left: Pyramid, right: Pyramid, params: HfvmParams) -> Prepared:
    """The pair with the accurate solver in place of the fast one, where there are rounds along paths."""
    if params.path_rounds == 0 or not isinstance(pair.solver, FastSolver):
        return pair
    views = (_views(left, pair.solver.left), _views(right, pair.solver.right))
    return Prepared(AccurateSolver(pair.solver, *views, params), pair.left_valid, pair.right_valid, pair.deviation)


def _views(pyramid: Pyramid, words: Sequence[AnyArray]) -> tuple[paths.View, ...]:
    images = filled(pyramid)
    return tuple(paths.View(w, compact.pack(image), image) for w, image in zip(words, images, strict=False))
