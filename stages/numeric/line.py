"""Lines of arrays in kernels."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, inline="always")
def copy_line(source, out):  # type: ignore[no-untyped-def]
    """Copy (n,) to (n,), entry by entry.

    ``out[:] = source`` would make numba compile the words of its error for shapes that differ: five seconds in each
    process, more than most kernels take.
    """
    for i in range(source.shape[0]):
        out[i] = source[i]
