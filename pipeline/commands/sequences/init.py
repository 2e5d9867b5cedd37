"""``rille init``: a commented manifest of what a folder of stereo images holds, and the commands that come next."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from rille.datasets.bags import is_bag
from rille.datasets.inspection.folder import Findings, inspect
from rille.datasets.manifest.model import VEHICLE_FILE
from rille.datasets.manifest.text import manifest_text, needs, pair_words, size_words
from rille.datasets.registry import folder_manifest, hindrance
from rille.datasets.text.names import derived_name, shell_word, writable
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.runs.options import FLAG, Output, check_new, check_output
from rille.stages.core.errors import ConfigError, InputError


def init(
    directory: Path,
    *,
    output: Annotated[Path | None, Output] = None,
    force: Annotated[bool, FLAG] = False,
) -> None:
    """Write a commented manifest of a folder of stereo images: what was found, and what is still needed.

    Parameters
    ----------
    directory
        Folder with the images, and with whatever is known of the cameras.
    output
        Manifest to write; by default DIRECTORY's name with .rille.toml, in the present folder.
    force
        Replace a manifest that is there.
    """
    hindered = hindrance(directory.absolute())  # absolute: not a built-in sequence of this name
    if output is None and not force and (directory.is_dir() or is_bag(directory)) and hindered is None:
        bag = is_bag(directory)
        manifest = "" if bag else f"{_left_out(directory)}; --output or --force writes a manifest nevertheless"
        print(f"{directory} opens as it is{manifest}")
        print("\n".join(_next(directory)))
        return
    if is_bag(directory):
        text = f"no manifest is written for the bag {directory}: it opens as it is"
        raise hindered or ConfigError("RIL-938", text, remedy="rille check opens it")
    findings = inspect(directory)
    path = output or Path(f"{derived_name(directory.resolve().name)}.rille.toml")
    check_output(path, ".toml")
    if not force:
        check_new(path, remedy="give another --output, or overwrite it by --force")
    # Written even if incomplete, with comments in the place of missing keys.
    text = manifest_text(findings, _root(directory, path))
    atomic.write(path, text)
    needed = needs(text)
    left = hindrance(path) if not needed else None
    if left is not None:
        needed = [str(left)]
    elif hindered is not None:
        print(f"{directory} does not open as it is: {hindered.message}")
    print("\n".join(_report(findings, path, needed)))


def _left_out(directory: Path) -> str:
    """Masks of a folder that opens by its layout, which knows of none, in words; empty if there are none."""
    with suppress(InputError):
        masks = {} if folder_manifest(directory) else inspect(directory).masks
        return f", without {' and '.join(masks.values())}" if masks else ""
    return ""


def _root(directory: Path, path: Path) -> str:
    """The folder as seen from the manifest: relative if the manifest lies in or beside it."""
    relative = os.path.relpath(directory.resolve(), path.resolve().parent)
    # Two folders up or more a relative path breaks as soon as either is moved.
    far = relative.startswith(os.path.join("..", ".."))
    root = str(directory.resolve()) if far else Path(relative).as_posix()
    writable(" ".join(root.splitlines()))  # TOML can hold line breaks
    return root


def _report(findings: Findings, path: Path, needed: list[str]) -> list[str]:
    """Lines on findings, missing keys, and the next commands."""
    views, calibration = findings.views, findings.calibration
    size = f", {size_words(views.sizes)} pixels" if views.sizes else ""
    lines = [f"images       {pair_words(views)}{size}: {views.left} and {views.right}"]
    lines += [f"pairs        {line}" for line in views.lines]
    if calibration is not None:
        baseline = f", baseline {calibration.baseline:.6g}" if calibration.baseline is not None else ""
        two = f", {' and '.join(calibration.names)} of {', '.join(calibration.among)}" if calibration.names else ""
        lines.append(f"calibration  {' and '.join(calibration.files)}{two}{baseline}")
    tables = {**findings.tables, **({"masks": findings.masks.values()} if findings.masks else {})}
    tables |= {"vehicle": [VEHICLE_FILE]} if findings.vehicle else {}
    lines += [f"{kind:12s} {', '.join(files)}" for kind, files in tables.items()]
    lines += [f"not read     {line}" for line in findings.unread]
    lines += [f"wrote        {path}"]
    lines += [f"needed       {line}" for line in needed]
    return lines + _next(path, edit=bool(needed))


def _next(path: Path, *, edit: bool = False) -> list[str]:
    """The next commands, for a shell."""
    word = shell_word(path)
    steps = [*([f"edit {word}"] if edit else []), f"rille check {word}", f"rille reconstruct {word}"]
    return ["", "next:", *(f"  {step}" for step in steps)]
