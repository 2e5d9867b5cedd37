"""Inspect a folder of stereo images: find pairs, calibration, times and poses by file names and content.

The manifest shows all findings: each entry has its reason beside it, and each missing entry is a comment that says what
to fill in. A manifest with missing entries cannot be opened; the error names the first of them.
"""

from __future__ import annotations

import re
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from rille.datasets.cameras import KNOWN
from rille.datasets.images.files import SUFFIXES
from rille.datasets.images.headers import located
from rille.datasets.images.kinds import hints, line, unread
from rille.datasets.inspection.calibration import CALIBRATIONS, FoundCalibration, find_calibration
from rille.datasets.inspection.patterns import relative
from rille.datasets.inspection.tables import CAMERA_WORDS, TABLES, table_kind
from rille.datasets.inspection.views import COMPUTED, DEPTH, FoundImages, find_views
from rille.datasets.manifest.model import VEHICLE_FILE, stated_vehicle
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.names import UNWRITABLE, shell_word, writable
from rille.datasets.text.order import natural
from rille.datasets.text.reading import Search, is_file, read_text, read_toml
from rille.datasets.text.sides import side_of
from rille.stages.core.errors import InputError
from rille.stages.core.quantities import count
from rille.stages.hazard.vehicle import Vehicle

MOST_TEXTS = 200
"""Text files that are tried as calibration and as table; some data sets have one for each image."""

PROSE = re.compile(r"read.?me|licen[cs]e|copying|changes", re.I)
"""At the beginning of the names of texts that are for people."""

MASK = re.compile(r"(?<![a-z])masks?(?![a-z])(?!.*\.look$)", re.I)
"""In the names of masks of a camera; not in those of the pictures that `rille mask` writes beside them."""


@dataclass
class Findings:
    """Findings in a folder; paths are relative to it."""

    folder: Path
    views: FoundImages
    calibration: FoundCalibration | None = None
    others: list[str] = field(default_factory=list)
    masks: dict[str, str] = field(default_factory=dict)
    tables: dict[str, list[str]] = field(default_factory=dict)
    vehicle: Vehicle | None = None
    unread: list[str] = field(default_factory=list)


def inspect(folder: Path) -> Findings:
    """Find image pairs, calibration files and tables (times, poses, IMU ...) in a folder and its subfolders.

    Subfolders are searched :data:`DEPTH` levels deep, and at most :data:`MOST_TEXTS` text files are read.

    Raises
    ------
    InputError
        ``folder`` is not a folder, its images cannot be divided into those of a left and a right camera, or the name of
        a file cannot be written in a manifest.
    """
    if not folder.is_dir():
        remedy = "; ".join([*hints(str(folder)), "name a folder that holds images of two cameras"])
        raise InputError("RIL-193", f"{folder} is no folder", remedy=remedy)
    search = Search()
    there = {path: relative(path, folder) for path in _files(folder, search)}
    images, texts = ([p for p in there if p.suffix.lower() in of] for of in (SUFFIXES, (*CALIBRATIONS, *TABLES)))
    known = {*images, *texts}
    for path in (p for p in there if p in known):
        writable(there[path])
    others = [name for path, name in there.items() if path not in known and not COMPUTED.search(name)]
    strange = [UNWRITABLE.sub("?", name) for name in others]
    masks = _masks(folder, images)
    try:
        photographs = [path for path in images if there[path].replace(".look.", ".") not in masks.values()]
        found = Findings(folder, find_views(folder, photographs), masks=masks)
    except InputError as error:
        text, lines = "; ".join([error.message, *search.closed[:1]]), unread(strange)
        if any(map(hints, strange)) and not images:
            raise InputError(error.code, text, remedy="; ".join(lines)) from error
        raise InputError(error.code, "; ".join([text, *lines]), remedy=error.remedy) from error
    found.unread += search.closed
    try:
        found.vehicle = stated_vehicle(folder)
    except InputError as error:
        found.unread.append(str(error))
    found.unread += [*found.views.others, *_places_in_images(found.views.left, folder, search)]
    # Each is tried as a calibration and as a table; thousands of them (one for each image) would take minutes.
    if len(texts) > MOST_TEXTS:
        found.unread.append(f"of {len(texts)} text files only the first {MOST_TEXTS} were looked at")
        texts = texts[:MOST_TEXTS]
    tried = [p for p in texts if p.suffix.lower() in CALIBRATIONS]
    found.calibration, found.others, lines = find_calibration(folder, tried, found.views)
    found.unread += lines
    used = {*found.others, *(found.calibration.files if found.calibration else ())}
    used |= {name.replace("intrinsic", "extrinsic") for name in used}  # OpenCV's pair of files
    for path in texts:
        if path.suffix.lower() not in TABLES or there[path] in used or any(str(path) in line for line in found.unread):
            continue
        try:
            kind = table_kind(path, found.views.pairs)
        except InputError as error:
            found.unread += [] if str(error) in found.unread else [str(error)]
            continue
        if kind:
            found.tables.setdefault(kind, []).append(there[path])
            used.add(there[path])
    told = " ".join(found.unread)
    unread_texts = (p for p in texts if there[p] not in used and not PROSE.match(p.name))
    unknown = [there[p] for p in unread_texts if str(p) not in told]
    cameras = [name for name in unknown if _of_cameras(folder / name)]
    found.unread += [line("calibration", cameras, KNOWN)] if cameras else []
    found.unread += unread([name for name in unknown if name not in cameras] + strange)
    return found


def _masks(folder: Path, images: list[Path]) -> dict[str, str]:
    """The one mask of each camera, by side; empty where there are several, as one of each image, or nothing else."""
    of_side: dict[str, list[str]] = defaultdict(list)
    for name in (relative(path, folder) for path in images):
        if MASK.search(name.rpartition(".")[0]) and (at := side_of(name.rpartition(".")[0])) is not None:
            of_side[CAMERAS[at[1]]].append(name)
    one = all(len(names) == 1 for names in of_side.values()) and len(of_side) < len(images)
    return {side: names[0] for side, names in of_side.items()} if one else {}


def _places_in_images(left: str, folder: Path, search: Search) -> list[str]:
    """A line on places in EXIF of left images, and how they become a table; empty if there are none."""
    sample = search.matching(folder, left)[:MOST_TEXTS]
    places = sum(map(located, sample))
    export = f"exiftool -csv -n -GPSLatitude -GPSLongitude -GPSAltitude {shell_word(Path(left).parent)} > gps.csv"
    text = f"places in EXIF of {places} of {count(len(sample), 'left image')}: `{export}`, and [positions] of that file"
    return [text] if places else []


def _of_cameras(path: Path) -> bool:
    """Whether a text of no known form seems to describe cameras, by its name or by a word in it."""
    with suppress(InputError):
        text = path.stem if path.suffix.lower() not in CALIBRATIONS else path.stem + read_text(path, "file")
        return CAMERA_WORDS.search(text) is not None
    return False


def _files(folder: Path, search: Search) -> list[Path]:
    """Files below a folder in natural order, without hidden ones, and without Rille's manifests and runs."""
    found = list(search.below(folder, DEPTH, links=True))
    # A run (with a ledger) holds no data: its trajectory would become the truth.
    runs = {place for place, entries in found if any(e.name == "ledger.jsonl" for e in entries)}
    paths = (Path(e.path) for place, entries in found if runs.isdisjoint((place, *place.parents)) for e in entries)
    return sorted(filter(_is_data, paths), key=lambda path: natural(str(path)))


def _is_data(path: Path) -> bool:
    """Whether a path is a file, and neither a manifest of any name nor what states the vehicle."""
    with suppress(InputError):
        if path.name == VEHICLE_FILE or (path.suffix == ".toml" and "images" in read_toml(path, "manifest")):
            return False
    return is_file(path)
