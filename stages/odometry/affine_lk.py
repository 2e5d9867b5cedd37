"""Sub-pixel alignment of templates under a local affinity (refinement of tracked positions, section 5.2.1).

Feature vectors find the corresponding *pixel*. The grey values give the position within it more exactly, once the
template is drawn in the perspective of the searched frame. Affine Lucas-Kanade, inverse compositional: Baker and
Matthews (2004), doi:10.1023/B:VISI.0000011205.11775.fd. Grey values are compared less their mean and at equal contrast,
so that the exposure may change from frame to frame. The affinity that the neighbouring tracks suggest is a prior, so
that weak texture keeps to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.kernel import kernel
from rille.stages.geometry.cubic import cubic

HALF = 5
"""Half the template's side: 11 x 11 pixels hold enough texture and still look plane."""
SIDE = 2 * HALF + 1
SETTLED_PX = 0.01
"""Step below which a template has converged: a tenth of the error that remains."""


class Templates(NamedTuple):
    """``points`` (n, 2) column, row in a; ``start`` (n, 2) where they are expected in b, NaN stays NaN; ``affinity``
    (n, 2, 2) expected derivative of b's coordinates by a's."""

    points: Floats
    start: Floats
    affinity: Floats

    def take(self, which: NDArray[np.intp]) -> Templates:
        """The templates of these numbers."""
        return Templates(*(values[which] for values in self))


def align(
    a: Floats32,
    b: Floats32,
    templates: Templates,
    *,
    noise: float,
    spread: float,
    reach: float,
    settled: float = SETTLED_PX,
) -> Floats:
    """Positions (n, 2) column, row in ``b`` of the templates around points of ``a``.

    NaN where one leaves the image, does not converge or is refused.

    Parameters
    ----------
    a, b : (rows, cols) grey values.
    noise : grey levels, standard deviation of a difference.
    spread : standard deviation of an element of the affinity around the expected one.
    reach : pixels; a result farther than this from ``start`` is refused.
    settled : step [pixels] below which a template has converged.
    """
    out = np.full(templates.points.shape, np.nan)
    template, descent = _descent(a, templates.points)
    contrast = np.linalg.norm(template, axis=1, keepdims=True)
    gram = descent @ np.swapaxes(descent, 1, 2)
    xx, yy, xy = gram[:, 0, 0], gram[:, 1, 1], gram[:, 0, 1]
    # Not so where the template leaves the image, is flat, or has one direction only: less than 1e-9 is rounding.
    textured = xx * yy - xy**2 > 1e-9 * (xx + yy)
    # A template that has shrunk to a tenth draws no texture.
    live = np.flatnonzero(textured & (np.abs(np.linalg.det(templates.affinity)) > 0.1))
    # Weight of the prior in squared grey levels: variance of a grey difference over that of an element of the affinity.
    ridge = (noise / spread) ** 2
    prior = np.array([0.0, 0.0, ridge, ridge, ridge, ridge, 0.0, 0.0])
    inverse, unexpected = np.zeros_like(gram), np.zeros_like(templates.affinity)
    # Inverse compositional: derivatives are those of the template, so one inverse serves all steps.
    inverse[live] = np.linalg.inv(gram[live] + np.diag(prior + 1e-9))
    unexpected[live] = np.linalg.inv(templates.affinity[live])
    # Steps are composed into the affinity; the prior pulls towards what was expected.
    at, affinity = templates.start[live], templates.affinity[live]
    # Five steps are usual.
    for _ in range(15):
        grey = _drawn(b, at, affinity, HALF)
        inside = np.isfinite(grey).all(1)
        live, at, affinity = live[inside], at[inside], affinity[inside]
        off = _levelled(grey[inside], contrast[live]) - template[live]
        right = descent[live] @ off[:, :, None]
        # Added, not subtracted: a step is composed inversely, so excess affinity counts like a grey difference.
        right[:, 2:6] += ridge * (unexpected[live] @ affinity - np.eye(2)).reshape(-1, 4, 1)
        step = inverse[live] @ right
        affinity = affinity @ np.linalg.inv(np.eye(2) + step[:, 2:6].reshape(-1, 2, 2))
        move = (affinity @ step[:, :2])[:, :, 0]
        at = at - move
        near = (np.abs(at - templates.start[live]) <= reach).all(1)
        done = near & (np.abs(move) < settled).all(1)
        out[live[done]] = at[done]
        on = near & ~done
        live, at, affinity = live[on], at[on], affinity[on]
    return out


def _descent(a: Floats32, points: Floats) -> tuple[Floats, Floats]:
    """Grey values (n, k) of k pixels less their mean, and derivatives (n, 8, k); NaN where a template leaves the image.

    By the unknowns: shift (2), affinity (4), and offset and gain, which a shift changes as well.
    """
    # One pixel more on every side than the template, for its central differences.
    patch = _drawn(a, points, np.eye(2), HALF + 1).reshape(-1, SIDE + 2, SIDE + 2)
    grey = patch[:, 1:-1, 1:-1].reshape(-1, SIDE * SIDE)
    gx = 0.5 * (patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2]).reshape(-1, SIDE * SIDE)
    gy = 0.5 * (patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]).reshape(-1, SIDE * SIDE)
    x, y = _offsets(HALF)
    off = grey - grey.mean(1, keepdims=True)
    return off, np.stack([gx, gy, gx * x, gx * y, gy * x, gy * y, np.ones_like(grey), off], 1)


def _levelled(grey: Floats, contrast: Floats) -> Floats:
    """Grey values (n, k) less their mean, at the contrast (n, 1) of their template: of the same exposure."""
    off = grey - grey.mean(1, keepdims=True)
    return np.asarray(off * (contrast / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-9)))


def _offsets(half: int) -> Floats:
    """Column, row (2, k) of the pixels of a square from its middle, row by row."""
    return np.asarray(np.mgrid[-half : half + 1, -half : half + 1][::-1].reshape(2, -1), np.float64)


def _drawn(image: Floats32, at: Floats, affinity: Floats, half: int) -> Floats:
    """Grey values (n, k) of squares under affinities (n, 2, 2) about points (n, 2); NaN outside the image."""
    places = at[:, :, None] + affinity @ _offsets(half)
    out = np.empty((len(at), places.shape[2]))
    _sample(np.ascontiguousarray(image, np.float32), places, out)
    return out


@kernel
def _sample(image, places, out):  # type: ignore[no-untyped-def]
    """Grey values ``out`` (n, k) at places (n, 2, k); NaN where cubic interpolation reads beyond the image."""
    rows, cols = image.shape
    for n in range(len(out)):
        for k in range(out.shape[1]):
            x, y = places[n, 0, k], places[n, 1, k]
            inside = 1.0 <= x < cols - 2.0 and 1.0 <= y < rows - 2.0
            out[n, k] = cubic(image, x, y) if inside else np.nan
