"""Canonical typed JSON and its SHA-256: the only identity that tasks and artifacts have.

Two values get one digest exactly when they are the same value of the same type. Floats are written by
``float.hex`` (every bit counts, all NaN are one), ``1``, ``1.0`` and ``True`` are three different values, a tuple is
a list, the order of dictionary keys and of sets does not count, and a parameter model counts with all its defaults
filled. Anything else (paths, arrays, NumPy integers, objects) is refused with ``TypeError``: what has no canonical
form must not enter a key.

>>> digest({"cell_size": 0.01}) == digest({"cell_size": 0.010000000000000002})
False
"""

from __future__ import annotations

import hashlib
import math
from json.encoder import encode_basestring_ascii as _quoted
from typing import Any

from pydantic import BaseModel


def digest(value: Any, where: str = "value") -> str:
    """SHA-256 of the canonical form, 64 hexadecimal digits."""
    return hashlib.sha256(text(value, where).encode()).hexdigest()


def text(value: Any, where: str = "value") -> str:
    """The canonical form: JSON without spaces, keys in order; each JSON list starts with its tag, so no two values
    share a form.

    Raises
    ------
    TypeError
        A part of the value has no canonical form; the message names the place.
    """
    # By type, not isinstance: an enumeration is an int or str, too, and would share the digest of its value.
    kind = type(value)
    if kind is str:
        return _quoted(value)
    if kind is int or value is None or kind is bool:
        return "null" if value is None else repr(value).lower()
    if isinstance(value, float):
        return f'["float","{"nan" if math.isnan(value) else float(value).hex()}"]'
    if isinstance(value, dict):
        for key in value:
            if type(key) is not str:
                raise TypeError(f"{where} has the key {key!r}: keys are text")
        return "{" + ",".join([f"{_quoted(key)}:{text(value[key], f'{where}.{key}')}" for key in sorted(value)]) + "}"
    if isinstance(value, list | tuple):
        return ",".join(['["list"', *[text(item, f"{where}[{i}]") for i, item in enumerate(value)]]) + "]"
    if isinstance(value, set | frozenset):
        return ",".join(['["set"', *sorted(text(item, where) for item in value)]) + "]"
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        return f'["model",{_quoted(type(value).__name__)},{text(fields, where)}]'
    raise TypeError(f"{where} is a {type(value).__name__}, which has no canonical form: give plain JSON values")
