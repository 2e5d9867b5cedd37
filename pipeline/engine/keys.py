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
import json
import math
from json.encoder import encode_basestring_ascii as _quoted
from typing import Any

from pydantic import BaseModel


def canonical(value: Any, where: str = "value") -> Any:
    """Tagged JSON tree of ``value``; every JSON list in it starts with its tag, so no two values share a tree.

    Raises
    ------
    TypeError
        A part of the value has no canonical form; the message names the place.
    """
    # By type, not isinstance: an enumeration is an int or str, too, and would share the digest of its value.
    if value is None or isinstance(value, bool) or type(value) is str or type(value) is int:
        return value
    if isinstance(value, float):
        return ["float", "nan" if math.isnan(value) else float(value).hex()]
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        return ["model", type(value).__name__, canonical(fields, where)]
    if isinstance(value, dict):
        for key in value:
            if type(key) is not str:
                raise TypeError(f"{where} has the key {key!r}: keys are text")
        return {key: canonical(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return ["list", *(canonical(item, f"{where}[{i}]") for i, item in enumerate(value))]
    if isinstance(value, set | frozenset):
        return ["set", *sorted((canonical(item, where) for item in value), key=_text)]
    raise TypeError(f"{where} is a {type(value).__name__}, which has no canonical form: give plain JSON values")


def digest(value: Any, where: str = "value") -> str:
    """SHA-256 of the canonical form, 64 hexadecimal digits."""
    return hashlib.sha256(text(value, where).encode()).hexdigest()


def text(value: Any, where: str = "value") -> str:
    """The canonical form as JSON without spaces, keys in order; without building the tree, for plans ask it often.

    Raises
    ------
    TypeError
        As :func:`canonical`.
    """
    try:
        return _plain(value)
    except _FormlessError:
        return _text(canonical(value, where))


class _FormlessError(Exception):
    """Something has no canonical form; :func:`canonical` says what, and where."""


def _plain(value: Any) -> str:
    kind = type(value)
    if kind is str:
        return _quoted(value)
    if kind is int or value is None or kind is bool:
        return "null" if value is None else repr(value).lower()
    if isinstance(value, float):
        return f'["float","{"nan" if math.isnan(value) else float(value).hex()}"]'
    if isinstance(value, dict):
        if not all(type(key) is str for key in value):
            raise _FormlessError
        return "{" + ",".join([f"{_quoted(key)}:{_plain(value[key])}" for key in sorted(value)]) + "}"
    if isinstance(value, list | tuple):
        return ",".join(['["list"', *map(_plain, value)]) + "]"
    if isinstance(value, set | frozenset):
        return ",".join(['["set"', *sorted(map(_plain, value))]) + "]"
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        return f'["model",{_quoted(type(value).__name__)},{_plain(fields)}]'
    raise _FormlessError


def _text(tree: Any) -> str:
    return json.dumps(tree, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
