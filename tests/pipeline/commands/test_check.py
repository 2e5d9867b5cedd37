"""The check on small folders of pairs, sound ones and ones with a fault each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.protocol import Sequence
from rille.datasets.registry import open_sequence
from rille.pipeline.commands.sequences.check import inspect
from rille.pipeline.flow import config as configuration
from rille.pipeline.runs import session
from rille.pipeline.runs.checks import matches
from rille.pipeline.runs.checks.limits import Finding
from rille.pipeline.runs.checks.records import judge_rig
from rille.pipeline.runs.options import Settings
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lens import Lens

ROWS, COLUMNS, MARGIN = 120, 200, 40


def texture() -> np.ndarray:
    rng = np.random.default_rng(3)
    fine, coarse = (rng.standard_normal((ROWS + 2 * MARGIN, COLUMNS + 4 * MARGIN)) for _ in range(2))
    mixed = 2.0 * cv2.GaussianBlur(fine, (0, 0), 1.2) + 6.0 * cv2.GaussianBlur(coarse, (0, 0), 5.0)
    return 128 + 45 * mixed / mixed.std()


def cut(image: np.ndarray, row: float, column: float) -> np.ndarray:
    """A window whose top left pixel is at (row, column) of the texture."""
    shift = np.array([[1.0, 0.0, -column], [0.0, 1.0, -row]])
    moved = cv2.warpAffine(image, shift, (COLUMNS, ROWS), flags=cv2.INTER_CUBIC)
    return np.clip(moved, 0, 255).round().astype(np.uint8)


def folder(path: Path, *, rows: float = 0.0, frames: int = 4) -> Path:
    """Pairs of a wall 4 m away: 8 px of disparity at f = 200 px and b = 0.16 m; it moves 5 px a frame."""
    wall = texture()
    for side in ("left", "right"):
        (path / side).mkdir(parents=True)
    for k in range(frames):
        at = MARGIN + 5.0 * k
        cv2.imwrite(str(path / "left" / f"{k:03d}.png"), cut(wall, MARGIN, at))
        cv2.imwrite(str(path / "right" / f"{k:03d}.png"), cut(wall, MARGIN - rows, at + 8.0))
    k = "200 0 99.5 {} 0 200 59.5 0 0 0 1 0\n"
    (path / "calib.txt").write_text(k.format(0) + k.format(-200 * 0.16))
    return path


def damage(path: Path) -> None:
    """Change a byte of an image's data; its header and its end stay."""
    data = bytearray(path.read_bytes())
    data[-200] ^= 0xFF
    path.write_bytes(data)


def look(sequence: Sequence, cache: Path, frames: tuple[int, ...] | None = None) -> int:
    """The check of a sequence, of all frames by default, with the parameters that suit it."""
    config = configuration.build(configuration.expand(sequence.defaults))
    return inspect(sequence, config, frames or tuple(range(sequence.frames)), cache)


def run(path: Path, capsys: pytest.CaptureFixture[str], **kw) -> tuple[int, list[str]]:
    code = look(open_sequence(str(path)), path.parent / "cache", **kw)
    return code, capsys.readouterr().out.splitlines()


def line(lines: list[str], subject: str) -> str:
    return next(text for text in lines if text[6:].startswith(subject))


def test_a_sound_folder_passes(tmp_path, capsys):
    code, lines = run(folder(tmp_path / "wall"), capsys)
    assert code == 0
    assert not [text for text in lines if text.startswith(("WARN", "FAIL"))]
    assert "median 4 m" in line(lines, "matching")
    assert line(lines, "sides").startswith("OK")
    assert "no ground plane" in line(lines, "ground")
    assert "4 of 4 pairs" in line(lines, "sequence")


def test_a_damaged_map_of_another_program_is_named(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    (path / "maps").mkdir()
    for k in range(4):
        np.save(path / "maps" / f"{k:03d}.npy", np.full((ROWS, COLUMNS), 8.0, np.float32))
    file = path / "maps" / "001.npy"
    file.write_bytes(file.read_bytes()[:-40])
    text = '[images]\nleft = "left/*.png"\nright = "right/*.png"\n[cameras]\nfile = "calib.txt"\n'
    (path / "wall.rille.toml").write_text(f'{text}[disparity]\nleft = "maps/*.npy"\n')
    code, lines = run(path / "wall.rille.toml", capsys)
    assert code == 1
    failed = [text for text in lines if text.startswith("FAIL")]
    assert "frame 1, 001.npy" in failed[0]
    assert "1 of 12 images and maps" in failed[1]
    assert "median 4 m" in line(lines, "matching")


def test_a_cache_that_cannot_be_written_costs_nothing_but_what_it_would_keep(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    (tmp_path / "cache").write_text("no folder")
    code, lines = run(path, capsys)
    assert code == 0
    assert "(Not a directory): what is computed is not kept" in line(lines, "cache")
    assert "median 4 m" in line(lines, "matching")


def test_swapped_folders_fail(tmp_path, capsys, monkeypatch):
    # As with cameras that are turned: their rows do not fit each other when they are exchanged.
    monkeypatch.setattr(matches, "judge_epipolar", lambda facts: Finding("", "", "epipolar", "FAIL"))
    path = folder(tmp_path / "wall")
    (path / "left").rename(path / "old")
    (path / "right").rename(path / "left")
    (path / "old").rename(path / "right")
    code, lines = run(path, capsys)
    assert code == 1
    assert "swapped" in line(lines, "sides")
    assert [text.split()[:2] for text in lines if text.startswith("FAIL")] == [["FAIL", "sides"]]  # one fault, one line


def test_matches_beyond_infinity_are_one_fault_and_one_line(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    k = "200 0 {} {} 0 200 59.5 0 0 0 1 0\n"
    (path / "calib.txt").write_text(k.format(99.5, 0) + k.format(79.5, -200 * 0.16))
    code, lines = run(path, capsys)
    assert code == 1
    assert [text.split()[:3] for text in lines if text.startswith("FAIL")] == [["FAIL", "rig", "RIL-772:"]]


def test_a_first_pair_whose_sides_are_exchanged_is_named_and_another_is_matched(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    left, right = path / "left" / "000.png", path / "right" / "000.png"
    left.rename(path / "old.png")
    right.rename(left)
    (path / "old.png").rename(right)
    code, lines = run(path, capsys)
    assert code == 0
    assert "RIL-773: 1 of 4 pairs" in line(lines, "sides")
    assert "first frame 000: left and right are swapped" in line(lines, "sides")
    assert "median 4 m" in line(lines, "matching")


def test_sides_that_are_exchanged_in_every_other_pair_are_named(tmp_path, capsys):
    path = folder(tmp_path / "wall", frames=8)
    for k in range(1, 8, 2):
        left, right = path / "left" / f"{k:03d}.png", path / "right" / f"{k:03d}.png"
        left.rename(path / "old.png")
        right.rename(left)
        (path / "old.png").rename(right)
    _, lines = run(path, capsys)
    assert "first frame 001: left and right are swapped" in line(lines, "sides")


@pytest.mark.parametrize(("side", "axis"), [("left", 1), ("right", 0)])
def test_one_camera_that_is_mirrored_fails(tmp_path, capsys, side, axis):
    path = folder(tmp_path / "wall", frames=1)
    image = path / side / "000.png"
    cv2.imwrite(str(image), np.flip(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE), axis))
    code, lines = run(path, capsys)
    assert code == 1
    assert "mirrored" in next(text for text in lines if "RIL-656" in text)


def test_rows_of_one_grey_value_in_one_camera_are_named_and_a_sky_is_not(tmp_path, capsys):
    path = folder(tmp_path / "wall", frames=2)

    def clear(side, rows):
        for name in (path / side).iterdir():
            image = cv2.imread(str(name), cv2.IMREAD_GRAYSCALE)
            image[rows] = 180
            cv2.imwrite(str(name), image)

    for side in ("left", "right"):
        clear(side, slice(0, 30))
    assert not any("grey value" in text for text in run(path, capsys)[1])
    clear("right", slice(90, None))
    _, lines = run(path, capsys)
    assert any(
        "WARN" in text and "2 of 2 right images show one grey value in 50% of their rows" in text for text in lines
    )


def test_rows_that_are_off_are_measured(tmp_path, capsys):
    code, lines = run(folder(tmp_path / "wall", rows=3.0), capsys)
    assert code == 0
    text = line(lines, "epipolar")
    assert text.startswith("WARN")
    # the right image's content lies 3 px lower; matching on smooth texture errs by hundredths
    assert float(text.split("off the epipolar lines")[1].split()[0]) == pytest.approx(3.0, abs=0.1)


def test_damaged_images_are_named_and_the_rest_is_looked_at(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    broken = path / "right" / "000.png"
    damage(broken)
    short = path / "right" / "002.png"
    short.write_bytes(short.read_bytes()[:-200])
    code, lines = run(path, capsys)
    assert code == 1
    assert any("000.png" in text and "damaged" in text for text in lines)
    assert any("RIL-670: 1 of 6 images" in text for text in lines)
    assert any("RIL-670: frame 002: right/002.png is damaged or truncated" in text for text in lines)
    assert line(lines, "matching").startswith("OK")


def test_a_wrong_default_of_a_sequence_is_told_from_a_wrong_option(tmp_path):
    sequence = replace(open_sequence(str(folder(tmp_path / "wall"))), defaults={"locus.cell_size": -1})
    with raises("RIL-027", "defaults of wall: locus.cell_size"):
        session.settings(sequence, Settings())
    sequence = replace(sequence, defaults={})
    with raises("RIL-027") as caught:
        session.settings(sequence, Settings(("locus.cell_size=-1",)))
    assert "wall" not in str(caught.value)


def test_blank_images_are_passed_over_as_a_run_does(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    for name in ("left/000.png", "left/002.png", "right/003.png"):
        cv2.imwrite(str(path / name), np.zeros((ROWS, COLUMNS), np.uint8))
    code, lines = run(path, capsys)
    assert code == 0
    assert sum("RIL-650" in text for text in lines) == 2
    assert line(lines, "matching").startswith("OK")
    assert "RIL-666" not in " ".join(lines)


def test_nothing_whole_is_no_crash(tmp_path, capsys):
    path = folder(tmp_path / "wall", frames=1)
    for side in ("left", "right"):
        damage(path / side / "000.png")
    with raises("RIL-170", "000.png"):
        run(path, capsys)


def test_blurred_and_repeated_images(tmp_path, capsys):
    path = folder(tmp_path / "wall")
    blurred = path / "left" / "002.png"
    cv2.imwrite(str(blurred), cv2.GaussianBlur(cv2.imread(str(blurred), 0), (0, 0), 2.0))
    (path / "right" / "003.png").write_bytes((path / "right" / "002.png").read_bytes())
    _, lines = run(path, capsys)
    assert any("1 left images are blurred, the worst frame 002" in text for text in lines)
    assert any("1 right images repeat the one before, first frame 003" in text for text in lines)


@pytest.mark.parametrize("distorted", [False, True])
def test_one_image_for_both_sides_fails(tmp_path, capsys, distorted):
    path = folder(tmp_path / "wall", frames=2)
    for k in range(2):
        (path / "right" / f"{k:03d}.png").write_bytes((path / "left" / f"{k:03d}.png").read_bytes())
    sequence = open_sequence(str(path))
    if distorted:
        cameras = {"left": sequence.rig.left, "right": sequence.rig.right}
        unlike = {"left": (-0.1, 0.0, 0.0, 0.0), "right": (0.1, 0.0, 0.0, 0.0)}
        sequence = replace(sequence, lenses={side: Lens(cameras[side], "radtan", k) for side, k in unlike.items()})
    assert look(sequence, tmp_path / "cache") == 1
    assert "one image in 2 pairs" in capsys.readouterr().out


def test_blank_images_are_not_taken_for_one_image(tmp_path, capsys):
    path = folder(tmp_path / "wall", frames=3)
    for side in ("left", "right"):
        cv2.imwrite(str(path / side / "001.png"), np.full_like(cv2.imread(str(path / side / "001.png"), 0), 255))
    _, lines = run(path, capsys)
    assert sum("RIL-650" in text for text in lines) == 2
    assert not any("RIL-671" in text for text in lines)


def test_frames_are_chosen_and_warnings_repeated(tmp_path, capsys):
    whole = open_sequence(str(folder(tmp_path / "wall")))
    sequence = replace(whole, warnings=("the baseline is odd",), notes=("a mask leaves out 9 %",))
    assert look(sequence, tmp_path / "cache", frames=(1, 3)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "2 of 4 pairs" in line(lines, "sequence")
    assert "WARN  input         the baseline is odd" in lines
    assert "OK    input         a mask leaves out 9 %" in lines
    assert "from frame 001 to 003" in line(lines, "motion")


def test_moments_are_judged_over_the_frames_that_are_looked_at(tmp_path, capsys):
    path = folder(tmp_path / "wall", frames=9)
    _, lines = run(path, capsys)
    assert "rows of 5 pairs" in line(lines, "simultaneous")
    _, lines = run(path, capsys, frames=(0, 4, 8))
    assert "rows of 3 pairs" in line(lines, "simultaneous")
    _, lines = run(path, capsys, frames=(4,))
    assert not [text for text in lines if "simultaneous" in text], "there is no other moment"


def test_a_doubtful_rig_is_one_finding(tmp_path):
    path = folder(tmp_path / "wall", frames=1)
    calibration = path / "calib.txt"
    calibration.write_text(calibration.read_text().replace("-32.0", "-1.0"))
    options = session.Options(cache=tmp_path / "cache")
    assert judge_rig(session.settings(str(path), options).sequence.rig).code == "RIL-641"
    assert not session.settings(str(path), options).sequence.warnings, "check judges the rig itself"
    assert "RIL-641" in " ".join(session.settings_of_run(str(path), options).sequence.warnings)


@pytest.mark.parametrize(("scale", "told"), [(16, True), (257, False)])
def test_a_run_says_that_it_spreads_samples_that_leave_bits_empty(tmp_path, scale, told):
    path = folder(tmp_path / "wall", frames=4)
    for image in path.glob("*/*.png"):
        cv2.imwrite(str(image), cv2.imread(str(image), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * scale)
    options = session.Options(cache=tmp_path / "cache")
    found = [line for line in session.settings_of_run(str(path), options).sequence.warnings if "RIL-827" in line]
    assert ["(sample - 0) x 8" in line for line in found] == [True] * told
    assert not session.settings_of_run("mockup-loop", options).sequence.warnings, "no image is there before the drive"


def test_sensors_have_a_line_each(tmp_path, capsys):
    sequence = open_sequence(str(folder(tmp_path / "wall")))
    measured = {"times": [0.0, 1.0, 2.0], "positions": [[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]], "sigma": [0.01] * 3}
    rest = (RigidTransform.identity(),) * 4
    look(replace(sequence, odometry=rest, priors={"positions": measured}), tmp_path / "cache")
    lines = capsys.readouterr().out.splitlines()
    assert "4 of 4 frames, 0 m" in line(lines, "odometry")
    assert "3 rows, 3 of them while" in line(lines, "positions")
