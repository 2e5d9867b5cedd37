"""Any folder of stereo images as a sequence, described by a manifest (TOML, see :mod:`rille.datasets.manifest.model`).

The manifest states the files of the pairs, the cameras, and other known data: times, truth, attitude, odometry, IMU,
vehicle. Nothing is repaired silently: an impossible value is an error with its key, a suspicious one a warning with its
figure, which a run prints and goes on.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rille.datasets.bags import is_bag, open_bag
from rille.datasets.cameras.model import RECTIFIED
from rille.datasets.images import disparities, files
from rille.datasets.images.headers import sizes_of
from rille.datasets.images.pairing import ImagePair, common_headers, pair_up
from rille.datasets.manifest.model import Cameras, Disparity, DisparityMaps, Images, Manifest, read_manifest
from rille.datasets.manifest.motion import MotionReader
from rille.datasets.manifest.rig import read_optics
from rille.datasets.protocol import Sequence, Source
from rille.datasets.text.names import derived_name, writable
from rille.datasets.text.reading import Search, nearest_hint
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import IncompleteError, InputError, within

VARIABLE = re.compile(r"\$\{(\w+)\}")


def open_manifest(path: Path, digests: files.Digests) -> Sequence:
    """The sequence that a manifest describes.

    Raises
    ------
    InputError
        The manifest or a file that it names cannot be used; the message names the file and the key.
    """
    manifest = read_manifest(path)
    named = manifest.model_copy(update={"name": manifest.name or default_name(path)})
    return open_described(named, root_folder(manifest.root, path), str(path), digests)


def open_folder(manifest: Manifest, folder: Path, digests: files.Digests, spare: Iterable[Path]) -> Sequence:
    """The sequence of a folder by the manifest of its layout, whose reader finds the files of ``spare`` by itself."""
    try:
        return open_described(manifest, folder, str(folder), digests)
    except InputError as error:
        wrong = next((path for path in spare if str(path) in error.message), None)
        if wrong is None:
            raise
        remedy = f"{error.remedy}; or rename {wrong}: the folder opens without it"
        raise type(error)(error.code, error.message, remedy=remedy) from error


def open_described(manifest: Manifest, root: Path, name: str, digests: files.Digests) -> Sequence:
    """The sequence of a manifest, which comes from a file or from the reader of a folder layout.

    Parameters
    ----------
    root : folder that the files are relative to.
    name : the manifest's or the folder's, for errors.
    """
    with within(name):
        return _described(manifest, root, digests)


def _described(manifest: Manifest, root: Path, digests: files.Digests) -> Sequence:
    base, pairs = _of_bag(manifest, root) or _of_files(manifest, root, digests)
    if manifest.disparity is not None:
        disparity, absent, scale = _disparity("disparity", manifest.disparity, root, base, pairs, digests)
        note = f"disparities are those of {manifest.disparity.left}{scale}, made by another program, and checked"
        base = replace(base, disparity=disparity, lost={**absent, **base.lost}, notes=(*base.notes, note))
    if manifest.truth_disparity is not None:
        exact, absent, scale = _disparity("truth_disparity", manifest.truth_disparity, root, base, pairs, digests)
        note = f"true disparities are those of {manifest.truth_disparity.left}{scale}; they only judge"
        if absent:
            note += f" {len(pairs) - len(absent)} of {len(pairs)} pairs: {next(iter(absent.values()))}"

        def judged(frame: int) -> Source | None:
            return None if frame in absent else exact(frame)

        base = replace(base, truth_disparity=judged, notes=(*base.notes, note))
    sequence = MotionReader(root, pairs, base, digests.growing, manifest.world.crs or "").read(manifest)
    world, pinned = manifest.world, {} if manifest.rig.file is None else {"rig.mode": "fixed"}
    return replace(
        sequence,
        name=manifest.name,
        pitch=None if world.pitch_deg is None else math.radians(world.pitch_deg),
        georeference=world.place,
        masks={side: root / path for side, path in manifest.masks if path is not None},
        vehicle=manifest.vehicle,
        # A pinned rig is that of all pieces of a log, so no run may repair it.
        defaults={**sequence.defaults, **pinned, **dict(dotted(manifest.defaults))},
        notes=(*sequence.notes, *manifest.notes),
    )


def _are_rectified(images: Images, names: Iterable[str]) -> bool:
    """Whether the images are rectified, as stated, or by the names of files and folders, or of topics."""
    return all(map(RECTIFIED.search, names)) if images.rectified is None else images.rectified


def _of_files(manifest: Manifest, root: Path, digests: files.Digests) -> tuple[Sequence, tuple[ImagePair, ...]]:
    """Images and cameras of a manifest that names files."""
    lines: list[str] = []
    headers, pairs = common_headers(find_pairs(manifest.images, root, lines, digests))
    names = (os.path.relpath(path, root.parent) for path in (pairs[0].left, pairs[0].right))
    optics = read_optics(manifest, root, sizes_of(headers), _are_rectified(manifest.images, names))

    def image(frame: int, camera: str) -> Source:
        pair = pairs[frame]
        path, header = (pair.left, headers[0]) if camera == "left" else (pair.right, headers[1])
        return files.image_source(path, frame, camera, header, digests)

    sequence = Sequence(
        name="images",
        rig=optics.rig,
        frames=len(pairs),
        image=image,
        frame_names=tuple(pair.name for pair in pairs),
        lenses=optics.lenses,
        up=None if optics.up is None else (optics.up,) * len(pairs),
        lost={k: pair.absent for k, pair in enumerate(pairs) if pair.absent},
        warnings=(*lines, *optics.warnings),
    )
    return sequence, pairs


def _of_bag(manifest: Manifest, root: Path) -> tuple[Sequence, tuple[ImagePair, ...]] | None:
    """Images and cameras of a manifest that names a bag, whose ``camera_info`` is used if it states no cameras."""
    (path, _, left), (other, _, right) = (text.partition(":") for text in (manifest.images.left, manifest.images.right))
    if path != other or not is_bag(root / path):
        return None
    stated = manifest.cameras != Cameras() or manifest.rig.file is not None
    topics = f"{left},{right}" if left and right else None
    rectified = _are_rectified(manifest.images, (left, right))
    optics_of = (lambda sizes: read_optics(manifest, root, sizes, rectified)) if stated else None
    sequence = open_bag((root / path).resolve(), topics, optics_of, manifest.images.tolerance, manifest.rig)
    return sequence, tuple(ImagePair(stamp, Path(stamp), Path(stamp)) for stamp in sequence.frame_names)


def _disparity(
    key: str,
    stated: DisparityMaps,
    root: Path,
    sequence: Sequence,
    pairs: tuple[ImagePair, ...],
    digests: files.Digests,
) -> tuple[Callable[[int], Source], dict[int, str], str]:
    """Function that returns the source of another program's, or of the true disparity of a frame; why frames have none;
    and a remark on the scale of the maps. ``key``: name of the table."""
    if sequence.lenses:
        text = f"[{key}] needs images without distortion: maps are of undistorted, rectified images"
        remedy = f"give the images that the maps were made of (images.rectified = true), or leave [{key}] out"
        raise InputError("RIL-902", text, remedy=remedy)
    lefts = [pair.left for pair in pairs if not pair.absent]
    maps = {"column_disparity": disparities.find(stated.left, root, lefts, f"{key}.left")}
    claimed = stated.sigma if isinstance(stated, Disparity) else None
    sigma = claimed if isinstance(claimed, float) else None
    if isinstance(claimed, str):
        maps["disparity_std"] = disparities.find(claimed, root, lefts, f"{key}.sigma")
    size = sequence.rig.left.width, sequence.rig.left.height
    common, turn = {"size": list(size), "sigma": sigma}, -1.0 if stated.sign == "left-right" else 1.0
    read = {a: disparities.scales(of, size, None if a == "disparity_std" else stated.scale) for a, of in maps.items()}
    bad = {left: scale for of in read.values() for left, scale in of.items() if isinstance(scale, InputError)}
    scales = {a: {k: s for k, s in of.items() if not isinstance(s, InputError)} for a, of in read.items()}
    if bad and not set.intersection(*map(set, maps.values())) - bad.keys():
        raise next(iter(bad.values()))

    def source(frame: int) -> Source:
        paths = {array: of[pairs[frame].left] for array, of in maps.items()}
        digest = {array: digests.sha256(path) for array, path in paths.items()}
        scale = {array: of[pairs[frame].left] for array, of in scales.items()}
        scale["column_disparity"] *= turn
        args = {**common, "frame": frame, "digests": digest, "scales": scale}
        hints = {"paths": {array: str(path.resolve()) for array, path in paths.items()}}
        return Source("rille.datasets.images.disparities", NoParams(), args, hints)

    absent = {left: f"{error.message} ({key})" for left, error in bad.items()}
    lacking = (pair.left for pair in pairs if any(pair.left not in of for of in maps.values()))
    absent |= {left: f"the map of {left.name} ({key}) is missing" for left in lacking}
    remark = "".join(f" ({s:g} values a pixel)" for s in sorted({*scales["column_disparity"].values()} - {1.0}))
    return source, {k: absent[pair.left] for k, pair in enumerate(pairs) if pair.left in absent}, remark


def default_name(path: Path) -> str:
    """Name of a sequence whose manifest has none: that of the file, or of its folder for ``manifest.toml``."""
    stem = path.name.removesuffix(".toml").removesuffix(".rille")
    return derived_name(path.resolve().parent.name if stem == "manifest" else stem)


def root_folder(text: str, path: Path) -> Path:
    """Folder that a manifest's files are relative to.

    Raises
    ------
    InputError
        A variable of the environment is not set, or there is no such folder.
    """

    def value(match: re.Match[str]) -> str:
        if not os.environ.get(match[1]):
            words = f"{path}: root = {text!r} needs the environment variable {match[1]}, which is not set"
            raise InputError("RIL-214", words, remedy=f"export {match[1]}=FOLDER")
        return os.environ[match[1]]

    root = path.resolve().parent / os.path.expanduser(VARIABLE.sub(value, text))
    if not os.path.isdir(root):
        words = f"{path}: root = {text!r}: there is no folder {root}"
        raise InputError("RIL-215", words, remedy="correct root, or its variable")
    return root


def find_pairs(images: Images, root: Path, lines: list[str], digests: files.Digests) -> tuple[ImagePair, ...]:
    """The pairs that match the patterns; if paired by name, some may lack a file (``ImagePair.absent``).

    Parameters
    ----------
    lines : takes warnings.

    Raises
    ------
    InputError
        A pattern matches no file, both match the same files, or images have no partners.
    """
    found, search = list[list[Path]](), Search()
    for side, stated in (("left", images.left), ("right", images.right)):
        # A folder stands for its files.
        pattern = f"{stated.rstrip('/')}/*" if stated and os.path.isdir(root / stated) else stated
        with within(f"images.{side}"):
            paths = search.matching(root, pattern)
        if pattern.endswith("*"):  # other files may lie beside the images
            paths = [path for path in paths if path.suffix.lower() in files.SUFFIXES] or paths
        paths = [path for path in paths if digests.whole(path)]
        for path in paths:
            writable(path.name)
        if not paths:
            within_root = "" if pattern.startswith("/") else f" in {root}"
            text = "; ".join([f"images.{side} = {pattern!r} finds no file{within_root}", *search.closed[:1]])
            raise IncompleteError(
                "RIL-217", text, remedy=f"{nearest_hint(root / pattern)}correct the pattern, root or rights"
            )
        found.append(paths)
    left, right = found
    if both := sorted(set(left) & set(right)):
        text = f"images.left and images.right both find {both[0]}"
        raise InputError("RIL-218", text, remedy="narrow the patterns")
    return pair_up(left, right, images.pair, growing=digests.growing, tolerance=images.tolerance, warnings=lines)


def dotted(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """``{"locus": {"cell_size": 0.1}}`` as ``[("locus.cell_size", 0.1)]``; keys may be dotted already."""
    flat: list[tuple[str, Any]] = []
    for key, value in values.items():
        flat += dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [(prefix + key, value)]
    return flat
