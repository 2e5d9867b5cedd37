"""What a run says and does when frames are bad: a small exported mockup, spoilt, through the whole chain."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises

from rille.pipeline.commands.results import runs
from rille.pipeline.commands.sequences.datasets import export_dataset
from rille.pipeline.runs import session

pytestmark = pytest.mark.slow

SMALL = ("mockup.frames=8", "mockup.image_width=285", "mockup.image_height=260", "mockup.focal_length=300.0")
PLAIN = ("keyframes.stride=3", "locus.cell_size=0.006", "hfvm.preset=fast", "crosscheck.enabled=false")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sequence ``good`` and a cache that all runs share, so that each computes little."""
    folder = tmp_path_factory.mktemp("bad")
    export_dataset("mockup-short", folder / "good", assignments=list(SMALL), cache=folder / "cache")
    return folder


def reconstruct(
    place: Path, name: str, spoil: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> tuple[int, str, Path]:
    """Exit code, stderr and run folder of a spoilt copy."""
    folder = place / name
    shutil.copytree(place / "good", folder)
    spoil(folder)
    capsys.readouterr()
    options = session.Options(PLAIN, executor="inline", progress="quiet", runs=place / "runs", cache=place / "cache")
    result = session.perform(str(folder), options)
    result.print()
    return result.code, capsys.readouterr().err, (place / "runs" / name / "latest").resolve()


def files(folder: Path, frame: int) -> list[Path]:
    return [folder / side / f"{frame:06d}.png" for side in ("left", "right")]


def change(frame: int, how: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        for path in files(folder, frame):
            assert cv2.imwrite(str(path), how(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))

    return spoil


def swap(frame: int) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        left, right = files(folder, frame)
        left.rename(folder / "kept.png")
        right.rename(left)
        (folder / "kept.png").rename(right)

    return spoil


def tear(frame: int, other: int) -> Callable[[Path], None]:
    """Both images of a frame are those of another one from their middle on."""

    def spoil(folder: Path) -> None:
        for path, theirs in zip(files(folder, frame), files(folder, other), strict=True):
            image, rest = (cv2.imread(str(one), cv2.IMREAD_GRAYSCALE) for one in (path, theirs))
            middle = len(image) // 2
            assert cv2.imwrite(str(path), np.concatenate([image[:middle], rest[middle:]]))

    return spoil


def shift(frame: int, side: int) -> Callable[[Path], None]:
    """Rows of one image of a frame are shifted from its middle on."""

    def spoil(folder: Path) -> None:
        path = str(files(folder, frame)[side])
        image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
        image[len(image) // 2 :] = np.roll(image[len(image) // 2 :], 12, axis=1)
        assert cv2.imwrite(path, image)

    return spoil


def positions(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / "trajectory.kitti").reshape(-1, 3, 4)[:, :, 3]


@pytest.mark.parametrize(
    ("spoil", "frame", "says"),
    [
        pytest.param(change(4, lambda i: 0 * i), 4, "frame 4 lost: black left image", id="black"),
        pytest.param(change(3, lambda i: 0 * i), 3, "frame 3 lost: black left image", id="black, to be basic"),
        pytest.param(tear(4, 5), 4, "frame 4 lost: it shows two motions", id="torn"),
        pytest.param(tear(3, 6), 3, "frame 3 lost: it shows two motions", id="torn, to be basic"),
        pytest.param(shift(3, 0), 3, "frame 3 lost: it shows two motions", id="left torn"),
        pytest.param(shift(3, 1), 3, "frame 3 lost: its left and right do not fit", id="right torn"),
        pytest.param(swap(4), 4, "frame 4 lost: left and right are swapped", id="swapped"),
        pytest.param(
            lambda f: files(f, 4)[1].unlink(), 4, "frame 4 lost: right/000004.png is missing", id="right missing"
        ),
        pytest.param(lambda f: [p.unlink() for p in files(f, 4)], 4, "are missing", id="both missing"),
    ],
)
def test_a_bad_frame_is_lost_named_and_bridged(
    place: Path,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
    spoil: Callable[[Path], None],
    frame: int,
    says: str,
) -> None:
    name = request.node.callspec.id.replace(" ", "_").replace(",", "")
    code, err, folder = reconstruct(place, name, spoil, capsys)
    assert code == session.HOLES
    assert says in err
    assert f"bridged from {frame - 1} to {frame + 1}" in err
    assert "1 of 8 frames have no pose" in err
    at = positions(folder)
    assert np.isnan(at[frame]).all()
    assert np.isfinite(np.delete(at, frame, axis=0)).all()
    report = json.loads((folder / "report.json").read_text())
    assert any(says in line for line in report["warnings"])
    assert not report["complete"]
    assert [line[45:57].strip() for line in runs.describe([folder])] == ["state", "1 missing"]
    assert report["metrics"]["trajectory_final_error"]["value"] < 1e-3
    assert (folder / "dem.tif").exists()


def test_a_blurred_frame_is_posed_but_nothing_is_built_on_it(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, err, folder = reconstruct(place, "blurred", change(3, lambda i: cv2.GaussianBlur(i, (0, 0), 2.5)), capsys)
    assert code == session.COMPLETE
    assert "frame 3 is not used as basic pair" in err
    report = json.loads((folder / "report.json").read_text())
    assert 3 not in report["sequence"]["basic_pairs"]
    assert np.isfinite(positions(folder)).all()


def test_a_repeated_frame_does_not_move(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def repeat(folder: Path) -> None:
        for source, target in zip(files(folder, 4), files(folder, 5), strict=True):
            shutil.copy(source, target)

    code, err, folder = reconstruct(place, "repeated", repeat, capsys)
    assert code == session.COMPLETE
    assert "frame 5 repeats" in err
    at = positions(folder)
    assert np.linalg.norm(at[5] - at[4]) < 2e-5
    assert np.linalg.norm(at[6] - at[5]) > 0.05


def test_a_break_makes_pieces_and_the_world_of_the_largest(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From frame 5 on all is seen in a mirror, left and right exchanged: sound pairs that no motion leads to."""

    def elsewhere(folder: Path) -> None:
        for frame in (5, 6, 7):
            images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in files(folder, frame)]
            for path, image in zip(files(folder, frame), reversed(images), strict=True):
                assert cv2.imwrite(str(path), np.ascontiguousarray(image[:, ::-1]))

    code, err, folder = reconstruct(place, "broken", elsewhere, capsys)
    assert code == session.HOLES
    assert "piece 2: frames 5-7" in err
    assert "missing: 3 of 8 frames" in err
    report = json.loads((folder / "report.json").read_text())
    assert report["metrics"]["frames_posed"]["value"] == 8
    assert report["metrics"]["frames_in_world"]["value"] == 5
    assert report["verdict"].startswith("Incomplete: 8 of 8 frames posed, 5 of them in the world")
    at = positions(folder)
    assert np.isfinite(at[:5]).all()
    assert np.isnan(at[5:]).all()
    assert len((folder / "trajectory.piece2.tum").read_text().splitlines()) == 1 + 3
    assert (folder / "dem.tif").exists()


def test_sides_swapped_throughout_are_refused_with_one_line(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def both(folder: Path) -> None:
        for frame in range(8):
            swap(frame)(folder)

    with raises("RIL-781") as caught:
        reconstruct(place, "all-swapped", both, capsys)
    assert "\n" not in str(caught.value)
