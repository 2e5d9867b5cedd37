"""The decorator of compiled kernels."""

from __future__ import annotations

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
"""Compiles a function, and keeps the result; other threads run meanwhile.

A division by zero gives an infinity or NaN, as NumPy's does: a check of each divisor, as Python has it, keeps a loop
from the processor's vector instructions (the steps of windows then take 4.5 times as long).
"""

inlined = njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
"""The same for what kernels call at each pixel: it becomes a part of each caller."""
