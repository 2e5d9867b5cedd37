"""Where the windows lie that a kernel compares."""

from __future__ import annotations

from typing import NamedTuple


class WindowPair(NamedTuple):
    """First column and row of the window of the left image and of that of the right one, and the size of the latter's
    image, pixels. A kernel looks only at what lands in the right window."""

    x0: int
    y0: int
    rx0: int
    ry0: int
    rows: int
    cols: int
