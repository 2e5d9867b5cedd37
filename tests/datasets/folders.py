"""Small folders of stereo images, written for tests of readers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

SIZE = (64, 48)

CAMERAS = "[cameras]\nfx = 60.0\ncx = 31.5\ncy = 23.5\n"
RIG = "[rig]\nbaseline = 0.1\n"


def write_images(folder: Path, names: list[str], size: tuple[int, int] = SIZE) -> None:
    """Grey PNG files, each of another grey value."""
    for k, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), np.full((size[1], size[0]), k, np.uint8))


def write_sequence(
    folder: Path, text: str = "", frames: int = 3, *, cameras: str = CAMERAS, rig: str = RIG, head: str = ""
) -> Path:
    """Folder with ``left/NN.png`` and ``right/NN.png`` and a manifest; gives the manifest."""
    write_images(folder, [f"{side}/{k:02d}.png" for k in range(frames) for side in ("left", "right")])
    path = folder / "rover.rille.toml"
    images = '[images]\nleft = "left/*.png"\nright = "right/*.png"\n'
    path.write_text("\n".join([head, images, cameras, rig, text]))
    return path


def write_lines(path: Path, lines: list[str]) -> None:
    """A text file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
