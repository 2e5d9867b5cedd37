"""Hostile files through the command line, as a user meets them: one line, within seconds and a bounded memory."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

pytestmark = pytest.mark.slow

LONGEST = 15
"""Seconds of a whole program, its start included, on a busy machine."""

MOST_MEMORY = 1_000_000
"""kB."""

K = "[50, 0, 32, 0, 50, 24, 0, 0, 1]"
CALIBRATION = f"M1: {K}\nM2: {K}\nD1: [0, 0, 0, 0]\nD2: [0, 0, 0, 0]\nR: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.1, 0, 0]\n"
MANIFEST = '[images]\nleft = "left/*"\nright = "right/*"\n[cameras]\nfile = "cal.yaml"\n'
ALIASES = "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 10))


def png(side: int) -> bytes:
    """Black, one bit a pixel: 109 kB for 900 megapixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes((side + 7) // 8 + 1)) for _ in range(side)) + packer.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.fixture
def folder(tmp_path):
    """A sequence that is right."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for k in range(2):
            cv2.imwrite(str(tmp_path / side / f"{k}.png"), np.full((48, 64), k, np.uint8))
    (tmp_path / "cal.yaml").write_text(CALIBRATION)
    (tmp_path / "m.toml").write_text(MANIFEST)
    return tmp_path


PROGRAM = r"""
import atexit, os, pathlib, re, runpy

def tell():
    status = pathlib.Path("/proc/self/status").read_text()
    pathlib.Path(os.environ["PEAK"]).write_text(re.search(r"VmHWM:\s*(\d+)", status)[1])

atexit.register(tell)
runpy.run_module("rille.pipeline.cli", run_name="__main__")
"""
"""The command line, which at its end says its own peak of memory: that of a child of this process begins with ours."""


def rille(folder, *words):
    """Exit code, lines on stderr and peak memory of a program, kB."""
    root, peak = Path(__file__).parents[2], folder.parent / f"{folder.name}-peak"
    env = os.environ | {"PYTHONPATH": str(root), "PEAK": str(peak)}
    argv = [sys.executable, "-c", PROGRAM, *map(str, words)]
    done = subprocess.run(argv, cwd=folder, env=env, timeout=LONGEST, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr.splitlines(), int(peak.read_text())


def refused(folder, code, *words):
    status, lines, peak = rille(folder, *words)
    assert [line.split(":")[1] for line in lines] == [f" error {code}"], lines
    assert status == 2
    assert 10_000 < peak < MOST_MEMORY


@pytest.mark.parametrize("name", ["../../x", "/tmp/x"])
@pytest.mark.parametrize("verb", ["check", "reconstruct"])
def test_a_name_stays_within_the_folder_of_runs(folder, verb, name):
    (folder / "m.toml").write_text(f'name = "{name}"\n{MANIFEST}')
    refused(folder, "RIL-764", verb, "m.toml", "--cache", "cache")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (ALIASES, "RIL-758"),
        ("K: [" + "1," * 1_950_000 + "1]\n", "RIL-139"),
        ("K: " + "[" * 100_000, "RIL-759"),
        ("fu = 1\nk = a" + " " * 900_000 + "b\n", "RIL-113"),
        ("K: [" + "9" * 5000 + "]", "RIL-116"),
    ],
)
def test_calibrations(folder, text, code):
    (folder / "cal.yaml").write_text(text)
    refused(folder, code, "check", "m.toml", "--cache", "cache")


def test_pipes_and_devices(folder):
    (folder / "cal.yaml").unlink()
    os.mkfifo(folder / "cal.yaml")
    refused(folder, "RIL-138", "check", "m.toml", "--cache", "cache")
    refused(folder, "RIL-138", "reconstruct", "mockup-short", "--config", "/dev/zero", "--cache", "cache")


@pytest.mark.parametrize(
    ("head", "code"),
    [
        ("".join(f"k{k}=1\n" for k in range(100_000)), "RIL-223"),
        ("x = " + "9" * 5000 + "\n", "RIL-026"),
        ("x = " + "[" * 5000 + "\n", "RIL-026"),
    ],
)
def test_manifests(folder, head, code):
    (folder / "m.toml").write_text(head + MANIFEST)
    refused(folder, code, "check", "m.toml", "--cache", "cache")


def test_a_pattern_that_walks_the_disk(folder):
    (folder / "m.toml").write_text('root = "/"\n' + MANIFEST.replace("left/*", "**/*").replace("right/*", "**/*"))
    _, lines, peak = rille(folder, "check", "m.toml", "--cache", "cache")
    assert len(lines) == 1  # too much to look at, or, on a small disk, no pairs
    assert 10_000 < peak < MOST_MEMORY


def test_images(folder):
    bomb = png(30_000)
    assert len(bomb) < 120_000
    (folder / "left" / "1.png").write_bytes(bomb)
    refused(folder, "RIL-176", "reconstruct", "m.toml", "--cache", "cache")
    refused(folder, "RIL-762", "match", "left/1.png", "right/1.png")
    refused(folder, "RIL-762", "calibrate", "left", "right", "--square", "0.03")
