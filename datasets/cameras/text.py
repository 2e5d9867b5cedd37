"""Parse the text of calibration files into nested entries: YAML (also OpenCV's), JSON, OpenCV's XML, ``key = value``.

Values stay text, or None where the file gives none; :mod:`rille.datasets.cameras.fields` converts them.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any
from xml.etree import ElementTree

import yaml

from rille.datasets.text.reading import DEEPEST
from rille.stages.core.errors import InputError

MOST_VALUES = 100_000
"""Most values of a YAML file; a stereo calibration has a hundred, with corners of all views some ten thousand."""

HEADER = re.compile(r"\A%YAML:[0-9.]+[^\n]*\n(\s*---[^\n]*\n)?")
"""OpenCV's first lines, which no YAML parser accepts."""

END = re.compile(r"^---[ \t]*$", re.MULTILINE)
"""Line that ROS prints after each message; in YAML it begins a second document."""

STAMPED = re.compile(r"\A\s*header:[ \t]*\n([ \t]+.*\n)*")
"""The header, which differs between messages of a topic."""

TOML = re.compile(r"\s*([#;].*\s+)*(\[[\w. /-]+\][ \t]*$|[\w.-]+[ \t]*=)", re.MULTILINE)
"""Beginning of a file of TOML, or of one with the ending .ini."""

TWICE = "{} stands there twice, with two values"

C_OR_PYTHON: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


class _Loader(C_OR_PYTHON):  # type: ignore[misc]
    """YAML whose values stay text, as in XML: the parser interprets no tag, date, merge key or number."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Mapping[Any, Any]:
        """Entries; no key may have two values."""
        found: Mapping[Any, Any] = super().construct_mapping(node, deep=True)
        for key, value in node.value:
            if self.construct_object(value, deep=True) != found[self.construct_object(key, deep=True)]:
                raise yaml.constructor.ConstructorError(None, None, TWICE.format(key.value), key.start_mark)
        return found

    def construct_scalar(self, node: Any) -> Any:
        """Text, or None for null."""
        text = super().construct_scalar(node)
        return None if text in ("", "~", "null") else text


def entries(pairs: Iterable[tuple[str, Any]], file: str) -> dict[str, Any]:
    """Entries by key.

    Raises
    ------
    InputError
        A key has two values.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if found.setdefault(key, value) != value:
            raise InputError("RIL-126", f"{file}: {TWICE.format(key)}", remedy="keep the one that was calibrated")
    return found


def assignments(text: str) -> list[tuple[str, str]]:
    """Lines ``key = value``, stripped; a line of another form has the key "" and is its own value."""
    found = []
    for line in text.splitlines():
        key, equals, value = (part.strip() for part in line.partition("="))
        found.append((key, value) if equals and key.isidentifier() else ("", line.strip()))
    return found


def parse_nested(text: str, file: str) -> Mapping[Any, Any]:
    """Entries of XML, TOML, YAML or JSON, whichever it is (see :func:`parse_xml` and :func:`parse_yaml`)."""
    if TOML.match(text):
        with suppress(tomllib.TOMLDecodeError, RecursionError):
            return tomllib.loads(text)
        return {}  # not even YAML
    return parse_xml(text, file) if text.lstrip().startswith("<") else parse_yaml(text, file)


def parse_yaml(text: str, file: str) -> Mapping[Any, Any]:
    """Entries of a YAML or JSON file; empty if it has none."""
    body = _first(HEADER.sub("", text, count=1))
    try:
        # Events are cheap, and show nesting and aliases before anything is built.
        _check_extent(body, file)
        found = yaml.load(body, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" (line {mark.line + 1})" if mark is not None else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError("RIL-141", f"{file} cannot be parsed{where}: {problem}", remedy="correct the file") from error
    return found if isinstance(found, Mapping) else {}


def _first(text: str) -> str:
    """The first of several equal messages; the last one may be incomplete."""
    messages = [part for part in END.split(text) if part.strip()]
    stated = [STAMPED.sub("", message).strip() for message in messages]
    same = all(stated[0].startswith(others) for others in stated[1:])
    return text[: text.index(messages[0]) + len(messages[0])] if messages and same else text


def _check_extent(text: str, file: str) -> None:
    """Refuse a small text with a huge number of entries, before any is made."""
    depth = values = 0
    for event in yaml.parse(text, Loader=_Loader):
        # Ten lists of ten aliases, each to the list before, make 10^10 values of a few hundred bytes.
        if isinstance(event, yaml.AliasEvent):
            where = f"{file}, line {event.start_mark.line + 1}"
            raise InputError("RIL-758", f"{where}: the alias *{event.anchor}", remedy="write the values out")
        values += isinstance(event, yaml.ScalarEvent)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST or values > MOST_VALUES:
            large = f"{file} has more than {DEEPEST} levels or {MOST_VALUES} values"
            raise InputError("RIL-759", large, remedy="give the calibration file")


def parse_xml(text: str, file: str) -> Mapping[str, Any]:
    """Entries of OpenCV's XML storage; empty for other XML files.

    Raises
    ------
    InputError
        The file is not well formed, or declares entities (which may expand without bound).
    """
    if "<!ENTITY" in text:
        remedy = "give the calibration file as OpenCV writes it"
        raise InputError("RIL-142", f"{file} declares XML entities", remedy=remedy)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError("RIL-143", f"{file} cannot be parsed: {error}", remedy="correct the file") from error
    if root.tag != "opencv_storage":
        return {}
    return entries(((child.tag, _node(child, file)) for child in root), file)


def _node(node: ElementTree.Element, file: str, depth: int = 2) -> Any:
    if depth > DEEPEST:
        raise InputError("RIL-756", f"{file} is nested more than {DEEPEST} levels deep", remedy="correct the file")
    if len(node):
        # Items of a list have one tag.
        values = entries(((child.tag, _node(child, file, depth + 1)) for child in node if child.tag != "_"), file)
        if node.get("type_id") == "opencv-matrix" and isinstance(values.get("data"), str):
            values["data"] = values["data"].split()
        return values
    return (node.text or "").strip() or None
