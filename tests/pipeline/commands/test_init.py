"""``rille init``: where the manifest goes, what is printed, and that nothing is overwritten."""

from __future__ import annotations

import errno
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.images.files import Digests
from rille.datasets.manifest.opening import open_manifest
from rille.datasets.registry import hindrance
from rille.pipeline.commands.sequences.init import init
from rille.stages.hazard.vehicle import Vehicle

SETTINGS = """%YAML:1.0
Camera.fx: 60.0
Camera.fy: 60.0
Camera.cx: 31.5
Camera.cy: 23.5
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.width: 64
Camera.height: 48
Camera.bf: 6.0
"""


@pytest.fixture
def drive(tmp_path, monkeypatch) -> Path:
    """A folder of two pairs, without calibration; the present folder is another one."""
    folder = tmp_path / "drive"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for k in range(2):
            cv2.imwrite(str(folder / side / f"{k}.png"), np.zeros((48, 64), np.uint8))
    return folder


def test_a_calibrated_folder_needs_nothing_more(drive, capsys):
    (drive / "calibration.yaml").write_text(SETTINGS)
    init(drive)
    path = Path("drive.rille.toml")
    printed = capsys.readouterr().out
    assert "2 pairs, 64 x 48 pixels: left/*.png and right/*.png" in printed
    assert "calibration.yaml, baseline 0.1" in printed
    assert f"rille reconstruct {path}" in printed
    assert "edit" not in printed
    s = open_manifest(path, Digests())
    assert (s.name, s.frames, s.rig.baseline) == ("drive", 2, pytest.approx(0.1))


def test_images_of_two_sizes_are_one_complaint(drive, capsys):
    (drive / "calibration.yaml").write_text(SETTINGS)
    cv2.imwrite(str(drive / "left" / "1.png"), np.zeros((24, 32), np.uint8))
    init(drive)
    printed = capsys.readouterr().out
    assert "2 pairs: left/*.png and right/*.png" in printed
    assert printed.count("needed ") == 1


def test_what_is_needed_is_printed(drive, capsys):
    init(drive)
    printed = capsys.readouterr().out
    assert "needed       no calibration was found" in printed
    assert "edit drive.rille.toml" in printed


def test_next_steps_are_as_a_shell_takes_them(drive, tmp_path, capsys):
    init(drive, output=tmp_path / "here" / "my drive.toml")
    assert f"rille check '{tmp_path}/here/my drive.toml'" in capsys.readouterr().out


def test_no_path_of_the_next_steps_is_an_option(drive, monkeypatch, capsys):
    monkeypatch.chdir(drive.parent)
    drive.rename("-x")
    init(Path("./-x"), output=Path("./-y.toml"))
    assert "rille check ./-y.toml" in capsys.readouterr().out


@pytest.mark.parametrize(
    "names", [["mask_left.png", "mask_right.png"], ["masks/cam0.png", "masks/cam1.png"], ["mask_l.png"]]
)
def test_masks_of_the_cameras_are_taken(drive, capsys, names):
    (drive / "calibration.yaml").write_text(SETTINGS)
    (drive / "masks").mkdir()
    for name in [*names, names[0].replace(".", ".look.")]:
        cv2.imwrite(str(drive / name), np.where(np.arange(48)[:, None] < 40, 255, np.zeros((48, 64), np.uint8)))
    init(drive)
    printed = capsys.readouterr().out
    assert f"masks        {', '.join(names)}" in printed
    assert "not read" not in printed
    assert [path.name for path in open_manifest(Path("drive.rille.toml"), Digests()).masks.values()] == [
        Path(name).name for name in names
    ]


def test_masks_of_each_image_are_not_those_of_the_cameras(drive, capsys):
    for side in ("left", "right"):
        (drive / "mask" / side).mkdir(parents=True)
        for k in range(2):
            cv2.imwrite(str(drive / "mask" / side / f"{k}.png"), np.zeros((48, 64), np.uint8))
    init(drive)
    assert "images (mask/left/0.png ...): computed, by the names" in capsys.readouterr().out


@pytest.mark.parametrize(("place", "root"), [(".", "drive"), ("drive/left", ".."), ("far/away", None)])
def test_elsewhere_the_manifest_still_finds_its_folder(drive, tmp_path, place, root):
    (drive / "calibration.yaml").write_text(SETTINGS)
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    path = tmp_path / place / "m.toml"
    init(drive, output=path)
    assert f'root = "{root or drive}"' in path.read_text()
    assert open_manifest(path, Digests()).frames == 2


def test_nothing_is_overwritten_without_force(drive):
    path = drive / "m.toml"
    path.write_text("mine")
    with raises("RIL-038", "m.toml"):
        init(drive, output=path)
    assert path.read_text() == "mine"
    init(drive, output=path, force=True)
    assert path.read_text() != "mine"
    init(drive)
    with raises("RIL-038", "drive.rille.toml"):
        init(drive)
    init(drive, force=True)


def test_on_a_full_disk_the_manifest_that_was_there_stays(drive, monkeypatch):
    path = drive / "m.toml"
    path.write_text("mine")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        init(drive, output=path, force=True)
    assert path.read_text() == "mine"


def test_a_folder_that_opens_as_it_is_gets_no_manifest_unasked(drive, tmp_path, capsys):
    rows = ["60 0 31.5 0 0 60 23.5 0 0 0 1 0", "60 0 31.5 -12 0 60 23.5 0 0 0 1 0"]
    (drive / "calib.txt").write_text("\n".join(rows))
    init(drive)
    printed = capsys.readouterr().out
    assert f"{drive} opens as it is; " in printed
    assert f"rille reconstruct {drive}\n" in printed
    assert not list(drive.glob("*.toml"))
    cv2.imwrite(str(drive / "mask_right.png"), np.full((48, 64), 255, np.uint8))
    init(drive)
    assert f"{drive} opens as it is, without mask_right.png; " in capsys.readouterr().out
    init(drive, output=tmp_path / "m.toml")
    assert (tmp_path / "m.toml").is_file()


NAMED = Path("nasa_k10")
"""Of a built-in sequence that opens where its data are."""


def test_a_folder_with_the_name_of_a_built_in_sequence_is_that_folder(drive, capsys, monkeypatch):
    monkeypatch.setattr(
        "rille.pipeline.commands.sequences.init.hindrance", lambda path: None if path == NAMED else hindrance(path)
    )
    monkeypatch.chdir(drive.parent)
    drive.rename(NAMED)
    init(NAMED)
    assert "wrote" in capsys.readouterr().out
    assert Path(f"{NAMED}.rille.toml").exists()


def test_what_does_not_open_is_not_said_to(drive, capsys):
    (drive / "calib.txt").write_text("60 0 31.5\n")
    init(drive)
    printed = capsys.readouterr().out
    assert "opens as it is" not in printed
    assert "calib.txt" in printed.splitlines()[0]
    assert "needed" in printed


@pytest.mark.parametrize("pair", [("image_00", "image_01"), ("image_02", "image_03")])
def test_image_folders_of_raw_recordings_open_with_their_calibration(drive, capsys, pair):
    rows = {1: "60 0 31.5 -12 0 60 23.5 0 0 0 1 0", 0: "60 0 31.5 0 0 60 23.5 0 0 0 1 0"}
    for side, name in zip(("left", "right"), pair, strict=True):
        (drive / side).rename(drive / name)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "S_00: 80 60", "K_00: 70 0 40 0 70 30 0 0 1"]
    (drive / "calib.txt").write_text("\n".join(lines + [f"P_rect_0{k}: {rows[k % 2]}" for k in range(4)]))
    init(drive)
    assert "opens as it is" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[vehicle]\nname = 'a'\ntrack = 0.5\n", "vehicle      vehicle.toml"),
        ("[vehicle]\ntrack = 'a'\n", "vehicle.track = 'a' is not permitted"),
        ("vehicle = 3\n", "vehicle.toml: vehicle"),
        ("track = 0.1\n", "unknown key 'track'"),
        ("[vehicle\n", "vehicle.toml is not TOML"),
    ],
)
def test_the_vehicle_that_a_file_beside_the_images_states_is_in_the_manifest(drive, capsys, text, line):
    (drive / "calibration.yaml").write_text(SETTINGS)
    (drive / "vehicle.toml").write_text(text)
    init(drive)
    assert line in capsys.readouterr().out
    stated = tomllib.loads(Path("drive.rille.toml").read_text()).get("vehicle")
    assert stated == (Vehicle(name="a", track=0.5).model_dump() if "name" in text else None)


def test_places_that_cannot_be_written(drive, tmp_path):
    (tmp_path / "file").touch()
    with raises("RIL-746", "is no folder"):
        init(drive, output=tmp_path / "file" / "m.toml")
    with raises("RIL-871", "m.yaml"):
        init(drive, output=tmp_path / "m.yaml")
    with raises("RIL-193"):
        init(tmp_path / "nothing")


def test_a_name_with_line_breaks_becomes_no_key(drive):
    folder = drive.rename(drive.with_name("x\n[vehicle]\nmax_slope_deg = 60\n#"))
    (folder / "gnss.csv").write_text("time;x\n1,5;2\n")
    (folder / "calibration.yaml").write_text(SETTINGS)
    init(folder, output=Path("a.rille.toml"))
    text = Path("a.rille.toml").read_text()
    assert "# Not read:" in text
    assert "vehicle" not in tomllib.loads(text)
    folder = folder.rename(folder.with_name("caf\udce9"))
    with raises("RIL-185"):  # no TOML holds it
        init(folder, output=Path("deep/er/b.rille.toml"))
