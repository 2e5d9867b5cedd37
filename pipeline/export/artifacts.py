"""Small readers of artifacts, shared by parts of the report."""

from __future__ import annotations

import numpy as np

from rille.pipeline.export.view import RunView
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle
from rille.stages.geometry import rigid
from rille.stages.geometry.geometry import Rig


def used_rig(view: RunView, pair: int) -> Rig:
    """The rig that a basic pair was reconstructed with; as given if no other is known."""
    bundle = view.bundle(view.products.rigs.get(pair))
    return view.sequence.rig if bundle is None or "rig" not in bundle.meta else Rig.from_dict(bundle.meta["rig"])


def by_frame(view: RunView, bundle: Bundle, name: str) -> Floats:
    """An array of an artifact with one row for each chosen frame, NaN for frames without one."""
    values = np.asarray(bundle[name], dtype=np.float64)
    frames = list(bundle.meta.get("frames") or view.frames[: len(values)])
    return rigid.by_frame(values, frames, list(view.frames))


def chain(view: RunView) -> tuple[int, ...]:
    """Frames of the trajectory, in order; all chosen ones if there is no trajectory."""
    bundle = view.bundle(view.products.screening)
    return view.frames if bundle is None else tuple(int(f) for f in bundle.meta["chain"])
