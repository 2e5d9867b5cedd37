"""Images that are still arriving: which files count as whole, and what a sequence is meanwhile."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_lines, write_sequence
from raising import raises

from rille.datasets.images import arrivals
from rille.datasets.images.arrivals import Arrivals
from rille.datasets.manifest.opening import open_manifest
from rille.datasets.protocol import Sequence


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr(arrivals, "SETTLE_SECONDS", 0.0)


def opened(path: Path, files: Arrivals | None = None) -> Sequence:
    """The sequence by files that have been seen before."""
    files = files or Arrivals()
    for image in (*path.parent.glob("left/*"), *path.parent.glob("right/*")):
        files.whole(image)
    return open_manifest(path, files)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif", ".pgm", ".bmp"])
def test_a_file_that_grows_counts_once_it_rests_and_decodes(tmp_path, ending):
    image = np.random.default_rng(1).integers(0, 255, (60, 80)).astype(np.uint8)
    path, files = tmp_path / f"a{ending}", Arrivals()
    cv2.imwrite(str(path), image)
    content = path.read_bytes()
    for share in (0.0, 0.3, 0.9, 0.999):
        path.write_bytes(content[: int(share * len(content))])
        assert [files.whole(path) for _ in range(3)] == [False] * 3
        assert len(files.troubles()) == 1
    path.write_bytes(content)
    assert [files.whole(path) for _ in range(3)] == [False, True, True]
    assert files.troubles() == []


def test_linked_images_arrive_as_others(tmp_path):
    path = write_sequence(tmp_path)
    (tmp_path / "store").mkdir()
    for side in ("left", "right"):
        (path.parent / side).rename(tmp_path / "store" / side)
        (path.parent / side).symlink_to(tmp_path / "store" / side)
    files = Arrivals()
    sequence = opened(path, files)
    image = Path(sequence.image(0, "left").hints["path"])
    assert files.first_seen(image) == files.first_seen(path.parent / "left" / image.name)


def test_a_file_must_rest(tmp_path, monkeypatch):
    path, files = write_sequence(tmp_path).parent / "left/00.png", Arrivals()
    monkeypatch.setattr(arrivals, "SETTLE_SECONDS", 1000.0)
    assert not any(files.whole(path) for _ in range(3))
    assert files.troubles() == [f"{path} {arrivals.WRITTEN}"]


def test_a_file_that_is_replaced_is_looked_into_anew(tmp_path):
    path, files = write_sequence(tmp_path).parent / "left/00.png", Arrivals()
    before = files.changed
    assert [files.whole(path) for _ in range(2)] == [False, True]
    assert files.changed > before
    content = path.read_bytes()
    path.write_bytes(content[:40])
    os.utime(path, ns=(1, 1))
    assert not any(files.whole(path) for _ in range(3))
    path.unlink()
    assert not files.whole(path)
    assert files.troubles() == []


def test_images_behind_the_last_pair_are_still_to_come(tmp_path):
    path = write_sequence(tmp_path, frames=5)
    for late in ("01", "03", "04"):
        (tmp_path / "right" / f"{late}.png").unlink()
    s = opened(path)
    assert (s.frames, s.lost) == (3, {1: "right/01.png is missing"})
    # The same files without the watch: two of five have a partner, which are no pairs.
    with raises("RIL-259"):
        open_manifest(path, arrivals.Digests())


def test_a_table_may_be_ahead_of_the_images(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n[truth]\nfile = "p.txt"\n', frames=2)
    write_lines(tmp_path / "t.txt", [f"{0.5 * k}" for k in range(4)])
    write_lines(tmp_path / "p.txt", [f"1 0 0 {k} 0 1 0 0 0 0 1 0" for k in range(4)])
    s = opened(path)
    assert s.times == (0.0, 0.5)
    assert s.truth is not None
    assert [pose.translation[0] for pose in s.truth if pose] == [0, 1]
    with raises("RIL-229"):
        open_manifest(path, arrivals.Digests())


def test_a_line_that_is_being_written_does_not_count(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n', frames=2)
    (tmp_path / "t.txt").write_text("0.5\n1")
    with raises("RIL-229"):
        opened(path)
    (tmp_path / "t.txt").write_text("0.5\n1.5\n2")
    assert opened(path).times == (0.5, 1.5)
