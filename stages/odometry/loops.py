"""Candidates for a place seen again: the earlier basic pairs whose left images share most words with that of a pair.

A word describes the look of a feature: the signs of :data:`WORD_BITS` differences between fixed pairs of its
descriptor's values. No vocabulary is learnt, so the words of an image depend on that image alone, and a pair that is
added changes no earlier one. Pairs are indexed in blocks; a block reads the words of the earlier ones, some kilobytes a
pair. Of images with binary words the similarity is their number in common over the geometric mean of their numbers
(Sivic and Zisserman 2003, doi:10.1109/ICCV.2003.1238663, without weights).

Candidates only look alike: the geometry decides whether they show one place
(:mod:`rille.stages.odometry.resection.loop`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.declare import AnyArray, Array, Bundle, Params, stage
from rille.stages.facts.odometry import PlacesFacts

WORD_BITS, TABLES = 16, 2
"""Bits of a word, and words of a feature: a sign that noise turns spoils one of them."""
COMPARED = np.random.default_rng(0).integers(0, 128, (TABLES, WORD_BITS, 2))
"""Values of the descriptor that are compared."""
CANDIDATES = 6
"""Earlier pairs that the geometry of a pair is compared with: on a flight (EuRoC) 93 % of the pairs that match."""


class LoopsParams(Params):
    """Parameters of places that are seen again.

    Attributes
    ----------
    enabled : look for places that are seen again, and adjust all poses to them.
    apart : number of basic pairs from which on a place counts as seen again, not as still in view.
    """

    enabled: bool = True
    apart: int = Field(10, ge=2)


def words(descriptors: AnyArray) -> NDArray[np.int32]:
    """Different words of an image, ascending, of its descriptors (n, 128)."""
    signs = descriptors[:, COMPARED[..., 0]] > descriptors[:, COMPARED[..., 1]]
    numbers = signs @ (1 << np.arange(WORD_BITS)) + (np.arange(TABLES) << WORD_BITS)
    return np.unique(numbers).astype(np.int32)


def similarities(a: Sequence[NDArray[np.int32]], b: Sequence[NDArray[np.int32]]) -> NDArray[np.float64]:
    """Similarity (len(a), len(b)) of images by their words, 0..1."""
    product = _incidence(a) @ _incidence(b).T
    count = np.sqrt(np.outer([max(len(w), 1) for w in a], [max(len(w), 1) for w in b]))
    return np.asarray(product.toarray() / count, dtype=np.float64)


def _incidence(images: Sequence[NDArray[np.int32]]) -> scipy.sparse.csr_array:
    """1 in the row of an image and the column of each of its words."""
    ends = np.cumsum([0, *(len(w) for w in images)])
    columns = np.concatenate([*images, np.zeros(0, np.int32)])
    return scipy.sparse.csr_array((np.ones(ends[-1]), columns, ends), shape=(len(images), TABLES << WORD_BITS))


@stage(
    "loops",
    outputs=[
        Array("words", ("word",), "int32", "1", "words of the pairs, one pair after another"),
        Array("count", ("pair",), "int32", "1", "number of words of each pair"),
    ],
)
def loops_stage(
    params: LoopsParams, features: Sequence[Bundle], earlier: Sequence[Bundle[PlacesFacts]] = (), *, pairs: list[int]
) -> Bundle[PlacesFacts]:
    """Earlier basic pairs that may show the places of some pairs."""
    mine = [words(np.asarray(image["descriptors"])) for image in features]
    before, numbers = list[NDArray[np.int32]](), list[int]()
    for block in earlier:
        before += np.split(np.asarray(block["words"]), np.cumsum(block["count"])[:-1])
        numbers += block.meta["pairs"]
    numbers += pairs
    alike = similarities(mine, [*before, *mine])
    candidates = []
    for k, row in enumerate(alike):
        # What lies nearer in the order of the pairs may still be in view.
        far = row[: max(len(before) + k - params.apart + 1, 0)]
        best = np.argsort(-far, kind="stable")[:CANDIDATES]
        candidates.append(sorted(numbers[i] for i in best if far[i] > 0))
    count = np.array([len(w) for w in mine], np.int32)
    return Bundle(
        {"words": np.concatenate([*mine, np.zeros(0, np.int32)]), "count": count},
        {"pairs": pairs, "candidates": candidates},
    )
