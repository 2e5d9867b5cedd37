"""Kinds of files that Rille does not read, by their endings, and how to convert them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import PurePath

from rille.stages.core.quantities import count, some


def split(what: str, name: str) -> str:
    """How to take apart a file FILE in which both views stand side by side, or one above the other; ``name``: of each
    half."""
    halves = (f"-vf crop=iw/2:ih:{left}:0 {side}/{name}" for side, left in (("left", "0"), ("right", "iw/2")))
    above = "one above the other, crop=iw:ih/2:0:0 and crop=iw:ih/2:0:ih/2"
    return f"if {what} both views: mkdir left right; ffmpeg -i FILE {' '.join(halves)} ({above})"


KINDS: dict[str, tuple[str, str]] = {
    "video": (
        ".mp4 .m4v .mov .avi .mkv .webm .mpg .mpeg .mjpeg .h264 .h265 .hevc",
        "take its images out, a folder a camera: mkdir left; ffmpeg -i FILE left/%06d.png; "
        + split("it shows", "%06d.png"),
    ),
    "stereo image": (
        ".mpo .jps .pns",
        "take its views apart, a folder a camera: of .mpo exiftool -b -MPImage2 FILE; of others, whose right view comes"
        " first, magick FILE -crop 2x1@",
    ),
    "ZED recording": (".svo .svo2", "export left and right images with the ZED SDK (its sample svo_export)"),
    "bag": (".bag .mcap .db3", "give it instead of the folder: rille check FILE (of ROS 2, its folder)"),
    "array": (
        ".npy",
        "python -c \"import sys, cv2, numpy as n; [cv2.imwrite(f[:-3] + 'png', n.load(f)) for f in sys.argv[1:]]\""
        " FILES; of a table write text: numpy.savetxt",
    ),
    "matrix file": (
        ".npz .mat .pkl .pickle .feather .parquet .h5",
        "if it is the calibration, write it as text: w = cv2.FileStorage('stereo.yml', 1), w.write('K1', K1), and so "
        "D1, K2, D2, R, T (MATLAB's K and R transposed)",
    ),
    "image": (
        ".webp .jp2 .j2k .pbm .pam .exr .hdr .heic .heif .avif .jxl .gif .tga .dng .nef .cr2 .cr3 .arw .raf .orf .rw2",
        "convert them: magick mogrify -format png FILES",
    ),
    "planetary image": (
        ".img .vic .vicar .cub .fit .fits",
        "convert them, without a stretch of each: gdal_translate -of PNG -ot UInt16 FILE FILE.png",
    ),
    "COLMAP file": (
        "cameras.bin images.bin points3D.bin rigs.bin frames.bin",
        "colmap model_converter --input_path FOLDER --output_path FOLDER --output_type TXT",
    ),
    "headerless image": (
        ".raw .bin .yuv .bayer",
        "state its size and bits: magick -size WIDTHxHEIGHT -depth 8 gray:FILE FILE.png",
    ),
    "track": (".gpx .kml .kmz .nmea .ubx", "write it as a table with the names time,latitude,longitude,altitude"),
    "archive": (".zip .tar .gz .tgz .bz2 .xz .7z .rar .zst", "unpack it"),
    "file": ("", "neither images nor a calibration or table that is known"),
}
"""Endings, or names, and remedy by the name of a kind; the kind ``file`` is any other."""


def kind_of(name: str) -> str:
    """The kind of a file by its name or its ending."""
    of = {PurePath(name).name, PurePath(name).suffix.lower()}
    return next((kind for kind, (names, _) in KINDS.items() if not of.isdisjoint(names.split())), "file")


def hints(name: str) -> list[str]:
    """Remedy for a file of a known kind: one line, or none."""
    return unread([name] if kind_of(name) != "file" else [])


def unread(names: Iterable[str]) -> list[str]:
    """A line for each kind of file that is not read: their number, the first one, the remedy."""
    groups: dict[str, list[str]] = defaultdict(list)
    for name in names:
        groups[kind_of(name)].append(name)
    return [line(kind, of, KINDS[kind][1]) for kind, of in groups.items()]


def line(kind: str, names: list[str], remedy: str) -> str:
    """Files of a kind in one line: their number, the first one, the remedy."""
    return f"{count(len(names), kind)} ({some(names, 1)}): {remedy}"
