"""Calibration files as nested entries: YAML with OpenCV's header and matrices, OpenCV's XML, and JSON."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from stages.errors import InputError

LARGEST = 4_000_000
"""Bytes; calibration files have kilobytes, so that anything larger is something else."""

HEADER = re.compile(r"\A%YAML:[0-9.]+[^\n]*\n(\s*---[^\n]*\n)?")
"""OpenCV's first lines, which no YAML parser accepts."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML as OpenCV writes it: a matrix is a mapping with rows, cols and data."""


def _mapping(loader: Any, node: Any) -> Any:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _mapping)
_Loader.add_constructor("!opencv-matrix", _mapping)


def read_text(path: Path) -> str:
    """The text of a file.

    Raises
    ------
    InputError
        It cannot be read, is too large for a calibration, or is no text.
    """
    try:
        data = path.read_bytes() if path.stat().st_size <= LARGEST else None
    except OSError as error:
        raise InputError(
            "RIL-138", f"{path} cannot be read: {error.strerror}", remedy="check the path and its rights"
        ) from error
    if data is None:
        raise InputError("RIL-139", f"{path} is too large for a calibration file", remedy="give the calibration file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("RIL-140", f"{path} is no text file", remedy="give the calibration file") from error


def parse_yaml(text: str, file: str) -> Mapping[Any, Any]:
    """Entries of a YAML or JSON file; empty where it holds something else than entries."""
    try:
        found = yaml.load(HEADER.sub("", text, count=1), Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" (line {mark.line + 1})" if mark is not None else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise InputError("RIL-141", f"{file} cannot be parsed{where}: {problem}", remedy="correct the file") from error
    return found if isinstance(found, Mapping) else {}


def parse_xml(text: str, file: str) -> Mapping[str, Any]:
    """Entries of OpenCV's XML storage; empty where it is another XML file.

    Raises
    ------
    InputError
        The file is not well formed, or declares entities (which expand without bound, and no calibration needs).
    """
    if "<!ENTITY" in text:
        raise InputError(
            "RIL-142", f"{file} declares XML entities", remedy="give the calibration file as OpenCV writes it"
        )
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError("RIL-143", f"{file} cannot be parsed: {error}", remedy="correct the file") from error
    return {child.tag: _node(child) for child in root} if root.tag == "opencv_storage" else {}


def _node(node: ElementTree.Element) -> Any:
    if len(node):
        values = {child.tag: _node(child) for child in node}
        if node.get("type_id") == "opencv-matrix" and isinstance(values.get("data"), str):
            values["data"] = values["data"].split()
            values |= {key: int(values[key]) for key in ("rows", "cols") if str(values.get(key, "")).isdigit()}
        return values
    return (node.text or "").strip() or None
