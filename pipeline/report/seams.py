"""Page of the seam audit: the seams, worst first, with a picture of the worst; and which models are to blame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export import ranges
from rille.pipeline.report import canvas, figures
from rille.pipeline.report.canvas import Block, Table
from rille.pipeline.report.gather import Scene
from rille.pipeline.report.words import number, spread

Facts = Mapping[str, Any]

MOST_NAMED = 5
"""Models that a caption names."""

MOST_ROWS = 12
"""Seams and models in a table; report.json has more of them."""


VERDICTS = (("found", "stands out"), ("contradicts", "beyond its σ"))
"""Facts of a model in the audit, and their words."""

CLOSE = 2.0
"""Times what noise lets expect up to which seams are said to agree."""


def audit(scene: Scene) -> Facts | None:
    """Facts of the audit; None without one, or without a seam."""
    bundle = scene.view.bundle(scene.view.products.overlap_audit)
    return bundle.meta if bundle is not None and bundle.meta["seams"] else None


def facts(scene: Scene) -> dict[str, Any] | None:
    """The audit for report.json: variance factor, models, how many seams there are and the worst of them."""
    found = audit(scene)
    names = "variance_factor", "models", "seam_count", "seams"
    return None if found is None else {name: found[name] for name in names}


def worst(scene: Scene) -> Block | None:
    """The seam whose bias and tilt are greatest against what sigma allows: its map, and the map without its plane."""
    found = audit(scene)
    if found is None:
        return None
    first = found["seams"][0]
    bundle = scene.view.bundle(scene.view.products.seams.get(first["pair"]))
    if bundle is None:
        return None
    at = next(s for s in bundle.meta["seams"] if s["other"] == first["other"])
    difference = np.asarray(bundle[f"difference_{first['other']}"], dtype=np.float64)
    x_min, _, _, y_max = at["map"]["bounds"]
    step = at["map"]["step"]
    extent = (x_min, x_min + step * difference.shape[1], y_max - step * difference.shape[0], y_max)
    left = difference - _plane(at, extent, difference.shape)
    # One scale for both maps: what the plane explains is seen to go.
    bound = ranges.limits(np.abs(difference), 0, 97)[1]
    name = f"pair {first['pair']} minus pair {first['other']}"
    panels = (
        figures.error_map(difference, extent, f"Elevation of {name}, {spread(difference)} m", label=name, bound=bound),
        figures.error_map(
            left,
            extent,
            f"The same without bias and tilt, {spread(left)} m",
            label="without bias and tilt",
            bound=bound,
        ),
    )
    caption = (
        f"The worst of {found['seam_count']} seams: elevation of {name} where both are known, and what is left of it "
        f"without its bias of {_signed(first['bias'])} and tilt of {_degrees(first['tilt'][0])} along x and "
        f"{_degrees(first['tilt'][1])} along y. A plane is an error of pose (or rig); what is left is noise of the "
        "matching, and edges that two views see apart. In the table noise is compared with what both models' own "
        f"standard deviations let expect. ± is one standard deviation, from the scatter of blocks of cells. "
        f"{_judged(math.sqrt(found['variance_factor']))}"
    )
    return Block("Seams", "Seams between elevation models, the worst first", caption, panels, table=_seam_table(found))


def models(scene: Scene) -> Block | None:
    """Draw the bias and tilt of each model that explain its seams."""
    found = audit(scene)
    if found is None:
        return None
    listed = found["models"]
    named = [m for m in listed if m["found"] or m["contradicts"]]
    words = [
        f"{len(named)} of {len(listed)} models stand out; look first at {_listed(named[:MOST_NAMED])}."
        if named
        else "No model stands out.",
        "Bias (at the middle of a model) and tilt explain a model's seams best, its neighbours held; the worst model "
        "was taken out before the next one was judged. A model stands out where chance and the other "
        "models' poses give as much only once in ten thousand; it is beyond its σ where the error is larger than its "
        "own standard deviations allow.",
    ]
    rows = tuple(
        (
            str(m["pair"]),
            *_fitted(m, m["sigma"]),
            _size(m["systematic"]),
            _size(m["expected"]),
            ", ".join(word for key, word in VERDICTS if m[key]) or "as expected",
        )
        for m in listed[:MOST_ROWS]
    )
    head = ("Pair", "bias", "tilt along x", "tilt along y", "RMS of both", "σ of a cell's difference", "verdict")
    table = Table(head, rows, tuple(range(1, 6)))
    return Block("Seam audit", "Elevation models by their own error", " ".join(words), (), table=table)


def _listed(models: Sequence[Facts]) -> str:
    return f"pair{'s' if len(models) > 1 else ''} {', '.join(str(m['pair']) for m in models)}"


def _judged(factor: float) -> str:
    """What the errors of the seams say, over those that noise alone would make."""
    off = f"Seams are off by {factor:.2g} times what noise alone lets expect (median)"
    return f"{off}: {'they agree' if factor <= CLOSE else 'poses (or the rig) are less exact than elevations'}."


def _plane(at: Facts, extent: canvas.Extent, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Height of a seam's plane on the cells of its map."""
    step = at["map"]["step"]
    x = extent[0] + step * (np.arange(shape[1]) + 0.5) - at["centre"][0]
    y = extent[3] - step * (np.arange(shape[0]) + 0.5) - at["centre"][1]
    return np.asarray(at["bias"] + at["tilt"][0] * x[None] + at["tilt"][1] * y[:, None])


def _seam_table(found: Facts) -> Table:
    rows = []
    for s in found["seams"][:MOST_ROWS]:
        sigma = np.sqrt(np.maximum(np.diag(np.array(s["covariance"])), 0.0)).tolist()
        rows.append(
            (
                f"{s['pair']} – {s['other']}",
                str(s["cells"]),
                *_fitted(s, sigma),
                _size(s["noise"]),
                _size(s["expected"]),
            )
        )
    head = ("Seam", "cells", "bias", "tilt along x", "tilt along y", "noise", "expected noise")
    return Table(head, tuple(rows), tuple(range(1, 7)))


def _fitted(plane: Facts, sigma: Sequence[float]) -> list[str]:
    """Bias and both tilts of a plane, each with its standard deviation."""
    tilts = zip(plane["tilt"], sigma[1:], strict=True)
    return [
        f"{_signed(plane['bias'])} ± {_size(sigma[0])}",
        *(f"{_degrees(t)} ± {number(math.degrees(s), 2)}°" for t, s in tilts),
    ]


def _size(metres: float) -> str:
    """Millimetres with two digits: finer is beyond what the scatter of blocks tells."""
    return f"{number(1000 * metres, 2)} mm"


def _signed(metres: float) -> str:
    return ("+" if metres > 0 else "") + _size(metres)


def _degrees(radians: float) -> str:
    value = math.degrees(radians)
    return ("+" if value > 0 else "") + f"{number(value, 2)}°"
