"""Calls side by side, for kernels that let go of the interpreter; the order of the results is that of the calls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def side_by_side(calls: Sequence[Callable[[], T]], threads: int) -> list[T]:
    """Results of calls, at most ``threads`` of which run at a time."""
    if threads <= 1 or len(calls) == 1:
        return [call() for call in calls]
    with ThreadPoolExecutor(threads) as pool:
        return [running.result() for running in [pool.submit(call) for call in calls]]
