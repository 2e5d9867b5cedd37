"""Damaged and hostile files for every reader: seeds that are right (``tests/seeds``), and what mutations make of them.

A reader may take a file or refuse it by one of Rille's own errors; anything else that it raises, and anything that
takes long or much memory, is a fault of the reader.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from folders import CAMERAS, RIG, write_images

from rille.datasets.cameras import read_cameras, rig_of
from rille.datasets.images import files
from rille.datasets.inspection.folder import inspect
from rille.datasets.manifest.opening import open_manifest
from rille.datasets.registry import open_sequence
from rille.datasets.text.reading import read_toml
from rille.pipeline.engine.store.arrays import codec
from rille.pipeline.engine.store.artifact import artifact_path, pack
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.read_dem import read_raster
from rille.pipeline.flow import config
from rille.stages.core.errors import RilleError

SEEDS = Path(__file__).parents[1] / "seeds"

LONGEST = 5
"""Seconds."""

IMAGES = '[images]\nleft = "left/*.png"\nright = "right/*.png"\n'
NAMES = [f"{side}/{k:02d}.png" for k in range(3) for side in ("left", "right")]
STAMPS = [1403715273262142976 + k * 50_000_000 for k in range(3)]
IDENTITY = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]"


def _folder(at: Path, head: str, more: str = "") -> None:
    (at / "m.toml").write_text(head + IMAGES + more)
    open_manifest(at / "m.toml", files.Digests())


def manifest(path: Path) -> None:
    open_manifest(path, files.Digests())


def calibration(path: Path) -> None:
    cameras = read_cameras(path)
    if len(cameras) == 2:
        rig_of(cameras[0], cameras[1], tuple(camera.size or (640, 480) for camera in cameras[:2]))


def rigs(path: Path) -> None:
    calibration(Path(shutil.copy(SEEDS / "calibration" / "colmap.txt", path.with_name("cameras.txt"))))


def poses(path: Path) -> None:
    rest = CAMERAS + RIG + f'[truth]\nfile = "{path.name}"\nmax_gap = 5.0\n[attitude]\nfile = "{path.name}"\n'
    _folder(path.parent, "", rest + "[times]\nrate_hz = 1.0\n")
    inspect(path.parent)


def imu(path: Path) -> None:
    rest = CAMERAS + RIG + f'[imu]\nfile = "{path.name}"\nT_imu_left = {IDENTITY}\n'
    _folder(path.parent, "", rest + "[times]\nrate_hz = 1.0\n")
    inspect(path.parent)


def times(path: Path) -> None:
    _folder(path.parent, "", CAMERAS + RIG + f'[times]\nfile = "{path.name}"\n')


def configuration(path: Path) -> None:
    for_dataset, for_stages = config.split_dataset(read_toml(path, "configuration"))
    config.to_toml(config.build(for_stages))
    open_sequence("mockup-short", for_dataset)


def image(path: Path) -> None:
    try:
        files.common_header([path, path])
    finally:
        files.read_grey(path)


def raster(path: Path) -> None:
    read_raster(path)


def kitti(path: Path) -> None:
    open_sequence(str(path.parent))


def euroc(path: Path) -> None:
    open_sequence(str(path.parents[2]))


def packed(path: Path) -> None:
    _lookup(path.parent / "cache", path.read_bytes())


def artifact(path: Path) -> None:
    """A manifest that is wrong behind a checksum that is right."""
    _lookup(path.parent / "cache", bytes(pack({"manifest.json": path.read_bytes(), "values/c.0.0": CHUNK})))


def _lookup(cache: Path, data: bytes) -> None:
    """What damage there is counts as absent; what is taken is read."""
    store = Store(cache)
    place = cache / artifact_path("numbers", KEY)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(data)
    ref = store.lookup("numbers", KEY)
    if ref is None:
        raise RilleError("RIL-000", "it is absent")
    dict(store.open(ref).arrays)


READERS: dict[str, Callable[[Path], None]] = {
    "manifest": manifest,
    "calibration": calibration,
    "rigs": rigs,
    "poses": poses,
    "imu": imu,
    "times": times,
    "config": configuration,
    "image": image,
    "raster": raster,
    "kitti": kitti,
    "euroc": euroc,
    "packed": packed,
    "artifact": artifact,
}


# -- seeds -------------------------------------------------------------------------------------------------------------

KEY = "a" * 64
VALUES = np.arange(12, dtype="<f4").reshape(3, 4)
CHUNK = codec().encode(VALUES)
MANIFEST = {
    "stage": "numbers",
    "label": "numbers/0",
    "key": KEY,
    "digest": "b" * 64,
    "arrays": {"values": {"dtype": "<f4", "shape": [3, 4], "chunks": [3, 4], "sha256": "c" * 64}},
    "meta": {"frame": 0},
    "provenance": {"reason": "new"},
}
MADE: dict[str, bytes] = {
    "artifact/made": json.dumps(MANIFEST).encode(),
    "packed/made": bytes(pack({"manifest.json": json.dumps(MANIFEST).encode(), "values/c.0.0": CHUNK})),
}
"""Seeds of what Rille itself writes."""


@cache
def seeds() -> dict[str, bytes]:
    """Content of all seeds by ``reader/file``."""
    stored = {p.relative_to(SEEDS).as_posix(): p.read_bytes() for p in sorted(SEEDS.rglob("*")) if p.is_file()}
    return stored | MADE


def scene(name: str, folder: Path) -> Path:
    """The folder in which a seed is read, everything else in it right; gives the file to write."""
    reader, _, rest = name.partition("/")
    if reader in ("kitti", "euroc"):
        shutil.copytree(SEEDS / reader, folder, dirs_exist_ok=True)
    if reader == "kitti":
        write_images(folder, [f"image_{s}/{k:06d}.png" for k in range(3) for s in (0, 1)])
    elif reader == "euroc":
        write_images(folder, [f"mav0/{c}/data/{stamp}.png" for stamp in STAMPS for c in ("cam0", "cam1")])
    elif reader in ("manifest", "calibration", "rigs", "poses", "imu", "times"):
        write_images(folder, NAMES)
    if reader == "manifest":
        for part in ("poses/truth.tum", "poses/attitude.csv", "imu/imu.csv", "times/times.txt"):
            shutil.copy(SEEDS / part, folder)
        shutil.copy(SEEDS / "calibration" / "opencv_stereo.yml", folder / "cal.yaml")
    path = folder / rest
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


# -- mutations ---------------------------------------------------------------------------------------------------------

ODD = [
    b"nan", b"-inf", b"1e308", b"-1e308", b"1e999", b"1e99999999", b"5e-324", b"0", b"-0", b"-1", b"0.5", b"1e20",
    b"9" * 400, b"9" * 5000, b"18446744073709551616", b"0x10", b"1_0", b"1:59:59", b"\xd9\xa3", b"true", b"null", b"",
    b'"', b"[", b"{", b"'''", b"*a", b"&a", b"<<", b"!!python/name:os.system", b"../../x", b"/dev/zero", b"/", b"**/*",
    b"${HOME}", b"\x00", b"\xff", b"\xef\xbb\xbf", b"\r", b"\n\n", b"\x1b[2J", b",", b";", b"=", b"#", b"\\u0000",
]  # fmt: skip
"""What is put where a number or a word was."""


def mutate(data: bytes, rng: random.Random) -> bytes:
    """A few mutations, one upon the other."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        data = rng.choice(MUTATIONS)(data, rng)[:500_000]
    return data


def _place(data: bytes, rng: random.Random) -> tuple[int, int]:
    """A stretch."""
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((0, 1, 2, 8, 64, 500)))


def _flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 2, 8))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start, stop = _place(data, rng)
    return data[:start] + data[stop:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start, stop = _place(data, rng)
    return data[:start] + data[start:stop] * rng.choice((2, 3, 50, 1000)) + data[stop:]


def _insert(data: bytes, rng: random.Random) -> bytes:
    start, _ = _place(data, rng)
    return data[:start] + rng.choice(ODD) + data[start:]


def _nest(data: bytes, rng: random.Random) -> bytes:
    start, _ = _place(data, rng)
    piece = rng.choice((b"[", b"{a: ", b'{"a":', b"<a>", b"(", b"a.", b"- ", b" ", b"\n"))
    return data[:start] + piece * rng.choice((3, 40, 3000, 100_000)) + data[start:]


def _spans(data: bytes, kind: str) -> list[tuple[int, int]]:
    import re

    pattern = {"number": rb"[-+]?[0-9][0-9.eE+-]*", "word": rb"[A-Za-z_][\w.]*", "line": rb"[^\n]+\n?"}[kind]
    return [m.span() for m in re.finditer(pattern, data)]


def _change(kind: str) -> Callable[[bytes, random.Random], bytes]:
    def change(data: bytes, rng: random.Random) -> bytes:
        spans = _spans(data, kind)
        if not spans:
            return data
        start, stop = rng.choice(spans)
        a, b = rng.choice(spans)
        new = data[a:b] if rng.random() < 0.3 else rng.choice(ODD)
        return data[:start] + new + data[stop:]

    return change


def _double_line(data: bytes, rng: random.Random) -> bytes:
    spans = _spans(data, "line")
    if not spans:
        return data
    (a, b), (at, _) = rng.choice(spans), rng.choice(spans)
    return data[:at] + data[a:b] + data[at:]


def _without_line(data: bytes, rng: random.Random) -> bytes:
    spans = _spans(data, "line")
    if not spans:
        return data
    a, b = rng.choice(spans)
    return data[:a] + data[b:]


def _splice(data: bytes, rng: random.Random) -> bytes:
    other = rng.choice(list(seeds().values()))
    start, (a, b) = rng.randrange(len(data) + 1), _place(other, rng)
    return data[:start] + other[a:b] + data[start:]


MUTATIONS = [
    _flip, _cut, _remove, _repeat, _insert, _nest, _change("number"), _change("number"), _change("word"),
    _change("line"), _double_line, _without_line, _splice,
]  # fmt: skip


# -- running -----------------------------------------------------------------------------------------------------------


class TooLongError(Exception):
    """A reader did not end."""


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise where the body takes longer."""

    def stop(*_: object) -> None:
        raise TooLongError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def read(name: str, data: bytes, folder: Path) -> str:
    """Read a file as what its name says: ``taken``, or the code of the error by which it is refused."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = scene(name, folder)
    path.write_bytes(data)
    try:
        with within(LONGEST):
            READERS[name.partition("/")[0]](path)
    except RilleError as error:
        return error.code
    return "taken"
