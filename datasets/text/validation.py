"""Validate the user's values by a model: pydantic's errors become one line with the dotted key and its neighbour."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from rille.stages.core.declare import Params
from rille.stages.core.errors import ConfigError, InputError, RilleError, did_you_mean, told

Model = TypeVar("Model", bound=Params)

TAG = "("
MEMBER = re.compile(r"[(\[]|literal\[|(constrained-)?(float|int|str)$|tuple\[")
"""Beginning of names that pydantic gives to members of a union, or to unnamed types, as if they were keys."""


def validated(
    code: str,
    kind: type[Model],
    values: Mapping[str, Any],
    *,
    section: str = "",
    file: str = "",
    remedy: str = "",
    also: Iterable[str] = (),
) -> Model:
    """``kind(**values)``, or an error of one line that names each wrong key.

    Parameters
    ----------
    code : of the error, ``RIL-223``.
    section : of the configuration, to which the keys belong.
    file : of the user with the values, if any.
    also : other sections, which a misspelt key may mean.

    Raises
    ------
    InputError, ConfigError
        A key is unknown or missing, or a value is not permitted, in a file or in a configuration.
    """
    section = section and f"{section}."
    try:
        return kind.model_validate(dict(values))
    except ValidationError as wrong:
        known = [section + key for key in known_keys(kind)] + list(also)
        what = told(wrong.errors(), lambda one: _complaint(one, section, known))
        error: type[RilleError] = InputError if file else ConfigError
        raise error(code, f"{file}: {what}" if file else what, remedy=remedy) from wrong


def _complaint(error: Mapping[str, Any], section: str, known: list[str]) -> str:
    """One of pydantic's errors as dotted key, value and reason."""
    first, *parts = map(str, error["loc"] or [""])
    key = section + ".".join([first, *(part for part in parts if not MEMBER.match(part))])
    if error["type"] == "extra_forbidden":
        return f"unknown key {key!r} (value {error['input']!r:.200}): {_nearest(key, error['input'], known)}"
    if error["type"] == "missing":
        return f"{key} is missing"
    reason = str(error.get("ctx", {}).get("error", error["msg"])).replace("valid tuple", "list")
    value = "" if isinstance(error["input"], dict) else f" = {error['input']!r:.200} is not permitted"
    return f"{key}{value}: {reason[0].lower() + reason[1:]}" if key else reason


def _nearest(key: str, value: object, known: list[str]) -> str:
    """The key that may have been meant: of the same name in another table, or of the same table."""
    table, dot, last = key.rpartition(".")
    if isinstance(value, Mapping) and value and last == table:
        return f"did you mean {table}.{next(iter(value))}?"
    beside = [k.rpartition(".")[2] for k in known if k.rpartition(".")[0] == table]
    # A table can only mean a table: stages and keys may share names, as track of a stage and of a vehicle.
    others = () if isinstance(value, Mapping) else {k.rpartition(".")[0] for k in known}
    elsewhere = [k for k in known if k.rpartition(".")[2] == last and k not in others]
    here = f"known here are {', '.join(sorted(beside))}"
    if not elsewhere:
        return did_you_mean(last, beside, table + dot) or here
    # A key of another table may be no more than a namesake.
    return did_you_mean(elsewhere[0], elsewhere) + (f" {here}" if table and beside else "")


def known_keys(kind: type[Params], prefix: str = "") -> Iterable[str]:
    """All dotted keys of a model, tables included."""
    for name, field in kind.model_fields.items():
        yield prefix + name
        for table in tables(field.annotation):
            yield from known_keys(table, f"{prefix}{name}.")


def tables(annotation: Any) -> Iterable[type[Params]]:
    """The models that a field's annotation allows."""
    if isinstance(annotation, type):
        return [annotation] if issubclass(annotation, Params) else []
    return dict.fromkeys(table for part in getattr(annotation, "__args__", ()) for table in tables(part))
