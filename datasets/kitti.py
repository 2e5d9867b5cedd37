"""Folders of rectified or calibrated pairs in the layout of KITTI odometry (Geiger et al. 2012).

Two layouts are recognised: the standard one, ``ROOT/sequences/NN`` with ``ROOT/poses/NN.txt`` (given as the sequence's
folder, or as ``ROOT:NN``), and a self-contained folder with two image folders, ``calib.txt``, and optionally
``poses.txt`` and ``times.txt``. Both become a manifest (:mod:`rille.datasets.manifest`), which opens the folder.

``calib.txt`` may have any format of :mod:`rille.datasets.cameras`. Each line of ``poses.txt`` is T_world_reference,
3 x 4, of the calibration's reference frame.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rille.datasets.cameras import read_cameras
from rille.datasets.images.files import SUFFIXES, Digests
from rille.datasets.manifest.model import Cameras, Images, Manifest, Times, Truth, stated_vehicle
from rille.datasets.manifest.opening import open_folder
from rille.datasets.manifest.rig import street_defaults
from rille.datasets.protocol import Sequence
from rille.datasets.text.names import derived_name, shell_word
from rille.datasets.text.reading import read_text
from rille.stages.core.errors import InputError

NUMBERS = (("0", "1"), ("2", "3"), ("00", "01"), ("02", "03"), ("l", "r"))
PAIRS = (*((f"image_{left}", f"image_{right}") for left, right in NUMBERS), ("left", "right"))
"""Names of the image folders, left and right; grey KITTI cameras before colour ones."""

FORMS = (
    ("FOLDER", "two image folders (image_0/1, image_2/3, image_l/r or left/right), calib.txt; poses.txt, times.txt"),
    ("ROOT:NN", "KITTI odometry: ROOT/sequences/NN and ROOT/poses/NN.txt"),
)


def image_folders(folder: Path) -> tuple[str, str] | None:
    """The pair of image folders in a folder, those with images first; None: there is none."""
    there = [sides for sides in PAIRS if all((folder / side).is_dir() for side in sides)]
    for sides in there:
        if all(any(f.suffix.lower() in SUFFIXES for f in (folder / side).iterdir()) for side in sides):
            return sides
    # Images may be still to come, or of a kind that is not read, but not in folders below.
    return next((p for p in there if not any(f.is_dir() for side in p for f in (folder / side).iterdir())), None)


def open_layout(path: Path, number: str | None, digests: Digests) -> Sequence | None:
    """The sequence of a folder; None if it has another layout.

    Raises
    ------
    InputError
        There are several and none is chosen, or files cannot be used.
    """
    folder = _of_several(path, number) if (path / "sequences").is_dir() else None if number is not None else path
    sides = None if folder is None else image_folders(folder)
    if folder is None or sides is None:
        return None
    folder = folder.resolve()
    if not (folder / "calib.txt").is_file():
        text = f"{path} has image folders {' and '.join(sides)}, but no calib.txt"
        remedy = f"`rille init {shell_word(path)}` writes a manifest that says what is needed"
        raise InputError("RIL-278", text, remedy=remedy)
    manifest = manifest_of(folder, sides)
    spare = [folder / "times.txt", *([Path(manifest.truth.file)] if manifest.truth else [])]
    sequence = open_folder(manifest, folder, digests, spare)
    return replace(sequence, defaults=street_defaults(sequence.rig))


def _of_several(root: Path, number: str | None) -> Path:
    """Folder of the sequence with this number, or of the only one."""
    there = sorted(d.name for d in (root / "sequences").iterdir() if d.is_dir() and image_folders(d))
    if number is None and len(there) != 1:
        example = there[0] if there else "00"
        raise InputError("RIL-197", f"{root} holds {len(there)} sequences", remedy=f"choose one, e.g. {root}:{example}")
    number = number if number is not None else there[0]
    if number not in there:
        raise InputError("RIL-198", f"{root} has no sequence {number!r}", remedy=f"it has {', '.join(there) or 'none'}")
    return root / "sequences" / number


def manifest_of(folder: Path, sides: tuple[str, str]) -> Manifest:
    """Manifest of the folder."""
    standard = folder.parent.name == "sequences"
    cameras = {camera.name: camera for camera in read_cameras(folder / "calib.txt")}
    names = camera_names(folder / "calib.txt", sides, set(cameras))
    left = cameras.get(names[0]) if names else next(iter(cameras.values()), None)
    places = [folder / "poses.txt", *([folder.parent.parent / "poses" / f"{folder.name}.txt"] if standard else [])]
    poses = next((place for place in places if place.is_file()), None)
    truth = None
    if poses is not None:
        source, mount = f"poses of {poses.name}, as recorded", left and left.mount
        truth = Truth(file=str(poses), format="kitti", source=source, T_body_left=mount)
    return Manifest(
        name=derived_name(f"kitti-{folder.name}" if standard else folder.name),
        images=Images(left=f"{sides[0]}/*", right=f"{sides[1]}/*"),
        cameras=Cameras(file="calib.txt", names=names),
        times=Times(file="times.txt") if (folder / "times.txt").is_file() else None,
        truth=truth,
        vehicle=stated_vehicle(folder),
    )


def camera_names(calibration: Path, sides: tuple[str, str], there: set[str]) -> tuple[str, str] | None:
    """Labels of the images' cameras, by the folders' numbers; None: the cameras of the file, if they are two."""
    numbers = [side[-1] for side in sides]
    forms = [(form.format(numbers[0]), form.format(numbers[1])) for form in ("P{}", "P_rect_0{}")]
    chosen = next((names for names in [*forms, ("P1_roi", "P2_roi")] if set(names) <= there), None)
    # Rows without labels belong to the two folders; labels of other cameras do not.
    labelled = numbers[0].isdecimal() and ":" in read_text(calibration, "calibration")
    return forms[0] if chosen is None and labelled else chosen
