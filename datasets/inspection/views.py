"""Left and right images of a folder: by the tokens of a side in their names, else by the word in which they differ."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rille.datasets.images import pairing
from rille.datasets.images.files import common_header
from rille.datasets.images.headers import sizes_of
from rille.datasets.images.kinds import split
from rille.datasets.images.pairing import ImagePair
from rille.datasets.inspection.patterns import pattern, relative
from rille.datasets.inspection.sets import by_place, sets_of
from rille.datasets.text.names import ends, shell_word
from rille.datasets.text.order import times_in_names
from rille.datasets.text.sides import SIDES, of_one_camera
from rille.stages.core.errors import InputError
from rille.stages.core.quantities import count
from rille.stages.geometry.geometry import Sizes

DEPTH = 4
"""Levels of folders that are searched; deeper ones are other data sets."""

COMPUTED = re.compile(
    r"(?<![a-z])(depth|disp|seg|mask|valid|flow|label|conf|normal|occl|semantic|instance|dem(?![a-z]))", re.I
)
"""In the names of images and arrays that are no photographs, as beside those of simulators."""


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


def find_views(folder: Path, images: list[Path]) -> FoundImages:
    """The two sets of images, by the tokens in their names that make most pairs; else by the word in which they differ.

    Raises
    ------
    InputError
        Names do not distinguish the images of two cameras.
    """
    lines, tokens = list[str](), SIDES
    photographs = [path for path in images if not COMPUTED.search(relative(path, folder))]
    both, parts, counts = sets_of(folder, photographs)
    if not photographs:
        photographs = images
        both, parts, counts = sets_of(folder, images)
    if parts:
        first, second = parts
        both, tokens = by_place(folder, parts), ((first, second),)
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
    others = [_of_another_set(of, left[0], folder) for at, of in both.items() if at != key]
    paired = {path for of in both.values() for path in (*of[0], *of[1])}
    alone = [relative(path, folder) for path in photographs if path not in paired]
    if computed := [relative(path, folder) for path in images if path not in set(photographs)]:
        others.append(f"{count(len(computed), 'image')} ({computed[0]} ...): computed, by the names")
    if len(matched) == 1 and sides[0][-1].isdigit() and (alone or any(at != key and at[1] == key[1] for at in both)):
        taken = f"{sides[0]!r} and {sides[1]!r} are taken for two cameras"
        lines.append(f"{taken}; if they are frames of one, name its folder left or right")
    places = dict.fromkeys(os.path.commonpath([pair.left.parent, pair.right.parent]) for pair in matched)
    if len(places) == len(matched) > 1 and not all(re.search(r"\d$", place) for place in places):
        one = f"`rille init {shell_word(next(iter(places)))}`"
        lines.append(
            f"each pair has a folder of its own: if they are scenes, not frames of one camera, {one} takes one"
        )
    return FoundImages(
        pattern(left, folder),
        pattern(right, folder),
        len(matched),
        sizes,
        f"{len(left)} left and {len(right)} right images, told apart by {sides[0]!r} and {sides[1]!r}",
        trouble,
        bool(times_in_names([pair.left for pair in matched])),
        sides,
        tuple(pair.absent for pair in matched if pair.absent),
        tuple(lines),
        (*others, *([f"{count(len(alone), 'image')} ({alone[0]} ...): of neither camera by name"] if alone else ())),
    )


def _of_another_set(sides: tuple[list[Path], list[Path]], taken: Path, folder: Path) -> str:
    """A line on pairs beside those of the left image ``taken``, and how they are opened."""
    place = Path(os.path.commonpath([path.parent for of in sides for path in of]))
    # A folder of a camera is none of pairs.
    own = taken.is_relative_to(place) or not place.is_relative_to(folder)
    how = "images.left and images.right of a manifest" if own else f"`rille init {shell_word(place)}`"
    return f"{pattern(sides[0], folder)} and its right images: of another set, which {how} would take"


def _no_pairs(folder: Path, images: list[Path], counts: list[int]) -> InputError:
    """Refusal of a folder without pairs; ``counts``: images that are named as left, and as right."""
    seen = f"{len(images)} images ({ends(images)})"
    text = f"{folder} holds {seen}, {counts[0]} named as left and {counts[1]} as right: no pairs"
    called = "its files or folders named left and right (or _l and _r, cam0 and cam1)"
    by_name = f"give the folder of both cameras, {called}, or write a manifest by hand"
    remedy = by_name if images else "name the folder that holds the images, or a folder nearer to them"
    text += "" if images else f" ({DEPTH} folders deep)"
    if images and sum(counts) in (0, len(images)) and not all(counts):
        with suppress(InputError):
            header = common_header(images[:1]).header
            if not header.height <= header.width < 2 * header.height:
                remedy = f"{split('each shows', 'FILE')}; else {by_name}"
        alternate = 'images.left = "*[02468].png", images.right = "*[13579].png", images.pair = "order"'
        remedy += (
            f" (of images that show left and right in turn by {alternate})"
            if not (sum(counts) or of_one_camera(folder))
            else ""
        )
    return InputError("RIL-194", text, remedy=of_one_camera(folder) + remedy)
