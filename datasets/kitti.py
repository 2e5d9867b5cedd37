"""Folders of rectified or calibrated pairs in the manner of KITTI odometry (Geiger et al. 2012).

Two layouts are recognised: the standard one, ``ROOT/sequences/NN`` with ``ROOT/poses/NN.txt`` (given as the sequence's
folder, or as ``ROOT:NN``), and a self-contained folder with two image folders, ``calib.txt``, and optionally
``poses.txt`` and ``times.txt``.

``calib.txt`` has one 3 x 4 projection matrix a line, row-major, with or without a label (``P0: ...``): P = K [R | t]
maps the reference frame, in which the poses are given, to pixels; KITTI's have R = 1. Pixel centres are at integers.
``poses.txt`` has T_world_reference, 3 x 4 a line.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rille.datasets.cameras.kitti import decompose
from rille.datasets.cameras.pair import check_focal
from rille.datasets.images import files
from rille.datasets.images.headers import sizes_of
from rille.datasets.images.kinds import unread
from rille.datasets.images.pairing import ends, natural
from rille.datasets.manifest.rig import LONGEST_BASELINE, unusual
from rille.datasets.poses import rounded_pose
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.datasets.text.names import derived_name
from rille.datasets.text.reading import read_lines
from rille.datasets.text.times import seconds
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, Sizes

PAIRS = (
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("image_00", "image_01"),
    ("image_02", "image_03"),
    ("image_l", "image_r"),
    ("left", "right"),
)
"""Names of the image folders, left and right; grey KITTI cameras before colour ones."""

ROI = ("P1_roi", "P2_roi")
OTHER = re.compile(r"Tr.*|[KDRST]_.*|calib_time.*|corner_dist.*")
"""Labels of lines that hold no projection: laser scanner, cameras before rectification, date and board."""

STREET = {"locus.cell_size": 0.1}
"""0.1 m resolves kerbs where the disparity does."""

CAR = 0.3
"""m, baseline from which a rig is taken for a car's: of a smaller one the cells follow from what its pixels resolve."""


FORMS = (
    ("FOLDER", "two image folders (image_0/1, image_2/3, image_l/r or left/right), calib.txt; poses.txt, times.txt"),
    ("ROOT:NN", "KITTI odometry: ROOT/sequences/NN and ROOT/poses/NN.txt"),
)
"""What a user may give."""


@dataclass(frozen=True)
class KittiLayout:
    """Where the parts of a sequence lie."""

    name: str
    folder: Path
    pair: tuple[str, str]
    calib: Path
    poses: Path | None
    times: Path | None


def image_folders(folder: Path) -> tuple[str, str] | None:
    """The pair of image folders that a folder has."""
    return next((p for p in PAIRS if all((folder / side).is_dir() for side in p)), None)


def recognise(path: Path, number: str | None = None) -> KittiLayout | None:
    """Layout of a folder, or None where it is none of ours.

    Raises
    ------
    InputError
        The folder holds several sequences and none is chosen, or the chosen one is not there.
    """
    if (path / "sequences").is_dir():
        there = sorted(d.name for d in (path / "sequences").iterdir() if d.is_dir() and image_folders(d))
        if number is None and len(there) != 1:
            example = there[0] if there else "00"
            raise InputError(
                "RIL-197", f"{path} holds {len(there)} sequences", remedy=f"choose one, e.g. {path}:{example}"
            )
        number = number if number is not None else there[0]
        if number not in there:
            raise InputError(
                "RIL-198", f"{path} has no sequence {number!r}", remedy=f"it has {', '.join(there) or 'none'}"
            )
        path = path / "sequences" / number
    elif number is not None:
        return None
    path = path.resolve()
    pair = image_folders(path)
    if pair is None:
        return None
    beside = path.parent.parent / "poses" / f"{path.name}.txt"
    standard = path.parent.name == "sequences"
    poses = next((p for p in (path / "poses.txt", *([beside] if standard else [])) if p.is_file()), None)
    times = path / "times.txt"
    return KittiLayout(
        name=derived_name(f"kitti-{path.name}" if standard else path.name),
        folder=path,
        pair=pair,
        calib=path / "calib.txt",
        poses=poses,
        times=times if times.is_file() else None,
    )


def open_layout(path: Path, number: str | None, digests: files.Digests) -> Sequence | None:
    """The sequence of a folder, or None where it has not this layout.

    Raises
    ------
    InputError
        There are several and none is chosen, or what is there cannot be used.
    """
    layout = recognise(path, number)
    if layout is None:
        return None
    if not layout.calib.is_file():
        raise InputError(
            "RIL-278",
            f"{path} has image folders {' and '.join(layout.pair)}, but no {layout.calib.name}",
            remedy=f"`rille init {path}` writes a manifest that says what is needed",
        )
    return open_kitti(layout, digests)


def _rows(
    path: Path, count: int, what: str, gaps: bool = False, skip: re.Pattern[str] | None = None
) -> list[tuple[int, str, NDArray[np.float64]]]:
    """Rows of a text file: (line, label or "", numbers); each must have ``count`` finite ones, or only NaN for a gap.

    ``skip``: lines with such a label are passed over.
    """
    out = []
    for k, line in enumerate(read_lines(path, what), start=1):
        label, _, numbers = line.rpartition(":")
        if not numbers.strip() or (skip is not None and skip.fullmatch(label.strip())):
            continue
        try:
            values = np.array([float(v) for v in numbers.split()])
        except ValueError:
            values = np.empty(0)
        gap = gaps and np.isnan(values).all()
        if values.size != count or not (gap or np.isfinite(values).all()):
            raise InputError(
                "RIL-200", f"{path}, line {k}: not {count} numbers", remedy=f"correct that line of the {what}"
            )
        out.append((k, label.strip(), values))
    return out


def read_projections(path: Path, pair: tuple[str, str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The 3 x 4 projection matrices of the two cameras.

    With labels ``P0 ... P3`` the images' numbers choose; else the first two lines are left and right.
    """
    if not path.is_file():
        raise InputError(
            "RIL-201",
            f"{path} is missing",
            remedy="put the calibration there: a 3 x 4 projection matrix a line, left and right",
        )
    rows = [(label, v.reshape(3, 4)) for _, label, v in _rows(path, 12, "calibration", skip=OTHER)]
    labelled = {label: p for label, p in rows if label}
    wanted = [f"P{side[-1]}" for side in pair]
    for form in ("P{}", "P_rect_0{}"):
        chosen = [form.format(side[-1]) for side in pair]
        if all(w in labelled for w in chosen):
            return labelled[chosen[0]], labelled[chosen[1]]
    if all(w in labelled for w in ROI):  # the older sequences count from 1
        return labelled[ROI[0]], labelled[ROI[1]]
    numbered = pair[0][-1].isdigit()
    if numbered and not labelled and len(rows) == 4:
        return rows[int(pair[0][-1])][1], rows[int(pair[1][-1])][1]
    if (numbered and labelled) or len(rows) < 2:
        raise InputError(
            "RIL-202",
            f"{path} has no projection matrices of {pair[0]} and {pair[1]}",
            remedy=f"give lines {wanted[0]}: and {wanted[1]}:" if labelled else "give two lines of 12 numbers",
        )
    return rows[0][1], rows[1][1]


def read_rig(layout: KittiLayout, sizes: Sizes) -> tuple[Rig, RigidTransform]:
    """The rig of images of these sizes, and T_reference_left (poses are those of the reference frame)."""
    cameras, poses = [], []
    for projection, name, size in zip(read_projections(layout.calib, layout.pair), layout.pair, sizes, strict=True):
        k, T_camera_reference = decompose(projection, name)
        fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        cameras.append(Camera(fx, fy, cx, cy, *size))
        check_focal(cameras[-1], name)
        poses.append(T_camera_reference)
    T_right_left = poses[1] @ poses[0].inverse()
    rig = Rig(cameras[0], cameras[1], T_right_left)
    if not rig.baseline > 0:
        raise InputError(
            "RIL-205", f"{layout.calib}: the two cameras stand in one place", remedy="check the fourth column of P"
        )
    if rig.baseline > LONGEST_BASELINE:
        raise InputError(
            "RIL-206",
            f"{layout.calib}: the baseline is {rig.baseline:g} m, which looks like millimetres",
            remedy=f"did you mean {rig.baseline / 1000:g} m? the fourth column of P is focal length times metres",
        )
    if T_right_left.translation[0] > 0.5 * rig.baseline:
        raise InputError(
            "RIL-207",
            f"{layout.calib}: the right camera stands {T_right_left.translation[0]:g} m to the left of the left one",
            remedy="swap the two lines or the two folders",
        )
    return rig, poses[0].inverse()


def _listing(folder: Path) -> dict[str, Path]:
    """Image files of a folder by stem."""
    out: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in files.SUFFIXES:
            if path.stem in out:
                raise InputError(
                    "RIL-208", f"{path} and {out[path.stem].name} are the same frame", remedy="remove one of them"
                )
            out[path.stem] = path
    return out


@dataclass(frozen=True)
class Listing:
    """Frame names in order, files of each camera by frame, and which lack a file, with the cause."""

    names: tuple[str, ...]
    paths: dict[str, dict[int, Path]]
    lost: dict[int, str]


def list_pairs(layout: KittiLayout) -> Listing:
    """The frames of both folders.

    A frame of which one image is missing is lost, and so is a number that is left out of a running count. Where more
    is missing than there, the folders do not belong together.
    """
    sides = {c: _listing(layout.folder / side) for c, side in zip(CAMERAS, layout.pair, strict=True)}
    left, right = sides["left"], sides["right"]
    present = {*left, *right}
    alone = sorted(set(left) ^ set(right))
    if len(alone) > len(present) - len(alone):
        ours, side = (left, layout.pair[1]) if alone[0] in left else (right, layout.pair[0])
        raise InputError(
            "RIL-209",
            f"{ours[alone[0]]} has no partner in {layout.folder / side} (and {len(alone) - 1} more)",
            remedy="add the missing images or remove these; `rille init` pairs names by number or time stamp",
        )
    names = sorted(present, key=lambda name: (natural(name), name))
    if not names:
        folder = layout.folder / layout.pair[0]
        raise InputError(
            "RIL-210",
            f"{folder} holds no images",
            remedy="; ".join([*unread(os.listdir(folder)), f"put files there: {', '.join(files.SUFFIXES)}"]),
        )
    names = _counted(names)
    lost, suffix = {}, next(iter({**left, **right}.values())).suffix
    for k, name in enumerate(names):
        absent = [
            f"{side}/{name}{suffix}" for c, side in zip(CAMERAS, layout.pair, strict=True) if name not in sides[c]
        ]
        if absent:
            lost[k] = f"{' and '.join(absent)} {'is' if len(absent) == 1 else 'are'} missing"
    paths = {c: {k: sides[c][n] for k, n in enumerate(names) if k not in lost} for c in CAMERAS}
    return Listing(tuple(names), paths, lost)


def _counted(names: list[str]) -> list[str]:
    """Names with the numbers that a running count leaves out; as they are where most do not count on by one."""
    if len(names) < 3 or not all(name.isdecimal() for name in names):
        return names
    numbers = [int(name) for name in names]
    steps = np.diff(numbers)
    if np.median(steps) != 1 or numbers[-1] - numbers[0] + 1 > 2 * len(names):
        return names
    given = dict(zip(numbers, names, strict=True))
    return [given.get(k, f"{k:0{len(names[0])}d}") for k in range(numbers[0], numbers[-1] + 1)]


def _per_frame(path: Path, numbers: int, listing: Listing, what: str) -> list[tuple[int, NDArray[np.float64]] | None]:
    """A row a frame with the line it stands in; rows of the frames with images alone leave None for the others."""
    rows = [(line, values) for line, _, values in _rows(path, numbers, what, gaps=what == "poses")]
    frames, there = len(listing.names), [k for k in range(len(listing.names)) if k not in listing.lost]
    if len(rows) == frames:
        return list(rows)
    if len(rows) != len(there):
        missing = f" ({len(listing.lost)} of {frames} frames lack an image)" if listing.lost else ""
        raise InputError(
            "RIL-211",
            f"{path} has {len(rows)} {what} for {len(there)} pairs ({ends(listing.names)}){missing}",
            remedy="give one line a pair, or remove the file",
        )
    by_frame = dict(zip(there, rows, strict=True))
    return [by_frame.get(k) for k in range(frames)]


def _times(path: Path, listing: Listing) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Time of each frame, s, and warnings; between its neighbours where a frame without images has none."""
    rows = _per_frame(path, 1, listing, "times")
    known = [k for k, row in enumerate(rows) if row is not None]
    given = [(line, float(values[0])) for line, values in filter(None, rows)]
    found, warnings = seconds([t for _, t in given], str(path), lines=[line for line, _ in given])
    return tuple(float(t) for t in np.interp(np.arange(len(rows)), known, found)), warnings


def open_kitti(layout: KittiLayout, digests: files.Digests) -> Sequence:
    """The sequence in a folder.

    Raises
    ------
    InputError
        A partner is missing, sizes or depths differ, a text file does not parse, or counts do not agree.
    """
    listing = list_pairs(layout)
    paths = listing.paths
    headers = {camera: files.common_header(list(paths[camera].values())) for camera in CAMERAS}
    rig, T_reference_left = read_rig(layout, sizes_of((headers["left"], headers["right"])))
    truth: tuple[RigidTransform | None, ...] | None = None
    times: tuple[float, ...] | None = None
    warnings: tuple[str, ...] = ()
    if layout.poses is not None:
        truth = tuple(
            None
            if row is None or np.isnan(row[1]).all()
            else rounded_pose(row[1].reshape(3, 4), f"{layout.poses}, line {row[0]}") @ T_reference_left
            for row in _per_frame(layout.poses, 12, listing, "poses")
        )
    if layout.times is not None:
        times, warnings = _times(layout.times, listing)

    def image(frame: int, camera: str) -> Source:
        return files.image_source(paths[camera][frame], frame, camera, headers[camera], digests)

    return Sequence(
        name=layout.name,
        rig=rig,
        frames=len(listing.names),
        image=image,
        frame_names=listing.names,
        times=times,
        truth=truth,
        truth_source=f"poses of {layout.poses.name}, as recorded" if layout.poses is not None else "",
        lost=listing.lost,
        defaults=STREET if rig.baseline >= CAR else {},
        warnings=(*warnings, *unusual(rig.left, "left"), *unusual(rig.right, "right")),
    )
