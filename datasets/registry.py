"""Sequences by name or by folder."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datasets.files import Digests
from datasets.kitti import open_kitti, recognise
from datasets.mockup.params import SHORT, MockupParams
from datasets.mockup.sequence import mockup
from datasets.protocol import Sequence
from stages.errors import ConfigError, InputError

BUILT_IN: dict[str, tuple[str, Mapping[str, Any]]] = {
    "mockup": ("the paper's experiment, simulated: 40 pairs over a lunar bed at 1:10, with exact truth", {}),
    "mockup-short": ("the same in small: 9 pairs over a bed of 1.2 x 1.2 m", SHORT),
}

LAYOUTS = (
    ("FOLDER", "two image folders (image_0/1, image_2/3, image_l/r or left/right), calib.txt; poses.txt, times.txt"),
    ("ROOT:NN", "KITTI odometry: ROOT/sequences/NN and ROOT/poses/NN.txt"),
)


def catalogue() -> list[tuple[str, str]]:
    """Name and description of each built-in sequence and each folder layout."""
    return [(name, words) for name, (words, _) in BUILT_IN.items()] + list(LAYOUTS)


def open_sequence(
    name_or_path: str, overrides: Mapping[str, Mapping[str, Any]] | None = None, memory: Path | None = None
) -> Sequence:
    """A sequence by built-in name or by path.

    Parameters
    ----------
    name_or_path : built-in name, folder, or ``ROOT:NN``.
    overrides : parameters by section, e.g. ``{"mockup": {"seed": 3}}``; only the mockups have any.
    memory : file that keeps the digests of image files from run to run.

    Raises
    ------
    InputError
        There is no such name or folder, or what is in the folder cannot be used.
    ConfigError
        An override is unknown, not permitted, or of another kind of sequence.
    """
    sections = dict(overrides or {})
    if name_or_path in BUILT_IN:
        given = sections.pop("mockup", {})
        _none_left(sections, name_or_path)
        return mockup(mockup_params(BUILT_IN[name_or_path][1], given), name_or_path)
    _none_left(sections, name_or_path)
    path, number = _split(name_or_path)
    if not path.is_dir():
        raise InputError(f"no sequence {name_or_path!r}", remedy=_suggestion(name_or_path))
    layout = recognise(path, number)
    if layout is None:
        raise InputError(
            f"{name_or_path} has no layout that is recognised",
            remedy="; or ".join(f"{form}: {words}" for form, words in LAYOUTS),
        )
    return open_kitti(layout, Digests(memory))


def mockup_params(preset: Mapping[str, Any], given: Mapping[str, Any]) -> MockupParams:
    """Validated parameters of a mockup."""
    try:
        return MockupParams.model_validate({**preset, **given})
    except ValidationError as error:
        raise ConfigError("; ".join(_complaint(dict(e)) for e in error.errors()), remedy="") from error


def _complaint(error: dict[str, Any]) -> str:
    key = ".".join(str(part) for part in ("mockup", *error["loc"]))
    if error["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(error["loc"][0]), list(MockupParams.model_fields), n=1)
        hint = f"did you mean 'mockup.{near[0]}'?" if near else f"known: {', '.join(sorted(MockupParams.model_fields))}"
        return f"unknown key {key!r} (value {error['input']!r}): {hint}"
    return f"{key} = {error['input']!r} is not permitted: {error['msg'][0].lower()}{error['msg'][1:]}"


def _none_left(sections: Mapping[str, Any], name: str) -> None:
    if sections:
        raise ConfigError(f"[{next(iter(sections))}] does not belong to {name}", remedy="remove its keys")


def _split(name_or_path: str) -> tuple[Path, str | None]:
    """Folder, and the sequence's number where it is given as ROOT:NN."""
    path = Path(name_or_path).expanduser()
    root, colon, number = name_or_path.rpartition(":")
    if not path.exists() and colon and root:
        return Path(root).expanduser(), number
    return path, None


def _suggestion(name: str) -> str:
    near = difflib.get_close_matches(name, list(BUILT_IN), n=1, cutoff=0.5)
    known = f"known names: {', '.join(BUILT_IN)}; or give a folder"
    return f"did you mean {near[0]!r}? {known}" if near else known
