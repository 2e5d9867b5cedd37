"""Digest of a result, over the *decoded* arrays (type, shape, little-endian bytes, one NaN) and the metadata.

A change of codec or of chunking changes no key, and an upstream change that does not change a result stops there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.pipeline.engine.keys import digest
from rille.stages.core.declare import AnyArray


def array_digests(arrays: Mapping[str, AnyArray]) -> dict[str, str]:
    """SHA-256 of each array: type, shape and little-endian bytes in C order, every NaN made the same."""
    return {name: _array_digest(name, np.asarray(arrays[name])) for name in sorted(arrays)}


def _array_digest(name: str, array: AnyArray) -> str:
    if array.dtype.kind not in "biuf":
        raise TypeError(f"array {name} is {array.dtype}: store integers, floats or booleans")
    little = array.dtype.newbyteorder("<")
    plain = np.ascontiguousarray(array, dtype=little)
    if array.dtype.kind == "f":
        # NaN has millions of bit patterns, and processors choose differently among them.
        bits, usual = (a.view(f"<u{little.itemsize}") for a in (plain, little.type(np.nan)))
        if (np.isnan(plain) & (bits != usual)).any():
            plain = np.where(np.isnan(plain), little.type(np.nan), plain)
    total = hashlib.sha256(f"{little.str} {array.shape}\0".encode())
    total.update(plain.data)
    return total.hexdigest()


def output_digest(digests: Mapping[str, str], meta: Mapping[str, Any]) -> str:
    """Digest of a result: the digests of its arrays, and its metadata.

    Raises
    ------
    TypeError
        ``meta`` is not plain JSON; a bundle's has None for NaN and infinities.
    """
    return digest({"arrays": dict(digests), "meta": dict(meta)}, "result")
