"""Sequences by name, by folder or by manifest."""

from __future__ import annotations

import os
import pkgutil
import site
import sysconfig
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from types import ModuleType
from typing import Any

from rille.datasets.bags import is_bag
from rille.datasets.images.files import Digests
from rille.datasets.images.kinds import hints
from rille.datasets.images.masks import masked
from rille.datasets.images.misalign import MisalignParams, misalign
from rille.datasets.images.samples import examined
from rille.datasets.manifest.opening import open_manifest
from rille.datasets.mockup.params import SHORT, MockupParams, SetupParams
from rille.datasets.mockup.rover import RoverParams
from rille.datasets.mockup.sequence import LOOP, mockup, mockup_loop
from rille.datasets.protocol import Sequence
from rille.datasets.text.names import shell_word
from rille.datasets.text.reading import WILD, Search, missing_target
from rille.datasets.text.sides import of_one_camera
from rille.datasets.text.validation import Model, validated
from rille.stages.core.errors import ConfigError, InputError, RilleError, did_you_mean

BUILT_IN: dict[str, tuple[str, Mapping[str, Any]]] = {
    "mockup": ("the paper's experiment, simulated: 40 pairs over a lunar bed at 1:10, with exact truth", {}),
    "mockup-short": ("the same in small: 9 pairs over a bed of 1.2 x 1.2 m", SHORT),
    "mockup-loop": ("a simulated rover that drives to a goal over such a bed: stop, think, drive, again", LOOP),
}

MANIFESTS: dict[str, str] = {
    "devon_island": "10 pairs of a rover in a Mars-like desert, colour; its files lie in ${RILLE_DATA}/devon_island",
    "nasa_k10": "one pair of NASA's K10 rover, raw and not rectified; its files lie in ${RILLE_DATA}/nasa_k10",
}
"""Descriptions of the manifests in the folder beside this module."""

MANIFEST_FORMS = (
    ("FILE.toml", "a manifest of any folder of stereo images; `rille init FOLDER` writes one"),
    ("FOLDER", "with a manifest (NAME.rille.toml or manifest.toml) in it"),
)


@cache
def layouts() -> tuple[ModuleType, ...]:
    """Modules that open folders or files of a certain layout: those beside this one, then those of installed packages.

    Each has ``FORMS``, what a user may give and in words what that is, and ``open_layout(path, number, digests)``,
    which gives None where the folder is none of its own; ``number`` chooses one of several (``FOLDER:NUMBER``).
    """
    # By listing, so that a new layout is one new file; sorted by name, for the same order everywhere.
    names = [found.name for found in pkgutil.iter_modules([str(Path(__file__).parent)]) if not found.ispkg]
    modules = [import_module(f"rille.datasets.{name}") for name in sorted(names)]
    return (*(module for module in modules if hasattr(module, "open_layout")), *_installed())


def _installed() -> list[ModuleType]:
    """Modules of the entry points of packages that are installed for this Python, by name."""
    # Only in the folders of installed packages, since `sys.path` may begin with the current folder.
    folders = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    if site.ENABLE_USER_SITE:
        folders.append(site.getusersitepackages())
    distributions = metadata.distributions(path=list(dict.fromkeys(folders)))
    # "rille.formats": entry points by which installed packages add layouts.
    points = (point for one in distributions for point in one.entry_points.select(group="rille.formats"))
    return [point.load() for point in sorted(points, key=lambda point: (point.name, point.value))]


def catalogue() -> list[tuple[str, str]]:
    """Name and description of each built-in sequence and each form that a path may have."""
    simulated = [(name, words) for name, (words, _) in BUILT_IN.items()]
    return [*simulated, *MANIFESTS.items(), *MANIFEST_FORMS, *(form for one in layouts() for form in one.FORMS)]


def open_sequence(
    name_or_path: str,
    overrides: Mapping[str, Mapping[str, Any]] | None = None,
    digests: Digests | None = None,
) -> Sequence:
    """A sequence by built-in name or by path.

    Parameters
    ----------
    name_or_path : built-in name, manifest, folder, or ``ROOT:NN``.
    overrides : parameters by section: ``{"mockup": {"seed": 3}}`` for the mockups, ``{"misalign": {"rows": 3}}`` for
        any sequence.
    digests : remembers those of image files, perhaps from run to run; or knows the files of a sequence whose images are
        still arriving.

    Raises
    ------
    InputError
        There is no such name or folder, or the folder's files cannot be used.
    ConfigError
        An override is unknown, not permitted, or of another kind of sequence.
    """
    _refuse_missing(name_or_path)  # before its parameters are judged
    sections = dict(overrides or {})
    preset = BUILT_IN.get(name_or_path, ("", {}))[1]

    def section(name: str, kind: type[Model], **preset: Any) -> Model:
        return validated("RIL-280", kind, {**preset, **sections.pop(name, {})}, section=name)

    if name_or_path == "mockup-loop":
        bed, rover = section("mockup", SetupParams, **preset), section("rover", RoverParams)
        _none_left(sections, name_or_path)
        return replace(mockup_loop(bed, rover, name_or_path), opened=(name_or_path,))
    knocked = section("misalign", MisalignParams)
    simulated = section("mockup", MockupParams, **preset) if name_or_path in BUILT_IN else None
    _none_left(sections, name_or_path)
    found = mockup(simulated, name_or_path) if simulated is not None else _opened(name_or_path, digests or Digests())
    return replace(misalign(found, knocked), opened=(name_or_path,))


def _opened(name_or_path: str, digests: Digests) -> Sequence:
    sequence = masked(examined(_of_files(name_or_path, digests)), digests)
    # Each warning names the sequence, or a file of it.
    places = name_or_path, str(Path(name_or_path).resolve().parent)
    said = (line.split(": ", 1) for line in sequence.warnings)
    lines = (": ".join([code, *([] if text.startswith(places) else [name_or_path]), text]) for code, text in said)
    return replace(sequence, warnings=tuple(lines))


def _of_files(name_or_path: str, digests: Digests) -> Sequence:
    if name_or_path in MANIFESTS:
        return open_manifest(Path(__file__).parent / "manifests" / f"{name_or_path}.toml", digests)
    _refuse_missing(name_or_path)
    path, number = _split(name_or_path)
    if path.is_file() and path.suffix.lower() == ".toml":
        return open_manifest(path, digests)
    # The user's manifest overrides the layout.
    manifest = folder_manifest(path) if number is None and path.is_dir() else None
    if manifest is not None:
        return open_manifest(manifest, digests)
    for module in layouts():
        sequence: Sequence | None = module.open_layout(path, number, digests)
        if sequence is not None:
            return sequence
    if path.is_file():
        remedy = "give the folder, of a ROS 2 bag too, or a manifest (.toml); `rille init FOLDER` writes one"
        remedy = "; ".join([*hints(name_or_path), remedy])
        raise InputError("RIL-992", f"the file {name_or_path} is no sequence", remedy=remedy)
    beside = Path(f"{path}.rille.toml")
    remedy = f"{of_one_camera(path)}`rille init {shell_word(name_or_path)}` writes a manifest; "
    remedy += "`rille datasets list` names what opens without one"
    if beside.is_file():
        remedy = f"give its manifest, {beside}"
    elif bags := [entry.path for entry in Search().entries(path) if is_bag(Path(entry.path))]:
        remedy = f"give a bag in it, e.g. {bags[0]}"
    elif (path / "report.json").is_file():
        remedy = "it is a run, not a sequence: `rille view` shows it, and rille.open_run reads it"
    raise InputError("RIL-277", f"{name_or_path} has no layout that is recognised", remedy=remedy)


def is_there(name_or_path: str) -> bool:
    """Whether a sequence has this name, or a file or a folder has it."""
    # os.path, because pathlib raises for impossible names.
    path = _split(name_or_path)[0]
    known = name_or_path in BUILT_IN or name_or_path in MANIFESTS
    return known or bool(name_or_path and (os.path.isfile(path) or os.path.isdir(path)))


def _refuse_missing(name_or_path: str) -> None:
    """Refuse a name that is none of a sequence, file or folder.

    Raises
    ------
    InputError
        Nothing has this name.
    """
    if not is_there(name_or_path):
        path, known = _split(name_or_path)[0], [*BUILT_IN, *MANIFESTS]
        form = "remove its quotes" if WILD.search(name_or_path) else "give a folder or a manifest"
        meant = did_you_mean(name_or_path, known) or f"{form}, or"
        remedy = missing_target(path) or f"{meant} known names: {', '.join(known)}"
        kind = "file" if path.suffix else "sequence"
        raise InputError("RIL-276", f"no {kind} {name_or_path!r:.200}", remedy=remedy)


def hindrance(place: Path) -> RilleError | None:
    """The error by which a folder or a manifest does not open; None if it opens."""
    try:
        _opened(str(place), Digests())
    except RilleError as error:
        return error
    return None


def folder_manifest(folder: Path) -> Path | None:
    """The one manifest in a folder, or None.

    Raises
    ------
    InputError
        There are several.
    """
    # None of the hidden ones that macOS adds to archives.
    found = sorted(folder.glob("[!.]*.rille.toml")) or [p for p in (folder / "manifest.toml",) if p.is_file()]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        text = f"{folder} holds {len(found)} manifests: {names}"
        raise InputError("RIL-279", text, remedy=f"choose one, e.g. {found[0]}")
    return found[0] if found else None


def _none_left(sections: Mapping[str, Any], name: str) -> None:
    if sections:
        raise ConfigError("RIL-281", f"[{next(iter(sections))}] does not belong to {name}", remedy="remove its keys")


def _split(name_or_path: str) -> tuple[Path, str | None]:
    """Folder, and the sequence's number if given as ROOT:NN."""
    # Not pathlib's, which raises if there is no such user.
    path = Path(os.path.expanduser(name_or_path))
    root, colon, number = name_or_path.rpartition(":")
    # An existing path may have a colon in its name.
    if not os.path.exists(path) and colon and root:
        return Path(os.path.expanduser(root)), number
    return path, None
