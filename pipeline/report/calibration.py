"""What became of the rig, and what the matches of the basic pairs say about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rille.pipeline.export.artifacts import Floats, used_rig
from rille.pipeline.export.view import RunView
from rille.stages.geometry.epipolar import distances


@dataclass(frozen=True)
class Calibration:
    """The rig's facts by rig (one pooled, or one a pair), and what the matches of all basic pairs say about it.

    ``points`` (n, 2): column, row in the left image; ``before``, ``after`` (n,): signed distance of the right point
    from the epipolar line, px, under the given rig and under the one that was used. Outliers are left out.
    """

    facts: tuple[Mapping[str, Any], ...]
    points: Floats
    before: Floats
    after: Floats

    @property
    def changed(self) -> bool:
        """Whether any rig that was used differs from the given one."""
        return any(bool(facts.get("changed")) for facts in self.facts)

    def collected(self, key: str) -> list[Any]:
        """The entries of a list that each rig's facts have."""
        return [entry for facts in self.facts for entry in facts.get(key) or ()]


def calibration(view: RunView) -> Calibration | None:
    """What became of the rig; None where nothing looked at it."""
    p = view.products
    handles = list({id(handle): handle for handle in p.rigs.values()}.values())
    facts = tuple(bundle.meta for bundle in map(view.bundle, handles) if bundle is not None)
    if not facts:
        return None
    parts = [_residuals(view, pair) for pair in p.orientations]
    points, before, after = (np.concatenate([part[k] for part in parts if part] or [_NONE[k]]) for k in range(3))
    return Calibration(facts, points, before, after)


_NONE = (np.empty((0, 2)), np.empty(0), np.empty(0))


def _residuals(view: RunView, pair: int) -> tuple[Floats, Floats, Floats] | None:
    """Left points of a pair's inliers, and their epipolar residuals under the given and the used rig, px."""
    bundle = view.bundle(view.products.orientations.get(pair))
    if bundle is None:
        return None
    left, right = (np.asarray(bundle[name], dtype=np.float64) for name in ("left", "right"))
    kept = np.asarray(bundle["weight"]) > 0
    left, right, given, used = left[kept], right[kept], view.sequence.rig, used_rig(view, pair)
    before = distances(given, np.zeros(5), left, right)[0]
    after = before if used.to_dict() == given.to_dict() else distances(used, np.zeros(5), left, right)[0]
    return left, before, after
