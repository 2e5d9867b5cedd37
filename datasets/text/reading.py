"""Read files of others within bounds: regular files up to a size, folders up to a number of entries.

A pipe blocks for ever, a device never ends, and a short file may unpack or parse to something huge. All files of a
sequence, a configuration or a calibration are read by this module, so that each of these ends with a message.
"""

from __future__ import annotations

import fnmatch
import os
import re
import stat
import tomllib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator
from contextlib import suppress
from io import BufferedReader
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

from rille.datasets.images.kinds import hints
from rille.stages.core.errors import InputError, did_you_mean

SMALL = 1_000_000
"""Bytes of a manifest, a configuration or a calibration, which have kilobytes."""

TABLE = 100_000_000
"""Bytes of a table: an IMU at 200 Hz writes as much in three quarters of an hour."""

MOST_LINES = 1_000_000
"""Most lines of a table; each becomes an object of some hundred bytes, and an IMU's have a hundred characters."""

LONGEST_LINE = 10_000
"""Characters; a pose has 400. Time of parsers that backtrack grows with the square."""

DEEPEST = 20
"""Levels of nested entries; real files have four."""

MOST_ENTRIES = 300_000
"""Most files and folders of a search, which takes two or three seconds for these."""

GREATEST = 1e20
"""Above any measurement in any unit; smaller numbers stay finite when squared and multiplied."""

BETWEEN = re.compile(r'[\s;=\[\]()"]+|[,:]\s')
COMMA, POINT = re.compile(r"[-+]?(\d+),(\d+)([eE][-+]?\d+)?"), re.compile(r"\d\.\d")
"""What stands between numbers, and numbers with a decimal comma and with a point."""

TWO_NAMES = re.compile(r"[\s#%]*[^\W\d][^,;\t\n]*,\s*[^\W\d][^,;\t\n]*(\n|$)")
"""A first line with the names of two columns, which a comma parts."""

LISTED = re.compile(r"\d,\d+,\s")
"""A number with a decimal comma in a list of numbers, between which there are blanks."""

SAMPLE = 200
"""Lines in which the form of a file's numbers is checked."""

POINTERS = (b"version https://git-lfs.github.com/spec/", b"/annex/objects/")
"""Beginnings of files that Git LFS and git-annex leave in place of their content."""

WILD = re.compile(r"[*?\[]")
FOREIGN = re.compile(r"\\|%\d*d")
"""In paths as Windows and ffmpeg write them."""
HIDDEN = re.compile(r"\.(?!\d+\.)")  # .25.png is a number


def open_regular(path: Path, what: str, most: int) -> BufferedReader:
    """A regular file of at most ``most`` bytes, open for reading.

    Parameters
    ----------
    what : kind of the file, for errors.

    Raises
    ------
    InputError
        It cannot be opened, is a folder, a pipe or a device, is larger, or is a pointer of Git LFS or git-annex.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            # Caught below, with the system's own errors.
            raise OSError(0, "it is a folder" if stat.S_ISDIR(status.st_mode) else "it is a pipe or a device")
        if status.st_size <= most:
            file = path.open("rb")
            if not file.peek(len(POINTERS[0])).startswith(POINTERS):
                return file
            file.close()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error  # a path with a zero byte
        text = f"{what} {path} cannot be read: {missing_target(path) or reason}"
        remedy = "name a file in it" if os.path.isdir(path) else f"{nearest_hint(path)}check the path and its rights"
        raise InputError("RIL-138", text, remedy=remedy) from error
    if status.st_size <= most:
        text = f"{what} {path} is a pointer of Git LFS or git-annex; its content is elsewhere"
        raise InputError("RIL-820", text, remedy="fetch it: git lfs pull, or git annex get")
    size = f"{status.st_size / 1e6:.1f} MB, at most {most / 1e6:g} MB are read"
    raise InputError("RIL-139", f"{what} {path} is too large: {size}", remedy="check that it is the right file")


def mark(status: os.stat_result) -> str:
    """Inode, size and times of a file, which change with its content, since no call can set the time of change."""
    return f"{status.st_ino:x}.{status.st_size:x}.{status.st_mtime_ns:x}.{status.st_ctime_ns:x}"


def missing_target(path: str | Path, name: str = "it") -> str:
    """That a path, called ``name``, is a link to a missing file, in words; empty: it is none, or a closed one."""
    try:
        target = os.readlink(path)
    except (OSError, ValueError):  # as of another user's process below /proc
        return ""
    return "" if os.path.exists(path) else f"{name} is a link to {target}, which is missing"


def nearest_hint(path: Path) -> str:
    """What may be meant by the path, or pattern, of a missing file, as the beginning of a remedy; empty: unknown."""
    if FOREIGN.search(str(path)):
        return "write / between folders, not \\, and * for a number that changes, not %06d; "
    for part in reversed((path, *path.parents[:-1])):
        if WILD.search(part.name):
            break
        if not os.path.lexists(part):
            with suppress(OSError, ValueError), os.scandir(part.parent) as entries:
                like = did_you_mean(part.name, [e.name for e in islice(entries, MOST_ENTRIES) if e.name.isprintable()])
                return f"{like[:-1]}, in {part.parent}? Else " if like else ""
            break
    return ""


def is_file(path: str | Path) -> bool:
    """Whether a path is a file, or a broken link, which is reported when it is read."""
    return os.path.isfile(path) or bool(missing_target(path))


def read_bytes(path: Path, what: str, most: int) -> bytes:
    """Content of a regular file (see :func:`open_regular`)."""
    with open_regular(path, what, most) as file:
        try:
            data = file.read(most + 1)
        except OSError as error:
            raise InputError("RIL-753", f"{what} {path} cannot be read: {error.strerror}", remedy="check it") from error
    if len(data) > most:  # it grew, or does not know its size
        raise InputError("RIL-754", f"{what} {path} does not end", remedy="check that it is the right file")
    return data


def read_text(path: Path, what: str, most: int = SMALL) -> str:
    """Text of a regular file in UTF-8, or in UTF-16 with a byte order mark, its lines ended by line feeds alone.

    Raises
    ------
    InputError
        It cannot be read, is too large, is no text, or has a line that no such file has.
    """
    data = read_bytes(path, what, most)
    try:
        # UTF-16: by PowerShell's redirection and by spreadsheets.
        text = data.decode("utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        # Refused below, like a file with zero bytes.
        text = "\0"
    if "\0" in text:
        remedy = next(iter(hints(path.name)), "give it as text in UTF-8")
        raise InputError("RIL-140", f"{what} {path} is no text file", remedy=remedy)
    return text


def read_lines(path: Path, what: str) -> list[str]:
    """Lines of a table (see :func:`read_text`), at most ``MOST_LINES``."""
    text = read_text(path, what, TABLE)
    # Where ``str.splitlines`` ends a line
    # Counted before there is a list of them: empty lines cost nothing in the file.
    count = sum(map(text.count, "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"))
    if count > MOST_LINES:
        raise InputError("RIL-722", f"{what} {path} has {count} lines, at most {MOST_LINES} are read", remedy="cut it")
    lines = text.splitlines()
    _no_long_line(lines, path, what)
    rows = [match for line in lines[:SAMPLE] if (match := COMMA.fullmatch(line.strip()))]
    columns = [[int(row[k]) for row in rows] for k in (1, 2)]
    # A greater number is a stamp of milliseconds or less, which has no fraction.
    # A comma in each line may part two columns of integers: stamps that never go back, and what goes with them.
    ascending = all(a < b for c in columns for a, b in pairwise(c))
    if not rows or not (ascending or columns[0][0] > 10**12 or TWO_NAMES.match("\n".join(lines[:SAMPLE]))):
        refuse_decimal_commas(lines, path)
    return lines


def refuse_decimal_commas(lines: list[str], path: Path, cause: Exception | None = None) -> None:
    """Refuse text of which more numbers have a decimal comma than a point, or one that ``cause`` complains of.

    Raises
    ------
    InputError
        It is so.
    """
    if "".join(lines[:SAMPLE]).lstrip().startswith("{"):
        return  # JSON, whose commas separate numbers, with or without a blank
    sample = enumerate((line[:LONGEST_LINE] for line in lines[:SAMPLE]), start=1)
    words = [(k, word) for k, line in sample for word in BETWEEN.split(line)]
    commas = [(k, word) for k, word in words if COMMA.fullmatch(word)]
    points = sum(POINT.search(word) is not None for _, word in words)
    # In a list of YAML each such number has become two.
    counted = "numbers, it takes" in str(cause) and any(LISTED.search(line) for line in lines[:SAMPLE])
    if len(commas) > points or (counted and commas) or any(word in str(cause) for _, word in commas):
        text = f"{path}: decimal commas, such as {commas[0][1]} in line {commas[0][0]}, are not read"
        remedy = "write decimal points (LC_NUMERIC=C for the program that wrote them)"
        raise InputError("RIL-813", text, remedy=remedy) from cause


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Tables of a TOML file.

    Raises
    ------
    InputError
        It cannot be read, is not TOML, or is nested deeper than any such file.
    """
    text = read_text(path, what)
    _no_long_line(text.splitlines(), path, what)
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits are plain ValueErrors
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise InputError("RIL-026", f"{path} is not TOML: {reason}", remedy="correct the file at that place") from error
    check_depth(values, str(path))
    return values


def check_depth(value: Any, file: str) -> None:
    """Refuse entries of more than ``DEEPEST`` levels, by which recursion would run out of stack."""
    level = [value]
    for _ in range(DEEPEST):
        nested = [v.values() if isinstance(v, dict) else v for v in level if isinstance(v, dict | list)]
        level = [v for values in nested for v in values]
        if not level:
            return
    raise InputError("RIL-760", f"{file} is nested more than {DEEPEST} levels deep", remedy="correct the file")


def _no_long_line(lines: list[str], path: Path, what: str) -> None:
    for k, line in enumerate(lines, start=1):
        if len(line) > LONGEST_LINE:
            text = f"{what} {path}, line {k}: {len(line)} characters, at most {LONGEST_LINE} are read"
            raise InputError("RIL-757", text, remedy="check that it is the right file")


class Search:
    """Search of folders, with at most ``MOST_ENTRIES`` files and folders in total.

    Attributes
    ----------
    closed : a line on each existing folder that could not be read.
    """

    def __init__(self) -> None:
        self._seen, self.closed = 0, list[str]()

    def entries(self, folder: Path) -> list[os.DirEntry[str]]:
        """Entries of a folder in order of name; empty if it cannot be read.

        Raises
        ------
        InputError
            There are too many.
        """
        found: list[os.DirEntry[str]] = []
        try:
            with os.scandir(folder) as there:
                found = sorted(islice(there, MOST_ENTRIES - self._seen + 1), key=lambda entry: entry.name)
        except (FileNotFoundError, NotADirectoryError, ValueError):
            pass
        except OSError as error:  # of another user, or on a disconnected network drive
            self.closed.append(f"folder {folder} cannot be read: {error.strerror}")
        self._seen += len(found)
        if self._seen > MOST_ENTRIES:
            text = f"more than {MOST_ENTRIES} files and folders to look at, so far as {folder}"
            raise InputError("RIL-750", text, remedy="name the folder of the images, not one far above it")
        return found

    def below(
        self, top: Path, depth: int = MOST_ENTRIES, *, links: bool = False, hidden: bool = False
    ) -> Iterator[tuple[Path, list[os.DirEntry[str]]]]:
        """The folder and those at most ``depth`` levels below with their entries, each once.

        Parameters
        ----------
        links : whether links are followed, which may form cycles.
        hidden : whether hidden folders and entries count.
        """
        level, entered = [top], {os.path.realpath(top)}
        for _ in range(depth + 1):
            inner = []
            for folder in level:
                entries = [e for e in self.entries(folder) if hidden or not HIDDEN.match(e.name)]
                yield folder, entries
                # os.path: a link that leads to itself, or into a closed folder, is no folder.
                inner += [Path(e.path) for e in entries if os.path.isdir(e) and (links or not e.is_symlink())]
            places = {os.path.realpath(path): path for path in reversed(inner)}
            level = [places[place] for place in reversed(places) if place not in entered]
            entered |= places.keys()
            if not level:
                return

    def matching(self, root: Path, pattern: str) -> list[Path]:
        """Files that match a pattern below ``root``, or an absolute one, the suffix in any case; ``**`` stands for any
        folders.

        Raises
        ------
        InputError
            The pattern names no files, or there are too many.
        """
        *above, last = pattern.split("/")
        if not last:
            raise InputError("RIL-216", f"{pattern!r} is no pattern of files", remedy="give one such as left/*.png")
        places = [root]
        if pattern.startswith("/"):
            places, above = [Path("/")], above[1:]
        for part in above:
            if part == "**":
                places = [place for top in places for place, _ in self.below(top)]
            elif WILD.search(part) and not any(os.path.isdir(place / part) for place in places):
                places = [path for place in places for path in self._named(place, part) if os.path.isdir(path)]
            else:
                # os.path, here and below: pathlib raises where a name is longer than the system allows.
                places = [place / part for place in places if os.path.isdir(place / part)]
            places = list(dict.fromkeys(places))
        return [path for place in places for path in self._named(place, last) if is_file(path)]

    def _named(self, folder: Path, pattern: str) -> list[Path]:
        """Entries that match a pattern; hidden ones (which macOS adds to archives) only if it begins with a dot."""
        entries = (e for e in self.entries(folder) if pattern.startswith(".") or not HIDDEN.match(e.name))
        return [Path(e.path) for e in entries if fnmatch.fnmatchcase(_folded(e.name), _folded(pattern))]


def _folded(name: str) -> str:
    """A name, or a pattern of names, with its suffix in lower case."""
    stem, suffix = os.path.splitext(name)
    return stem + suffix.lower()
