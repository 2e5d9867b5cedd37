"""Open ROS bags; stage ``image`` for their images: one message, checked and grey."""

from __future__ import annotations

import hashlib
import resource
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from rille.datasets.facts import ImageFacts
from rille.datasets.images import files
from rille.datasets.images.files import Grey
from rille.datasets.images.headers import Header, read_header
from rille.datasets.text.reading import open_regular
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.core.errors import InputError, RilleError
from rille.stages.imaging.levels import Levels, spread

COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"

LAYOUTS: Mapping[str, tuple[int, int, int | None]] = {
    "mono8": (1, 8, None),
    "8UC1": (1, 8, None),
    "mono16": (1, 16, None),
    "16UC1": (1, 16, None),
    "rgb8": (3, 8, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, 8, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, 8, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, 8, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, 8, cv2.COLOR_BGRA2GRAY),
    # Of USB cameras; every other byte is the luminance.
    **dict.fromkeys(("yuv422", "uyvy"), (2, 8, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, 8, cv2.COLOR_YUV2GRAY_YUY2)),
    **{
        f"bayer_{filters}{bits}": (1, bits, getattr(cv2, f"COLOR_Bayer{filters.upper()}2GRAY"))
        for filters in ("rggb", "bggr", "gbrg", "grbg")
        for bits in (8, 16)
    },
}
"""Samples per pixel, bits per sample and OpenCV's conversion to grey, by encoding of ``sensor_msgs/msg/Image``."""


MAX_UNPACKED_BYTES = 2 << 30
"""Most additional memory for a bag: chunks and messages have some MB, but may unpack to any size, whatever they
state."""

_LIMITS = resource.getrlimit(resource.RLIMIT_AS)


class Message(NamedTuple):
    """Place of a message: ``path`` of the bag, ``topic``, and ``at``, the time of its recording, ns."""

    path: str
    topic: str
    at: int


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The reader of a ROS 1 or ROS 2 bag or of an mcap file (``rosbags.highlevel.AnyReader``).

    Raises
    ------
    InputError
        The package is not installed, or the bag cannot be read or unpacks without bound, now or while it is open.
    """
    import psutil

    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        text = f"{path}: bags are read by the package rosbags"
        raise InputError("RIL-940", text, remedy="pip install 'rille[robots]'") from error
    for file in path.iterdir() if path.is_dir() else (path,):
        if not file.is_dir():
            open_regular(file, "bag", sys.maxsize).close()
    soft, hard = _LIMITS
    most = psutil.Process().memory_info().vms + MAX_UNPACKED_BYTES
    try:
        resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(soft, most), hard))
        # Bags of ROS 2 before Iron hold no definitions of their messages.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except RilleError:
        raise
    except MemoryError as error:
        text = f"{path} cannot be read in {MAX_UNPACKED_BYTES / 2**30:g} GiB: a chunk or message of it unpacks to more"
        raise InputError("RIL-939", text, remedy="no recorder does that: write it anew in chunks of some MB") from error
    except Exception as error:  # a damaged bag: parsers of five formats raise anything
        reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        text = f"{path} cannot be read as a bag: {reason}"
        remedy = "copy it again; `mcap recover` or `rosbag reindex` mends a recording that broke off"
        raise InputError("RIL-941", text, remedy=remedy) from error
    finally:
        resource.setrlimit(resource.RLIMIT_AS, _LIMITS)


def depth(message: Any, name: str) -> Header:
    """Width, height and bits of the image of a message, from its beginning: later damage costs the frame alone."""
    if hasattr(message, "format"):
        return files.usable(read_header(BytesIO(bytes(message.data))), name)
    return Header(int(message.width), int(message.height), _layout(message, name)[1])


def grey_of(message: Any, name: str, wanted: Header) -> Grey:
    """Grey image (row, col), uint8 or uint16, of a message.

    Parameters
    ----------
    message : ``sensor_msgs/msg/Image`` or ``CompressedImage``.
    name : for errors.
    wanted : required size and depth.

    Raises
    ------
    InputError
        Its encoding is not known, it does not decode, or its size differs.
    """
    if hasattr(message, "format"):
        return files.decode(bytes(message.data), name, wanted)
    samples, bits, conversion = _layout(message, name)
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    files.check_size(Header(columns, rows, bits), wanted, name)
    width = columns * samples * bits // 8
    # Rows may be padded to `step` bytes (sensor_msgs/msg/Image), and data may be missing.
    data = np.frombuffer(bytes(message.data), np.uint8)
    if step < width or len(data) < rows * step:
        text = f"{name} has {len(data)} bytes in rows of {step}, {columns} x {rows} pixels need rows of {width}"
        raise InputError("RIL-942", text, remedy=files.COPY_AGAIN)
    pixels = np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, :width])
    if bits == 16:
        pixels = np.ascontiguousarray(pixels.view(">u2" if message.is_bigendian else "<u2"), dtype=np.uint16)
    image = pixels.reshape(rows, columns, samples) if samples > 1 else pixels
    return image if conversion is None else cv2.cvtColor(image, conversion)


def _layout(message: Any, name: str) -> tuple[int, int, int | None]:
    if message.encoding not in LAYOUTS:
        text = f"{name} has the encoding {str(message.encoding)[:40]!r}"
        raise InputError("RIL-943", text, remedy=f"record one of {', '.join(LAYOUTS)}, or compressed PNG or JPEG")
    return LAYOUTS[message.encoding]


@stage("image", outputs=files.image_stage.outputs)
def bag_image_stage(
    params: NoParams,
    *,
    frame: int,
    camera: str,
    message: Message,
    sha256: str,
    header: Header,
    levels: Levels | None = None,
) -> Bundle[ImageFacts]:
    """One image of a bag, checked and grey."""
    name = f"frame {frame}, {camera} image of {message.path}"
    with opened(Path(message.path)) as reader:
        there = [c for c in reader.connections if c.topic == message.topic]
        for connection, _, data in reader.messages(there, start=message.at, stop=message.at + 1) if there else ():
            if hashlib.sha256(data).hexdigest() == sha256:
                content = reader.deserialize(data, connection.msgtype)
                break
        else:
            raise InputError("RIL-944", f"{name} has changed since the run began", remedy="run the same command again")
    try:
        image = spread(grey_of(content, f"{camera} image", header), levels)
    except InputError as error:
        return files.empty(frame, camera, header, error)
    return Bundle({"image": image, "valid": np.ones(image.shape, np.uint8)}, {"frame": frame, "camera": camera})
