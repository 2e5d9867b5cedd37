"""Inspect a folder of stereo images: find pairs, calibration, times and poses by file names and content.

The manifest shows all findings: each entry has its reason beside it, and each missing entry is a comment that says what
to fill in. A manifest with missing entries cannot be opened; the error names the first of them.
"""

from __future__ import annotations

import glob
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np

from rille.datasets.cameras import KNOWN, CalibratedCamera, read_cameras
from rille.datasets.cameras.model import of_size, relative_pose
from rille.datasets.images import pairing
from rille.datasets.images.files import SUFFIXES, common_header
from rille.datasets.images.headers import located, sizes_of
from rille.datasets.images.kinds import hints, line, split, unread
from rille.datasets.images.pairing import UNWRITABLE, ImagePair, natural, of_one_camera, side_of, writable
from rille.datasets.imu import names_sensors
from rille.datasets.poses import of_images, of_poses, positions_of
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.columns import QUATERNION, matrix_at, meanings, of_photographs, untimed
from rille.datasets.text.names import shell_word
from rille.datasets.text.reading import Search, is_file, read_text, read_toml
from rille.datasets.text.tables import ROWS, read_table
from rille.stages.core.errors import InputError, RilleError
from rille.stages.core.quantities import count
from rille.stages.geometry.geometry import RigidTransform, Sizes

DEPTH = 4
"""Levels of folders that are searched; deeper ones are other data sets."""

CALIBRATIONS = (
    *(".yaml", ".yml", ".xml", ".txt", ".toml", ".ini", ".cfg", ".conf", ".json"),
    *(".tsai", ".cameramodel", ".lbl", ".cahv", ".cahvor", ".cahvore"),
)
TABLES = (".txt", ".csv", ".tum", ".dat", ".pos")
ODOMETRY, TRUTH = re.compile("odom|wheel|encoder", re.I), re.compile("truth|(?<![a-z])gt(?![a-z])", re.I)
"""In the names of tables of dead reckoning, and of the truth."""

MOST_TEXTS = 200
"""Text files that are tried as calibration and as table; some data sets have one for each image."""

COMPUTED = re.compile(
    r"(?<![a-z])(depth|disp|seg|mask|valid|flow|label|conf|normal|occl|semantic|instance|dem(?![a-z]))", re.I
)
"""In the names of images and arrays that are no photographs, as beside those of simulators."""

PROSE = re.compile(r"read.?me|licen[cs]e|copying|changes", re.I)
"""At the beginning of the names of texts that are for people."""

MASK = re.compile(r"(?<![a-z])masks?(?![a-z])(?!.*\.look$)", re.I)
"""In the names of masks of a camera; not in those of the pictures that `rille mask` writes beside them."""

CAMERA_WORDS = re.compile(
    r"calib|intrinsic|focal|baseline|distortion|fov|camera_?matrix|lensmodel|\bf[xyl](_[xy])?\b", re.I
)
"""In the name or the text of a file that seems to describe cameras."""


@dataclass(frozen=True)
class FoundImages:
    """The left and right images that were found.

    Attributes
    ----------
    left, right : patterns relative to the folder.
    pairs : number of pairs.
    sizes : of the left and of the right images, if all of a side have the same.
    why : how left and right were recognised.
    trouble : why the images cannot be paired; empty: they can.
    stamped : whether the left images' names are times, since 1970 or as date and time of day.
    sides : the words or letters in the names that mark left and right.
    absent : missing files of pairs, which are counted in ``pairs``.
    lines : on the pairing by time stamps in the names, if these differ.
    others : lines on images that are of another set of pairs, or of none.
    """

    left: str
    right: str
    pairs: int
    sizes: Sizes | None
    why: str
    trouble: str = ""
    stamped: bool = False
    sides: tuple[str, str] = ("left", "right")
    absent: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class FoundCalibration:
    """Suitable calibration files: one for both cameras or one each, relative to the folder.

    ``names``: of the two cameras, if the file has more. ``mount``: T_reference_left, if the reference frame of the
    files is not the left camera's, but mostly that of the body or of the IMU.
    """

    files: tuple[str, ...]
    sizes: tuple[tuple[int, int] | None, tuple[int, int] | None]
    baseline: float | None
    cameras: int
    names: tuple[str, str] | None = None
    mount: RigidTransform | None = None

    def suits(self, sizes: Sizes | None) -> bool:
        """Whether it fits images of these sizes, as far as both are known."""
        return sizes is None or all(own in (None, size) for own, size in zip(self.sizes, sizes, strict=True))


@dataclass
class Findings:
    """Findings in a folder; paths are relative to it."""

    folder: Path
    views: FoundImages
    calibration: FoundCalibration | None = None
    others: list[str] = field(default_factory=list)
    masks: dict[str, str] = field(default_factory=dict)
    tables: dict[str, list[str]] = field(default_factory=dict)
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
    there = {path: _relative(path, folder) for path in _files(folder, search)}
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
    found.unread += [*found.views.others, *_places_in_images(found.views.left, folder, search)]
    # Each is tried as a calibration and as a table; thousands of them (one for each image) would take minutes.
    if len(texts) > MOST_TEXTS:
        found.unread.append(f"of {len(texts)} text files only the first {MOST_TEXTS} were looked at")
        texts = texts[:MOST_TEXTS]
    find_calibration(found, [p for p in texts if p.suffix.lower() in CALIBRATIONS])
    used = set(found.calibration.files if found.calibration else ()) | set(found.others)
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
    for name in (_relative(path, folder) for path in images):
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
    """Whether a path is a file, and no manifest of any name."""
    with suppress(InputError):
        if path.suffix == ".toml" and "images" in read_toml(path, "manifest"):
            return False
    return is_file(path)


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


# -- images ------------------------------------------------------------------------------------------------------------


Named = dict[tuple[int, str], list[tuple[str, int, Path]]]
"""Names without the side's token, side and path of images by the number of the token and their folder without it."""

Sets = dict[tuple[int, str], tuple[list[Path], list[Path]]]
"""Left and right images by the number of the tokens in their names (``SIDES``), and their place."""


def _by_token(images: list[Path], names: list[str]) -> Sets:
    """Images whose names have a side's token, in sets of one place; a set may have one side alone."""
    named: Named = defaultdict(list)
    groups: Sets = defaultdict(lambda: ([], []))
    for path, name in zip(images, names, strict=True):
        if (at := side_of(name)) is not None:
            row, side, neutral = at
            named[row, neutral.rpartition("/")[0]].append((neutral, side, path))
    for (row, place), found in _of_one_kind(named):
        of_side = [{neutral: None for neutral, side, _ in found if side == wanted} for wanted in (0, 1)]
        neutrals = [neutral for neutral in of_side[0] if neutral in of_side[1]]
        # Two sets in one folder: day1_left_07 and day2_left_07.
        words = {neutrals[i]: word for word, of in pairing.by_one_word(neutrals).items() for i in of}
        for neutral, side, path in found:
            groups[row, f"{place} {words.get(neutral, '')}"][side].append(path)
    return groups


def _of_both_sides(groups: Sets) -> Sets:
    """The sets with both sides: one of each place; one of all numbered places, if each holds a frame; else one of the
    only left and the only right images."""
    both = {key: sides for key, sides in groups.items() if all(sides)}
    frames = {(row, re.sub(r"\d+", "", place)) for row, place in both}
    if len(frames) == 1 and all(len(left) == len(right) == 1 for left, right in both.values()):
        alike = [sides for (row, place), sides in groups.items() if (row, re.sub(r"\d+", "", place)) in frames]
        return {min(both): ([p for left, _ in alike for p in left], [p for _, right in alike for p in right])}
    left, right = ([key for key, sides in groups.items() if sides[side]] for side in (0, 1))
    if not both and len(left) == len(right) == 1 and left[0][0] == right[0][0]:  # colour_left, mono_right
        return {left[0]: (groups[left[0]][0], groups[right[0]][1])}
    return both


def _by_word(images: list[Path], names: list[str], both: Sets) -> dict[str, list[Path]]:
    """Images by the one word in which the names of two cameras differ; empty if tokens tell more, or no word does."""
    # Tokens that make single pairs, and numbers that leave images over or stand in folders of numbered cameras, may be
    # numbers of frames: A/image_0 to A/image_2, B/image_0 to B/image_2.
    numbers = sum(len(of) for sides in both.values() for of in sides) < len(images)
    numbers |= all(pairing.CAMERA_NUMBER.search(name.rpartition("/")[0]) for name in names)
    if any(min(map(len, of)) > 1 and not (numbers and pairing.SIDES[k][0][-1] == "0") for (k, _), of in both.items()):
        return {}
    words = pairing.by_one_word(names) or pairing.by_one_word(names, timed=True)
    parts = {word: [images[i] for i in of] for word, of in words.items()}
    lefts = {path for left, _ in both.values() for path in left}
    return {} if both and any(lefts <= set(of) for of in parts.values()) else parts


def _sets(folder: Path, images: list[Path]) -> tuple[Sets, dict[str, list[Path]], list[int]]:
    """Sets of both sides by tokens, images by the one word that differs, and the numbers of left and right images."""
    names = [_relative(path.with_suffix(""), folder) for path in images]
    groups = _by_token(images, names)
    both = _of_both_sides(groups)
    return both, _by_word(images, names, both), [sum(len(sides[s]) for sides in groups.values()) for s in (0, 1)]


def find_views(folder: Path, images: list[Path]) -> FoundImages:
    """The two sets of images, by the tokens in their names that make most pairs; else by the word in which they differ.

    Raises
    ------
    InputError
        Names do not distinguish the images of two cameras.
    """
    lines, tokens = list[str](), pairing.SIDES
    photographs = [path for path in images if not COMPUTED.search(_relative(path, folder))]
    both, parts, counts = _sets(folder, photographs)
    if not both and not parts:
        photographs = images
        both, parts, counts = _sets(folder, images)
    if parts:
        first, second = parts
        both, tokens = {(0, ""): (parts[first], parts[second])}, ((first, second),)
        taken = f"{first!r} and {second!r} are taken for the left and the right camera"
        lines.append(f"{taken}, in order of their names: `rille check` shows if they are not")
    if not both:
        raise _no_pairs(folder, images, counts)
    # Most pairs; of equally many the surest token (SIDES), and the shortest name.
    key = max(both, key=lambda k: (min(len(s) for s in both[k]), -k[0], -len(k[1])))
    left, right = both[key]
    sizes, trouble, matched = None, "", tuple[ImagePair, ...]()
    try:
        matched = pairing.pair_up(left, right, warnings=lines)  # as the manifest opens
        headers, matched = pairing.common_headers(matched)
        sizes = sizes_of(headers)
    except InputError as error:
        trouble = str(error)
    sides = tokens[key[0]]
    others = [f"{pattern(of[0], folder)} and its right images: of another set" for at, of in both.items() if at != key]
    paired = {path for of in both.values() for path in (*of[0], *of[1])}
    alone = [_relative(path, folder) for path in photographs if path not in paired]
    if computed := [_relative(path, folder) for path in images if path not in set(photographs)]:
        others.append(f"{count(len(computed), 'image')} ({computed[0]} ...): computed, by the names")
    if len(matched) == 1 and sides[0][-1].isdigit() and (alone or any(at != key and at[1] == key[1] for at in both)):
        taken = f"{sides[0]!r} and {sides[1]!r} are taken for two cameras"
        lines.append(f"{taken}; if they are frames of one, name its folder left or right")
    return FoundImages(
        pattern(left, folder),
        pattern(right, folder),
        len(matched),
        sizes,
        f"{len(left)} left and {len(right)} right images, told apart by {sides[0]!r} and {sides[1]!r}",
        trouble,
        bool(pairing.times_in_names([pair.left for pair in matched])),
        sides,
        tuple(pair.absent for pair in matched if pair.absent),
        tuple(lines),
        (*others, *([f"{count(len(alone), 'image')} ({alone[0]} ...): of neither camera by name"] if alone else ())),
    )


def _no_pairs(folder: Path, images: list[Path], counts: list[int]) -> InputError:
    """Refusal of a folder without pairs; ``counts``: images that are named as left, and as right."""
    text = f"{folder} holds {len(images)} images, {counts[0]} named as left and {counts[1]} as right: no pairs"
    called = "its files or folders named left and right (or _l and _r, cam0 and cam1)"
    by_name = f"give the folder of both cameras, {called}, or write a manifest by hand"
    remedy = by_name if images else "name the folder that holds the images, or a folder nearer to them"
    text += "" if images else f" ({DEPTH} folders deep)"
    if images and sum(counts) in (0, len(images)) and not all(counts):
        with suppress(InputError):
            header = common_header(images[:1]).header
            if not header.height <= header.width < 2 * header.height:
                remedy = f"{split('each shows', 'FILE')}; else {by_name}"
    return InputError("RIL-194", text, remedy=of_one_camera(folder) + remedy)


def _of_one_kind(named: Named) -> Iterator[tuple[tuple[int, str], list[tuple[str, int, Path]]]]:
    """Images of one place and kind, or of several kinds in turns (1.png, 2.jpg, 3.png), with the place's name."""
    for (row, place), found in named.items():
        kinds = defaultdict(list)
        for neutral, side, path in found:
            kinds[path.suffix.lower()].append((neutral, side, path))
        row_of_kinds = [path.suffix.lower() for _, _, path in sorted(found, key=lambda of: (of[1], natural(of[0])))]
        changes = sum(a != b for a, b in pairwise(row_of_kinds))
        shapes = {re.sub(r"\d+", "", neutral) for neutral, _, _ in found}
        # Of two kinds with the same names one is made of the other; of a few of another kind nothing is known.
        in_turns = len({of[:2] for of in found}) == len(found) and len(shapes) == 1 and changes > 2 * len(kinds)
        for kind, of_kind in [("", found)] if in_turns else kinds.items():
            yield (row, f"{place} {kind}"), of_kind


def pattern(paths: list[Path], folder: Path) -> str:
    """The narrowest simple pattern of a set of files in one folder, or in folders of one depth."""
    names = [path.name for path in paths]
    if len({path.suffix for path in paths}) > 1:  # searches ignore the case of suffixes
        names = [path.stem + path.suffix.lower() for path in paths]
    below = {path.parent.relative_to(folder).parts for path in paths}
    alike = [glob.escape(min(part)) if len(set(part)) == 1 else "*" for part in zip(*below, strict=False)]
    place = "".join(f"{part}/" for part in (alike if len(set(map(len, below))) == 1 else ["**"]))
    if len(set(names)) == 1:
        return place + glob.escape(names[0])
    head = _common_start(names).rstrip("0123456789")
    tail = _common_start([name[len(head) :][::-1] for name in names])[::-1].lstrip("0123456789")
    if len({path.suffix.lower() for path in paths}) > 1:  # *g of .png and .jpg
        tail = ""
    return f"{place}{glob.escape(head)}*{glob.escape(tail)}"


def _common_start(words: list[str]) -> str:
    """Common beginning of all words."""
    return "".join(of[0] for of in takewhile(lambda letters: len(set(letters)) == 1, zip(*words, strict=False)))


# -- calibration -------------------------------------------------------------------------------------------------------


def find_calibration(found: Findings, texts: list[Path]) -> None:
    """Find the one or the two calibration files that suit this rig best."""
    read: dict[str, list[CalibratedCamera]] = {}
    for path in texts:
        relative = _relative(path, found.folder)
        try:
            cameras = read_cameras(path)
        except (RilleError, OSError, ValueError) as error:
            # Most text files are tables, or something else; a file refused for its lens is a calibration.
            other = path.suffix.lower() in TABLES or (isinstance(error, RilleError) and error.remedy == KNOWN)
            refused = re.match(r"RIL-(81\d|120|135)", getattr(error, "code", ""))
            named = "calib" in path.stem.lower() and getattr(error, "remedy", "") != KNOWN
            if refused or named or not other:
                found.unread.append(" ".join(str(error).split()))
            continue
        if cameras:
            read[relative] = of_size(cameras, found.views.sizes)
    # Of equally good files one of two cameras rather than one of more.
    in_turn = sorted(read.items(), key=lambda item: len(item[1]) > 2)
    candidates = [_calibration((name,), cameras, found.views.sides) for name, cameras in in_turn]
    single = {name: cameras[0] for name, cameras in read.items() if len(cameras) == 1}
    # Cameras of other names differ by the same words as their images.
    renamed = {name: _of_other_side(name, found.views.sides) for name in single}
    pairs = pairing.two_sides(single) or [pair for pair in renamed.items() if pair[0] != pair[1] in single]
    candidates += [_calibration(pair, [single[name] for name in pair], found.views.sides) for pair in pairs]
    if candidates:
        place = Path(found.views.left).parent

        def rank(c: FoundCalibration) -> tuple[int, ...]:
            above, beside = [place, *place.parents], Path(c.files[0]).parent
            far = above.index(beside) if beside in above else len(above)
            return c.suits(found.views.sizes), c.cameras, c.baseline is not None, -far, -len(c.files)

        found.calibration = max(candidates, key=rank)
        taken = found.calibration.files
        found.others = [name for name in read if name not in taken]
        each = [name for name in read if re.sub(r"\d+", "", name) == re.sub(r"\d+", "", taken[0])]
        unlike = [name for name in each if len(each) == found.views.pairs and str(read[name]) != str(read[taken[0]])]
        remedy = f"unlike {taken[0]}, which is taken for all images; write a manifest for each"
        found.unread += [line("calibration", unlike, remedy)] if unlike and not taken[1:] else []


def _of_other_side(name: str, sides: tuple[str, str]) -> str:
    """The name of a file of the left camera with the right one's word in the place of its own; else as it is."""
    return "".join(sides[1] if word == sides[0] else word for word in re.split(r"([^\W_]+)", name))


def _calibration(files: tuple[str, ...], cameras: list[CalibratedCamera], sides: tuple[str, str]) -> FoundCalibration:
    """Of several cameras the two with the numbers in the images' names (``image_2``: ``P2``), else the first two."""
    numbers = [re.search(r"\d+$", side) for side in sides]
    by_number = {int(n[0]): c for c in cameras if (n := re.search(r"\d+(?=\D*$)", c.name))}
    chosen = [by_number[int(n[0])] for n in numbers if n and int(n[0]) in by_number]
    both = chosen if len(cameras) > 2 and len(chosen) == 2 else cameras[:2]
    left, right = both[0], both[-1]
    pose = relative_pose(left, right) if both[1:] else None
    baseline = None if pose is None else float(np.linalg.norm(pose.translation))
    names = (left.name, right.name) if len(cameras) > 2 else None
    return FoundCalibration(files, (left.size, right.size), baseline, len(both), names, left.mount)


# -- tables ------------------------------------------------------------------------------------------------------------


def table_kind(path: Path, pairs: int) -> str:
    """Kind of a table of numbers, by its header and first row: truth, imu, attitude, times ...; empty: no table.

    Raises
    ------
    InputError
        It is no text, has decimal commas, holds motions, no poses, or is one of true positions by its columns' names,
        but cannot be read.
    """
    # Refuses files that are no text; most others are no tables, which is no error.
    if of_images(path):
        text = f"{path} holds poses by COLMAP, at a scale that it need not know"
        remedy = 'if they are in metres, state them as [truth] with file = "images.txt"'
        raise InputError("RIL-976", text, remedy=remedy)
    named = "times" if "time" in path.stem.lower() else ""
    try:
        table = read_table(path, "table")
    except InputError as error:
        if error.remedy == ROWS:  # records of another form, such as NMEA
            raise
        return named
    table = of_poses(table)
    row = table.values(range(table.columns))[0]
    header = " ".join(table.header)
    if row.size >= 7 and (re.search("gyro|w_rs|ang_vel|angular|accel", header) or names_sensors(table)):
        return "imu"
    if "yaw" in header and "roll" in header and not (table.crs or of_photographs(table)):
        return "attitude"
    # Of a robot on a plane, or by their name: dead reckoning is no truth.
    wheels = ODOMETRY.search(path.stem) is not None and not TRUTH.search(path.stem)
    places = [row[k] for name, k in meanings(table).items() if name in ("x", "y")]
    if len(places) == 2 and (wheels or "yaw" in meanings(table)):
        # Dead reckoning begins near 0, in a frame of its own.
        geodetic = table.crs or of_photographs(table) or np.abs(places).max() > 1e4
        return "positions" if geodetic else "odometry"
    if untimed(table) and len(table.rows) == pairs:
        return "truth"
    if matrix_at(table) is not None or (meanings(table).keys() >= {"x", "y", *QUATERNION} and not table.crs):
        # Of cameras or sensors, as "image_00: ...", or a single one, it says where they are mounted.
        mounts = table.rows[0][0].endswith(":") or (len(table.rows) == 1 < pairs and "time" not in meanings(table))
        return "" if mounts else "truth"
    positions = positions_of(table, "csv", {}) if meanings(table).keys() >= {"x", "y"} else None
    # Without times or names of images there must be one for each pair.
    if positions is not None and (positions.times or positions.images or len(positions.positions) == pairs):
        return "positions"
    images = any(cell.lower().endswith(SUFFIXES) for cell in table.rows[0])
    if images and "time" in meanings(table) and len(table.rows) == pairs:
        return "times"
    if row.size >= 8 and row.size not in (12, 16) and abs(np.linalg.norm(row[4:8]) - 1) < 1e-3:
        return "truth"
    # Beside times of exposure or numbers of frames, as in times.txt of DSO.
    rising = row.size == 1 and len(table.rows) == pairs and bool((np.diff(table.values([0]), axis=0) > 0).all())
    if (rising and not CAMERA_WORDS.search(path.stem)) or (row.size <= 3 and named):
        return "times"
    # Names of images, dates and the like are no numbers.
    return named if np.isinf(row).any() else ""
