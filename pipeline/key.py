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
from typing import Any

from pydantic import BaseModel


def canonical(value: Any, where: str = "value") -> Any:
    """Tagged JSON tree of ``value``; every JSON list in it starts with its tag, so no two values share a tree.

    Raises
    ------
    TypeError
        A part of the value has no canonical form; the message names the place.
    """
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
    return hashlib.sha256(_text(canonical(value, where)).encode()).hexdigest()


class Fixed:
    """A part of what is digested whose canonical form is kept: the same code, packages, parameters of many tasks.

    >>> digest_of({"a": Fixed([1.0]), "b": 2}) == digest({"a": [1.0], "b": 2})
    True
    """

    def __init__(self, value: Any, where: str = "value") -> None:
        self.value = value
        self.text = _text(canonical(value, where))


def digest_of(parts: dict[str, Any], where: str = "value") -> str:
    """:func:`digest` of a dictionary, some of whose values are :class:`Fixed`."""
    texts = (
        f"{json.dumps(name)}:{part.text if isinstance(part, Fixed) else _text(canonical(part, f'{where}.{name}'))}"
        for name, part in sorted(parts.items())
    )
    return hashlib.sha256(f"{{{','.join(texts)}}}".encode()).hexdigest()


def _text(tree: Any) -> str:
    return json.dumps(tree, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
