"""A binary heap of (key, node) in two arrays, for searches in numba: the least key first, of equal keys the least node.

Of the arrays the first ``size`` entries count.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.numeric.line import copy_line


@njit(cache=True, nogil=True)
def before(key, node, other_key, other_node):  # type: ignore[no-untyped-def]
    """Whether an entry comes first."""
    return key < other_key or (key == other_key and node < other_node)


@njit(cache=True, nogil=True)
def grown(a):  # type: ignore[no-untyped-def]
    """Twice the room, for keys or nodes of a full heap. The caller asks for it: a ``push`` that gave back either arrays
    would count references at every entry, a quarter of a search's time."""
    out = np.empty(2 * a.shape[0], a.dtype)
    copy_line(a, out)
    return out


@njit(cache=True, nogil=True)
def push(keys, nodes, at, key, node):  # type: ignore[no-untyped-def]
    """Add an entry to a heap of ``at`` entries that is not full."""
    while at > 0:
        parent = (at - 1) // 2
        if not before(key, node, keys[parent], nodes[parent]):
            break
        keys[at], nodes[at] = keys[parent], nodes[parent]
        at = parent
    keys[at], nodes[at] = key, node


@njit(cache=True, nogil=True)
def pop(keys, nodes, size):  # type: ignore[no-untyped-def]
    """Take the first entry, which the caller has read, off the heap; the number of those that remain."""
    size -= 1
    # The last entry goes where the first was, and sinks to its place.
    key, node = keys[size], nodes[size]
    at = 0
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size and before(keys[child + 1], nodes[child + 1], keys[child], nodes[child]):
            child += 1
        if not before(keys[child], nodes[child], key, node):
            break
        keys[at], nodes[at] = keys[child], nodes[child]
        at = child
    keys[at], nodes[at] = key, node
    return size
