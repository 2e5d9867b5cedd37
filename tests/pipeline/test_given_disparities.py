"""A manifest that names another program's maps, from the file to points and an elevation model."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises

import rille
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.cloud import write_run
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.stages.core.validity import matched

MANIFEST = """
[images]
left = "left.png"
right = "right.png"
[cameras]
fx = 500.0
cx = 224.5
cy = 187.0
[rig]
baseline = 0.16
[disparity]
left = "sgbm.npy"
"""


def semiglobal(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """SGBM's disparities, pixels, without any check of its own; NaN where it has none."""
    matcher = cv2.StereoSGBM_create(0, 64, 5, P1=8 * 25, P2=32 * 25, preFilterCap=63, mode=cv2.STEREO_SGBM_MODE_HH)
    # A frame, so that all pixels have all candidates.
    left, right = (cv2.copyMakeBorder(image, 0, 0, 64, 0, cv2.BORDER_REPLICATE) for image in (left, right))
    found = matcher.compute(left, right)[:, 64:] / np.float32(16)
    return np.where(found > 0, found, np.float32(np.nan))


def test_points_and_terrain_of_another_programs_map(tmp_path: Path, data_dir: Path) -> None:
    folder = data_dir / "cones"
    for name, file in (("left", "cones_image_02.png"), ("right", "cones_image_06.png")):
        shutil.copy(folder / file, tmp_path / f"{name}.png")
    images = [cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for name in ("left", "right")]
    theirs = semiglobal(*images)
    np.save(tmp_path / "sgbm.npy", theirs)
    (tmp_path / "cones.rille.toml").write_text(MANIFEST)
    cache = tmp_path / "cache"
    run = rille.reconstruct(
        tmp_path / "cones.rille.toml", runs=tmp_path / "runs", cache=cache, executor="inline", quiet=True
    )
    assert not [line for line in run.missing if "hfvm" in str(line)]
    artifacts = RunArtifacts(run.folder, Store(cache))
    found = artifacts.one("hfvm/0")
    ok = matched(np.asarray(found["validity"]))
    np.testing.assert_array_equal(np.asarray(found["column_disparity"])[ok], -theirs[ok])
    stored = cv2.imread(str(folder / "cones_disp_02.png"), cv2.IMREAD_UNCHANGED)
    truth = np.where(stored == 0, np.nan, stored / 4.0)
    error, known = np.abs(theirs - truth), np.isfinite(truth)
    wrong = error > 2
    before, after = wrong.sum() / known.sum(), (wrong & ok).sum() / known.sum()
    assert before > 0.07
    assert after < 0.45 * before, "most of the wrong pixels are rejected"
    assert (ok & (error <= 2)).sum() > 0.9 * (known & (error <= 2)).sum(), "and few of the others"
    sigma = np.asarray(found["disparity_std"])[ok & known]
    assert (error[ok & known] < sigma).mean() == pytest.approx(0.68, abs=0.1)
    assert found.meta["match_rate"] == pytest.approx(ok.mean())
    assert int(write_run(tmp_path / "points.ply", artifacts).split()[0]) > 0.99 * ok.sum()
    assert np.isfinite(run.terrain.elevation).sum() > 1000


def test_a_map_of_another_size_ends_with_its_name(tmp_path: Path) -> None:
    for name in ("left", "right"):
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((375, 450), np.uint8))
    np.save(tmp_path / "sgbm.npy", np.ones((188, 225), np.float32))
    (tmp_path / "cones.rille.toml").write_text(MANIFEST)
    with raises("RIL-900", "sgbm.npy", "225 x 188", "450 x 375"):
        rille.open(tmp_path / "cones.rille.toml")


def test_a_damaged_map_is_why_its_frame_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A wall 4 m away, seen at 8 px of disparity, that moves by 5 px a frame.
    noise = cv2.GaussianBlur(np.random.default_rng(3).standard_normal((160, 320)), (0, 0), 1.5)
    wall = np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)
    for folder in ("left", "right", "maps"):
        (tmp_path / folder).mkdir()
    for k in range(7):
        for side, column in (("left", 20 + 5 * k), ("right", 28 + 5 * k)):
            assert cv2.imwrite(str(tmp_path / side / f"{k}.png"), wall[:, column : column + 220])
        np.save(tmp_path / "maps" / f"{k}.npy", np.full((160, 220), 8.0, np.float32))
    file = tmp_path / "maps" / "3.npy"
    file.write_bytes(file.read_bytes()[:-40])
    (tmp_path / "wall.rille.toml").write_text("""
[images]
left = "left/*.png"
right = "right/*.png"
[cameras]
fx = 200.0
cx = 109.5
cy = 79.5
[rig]
baseline = 0.16
[disparity]
left = "maps/*.npy"
[defaults]
keyframes.stride = 1
crosscheck.enabled = false
""")
    where = {"runs": tmp_path / "runs", "cache": tmp_path / "cache", "executor": "inline"}
    rille.reconstruct(tmp_path / "wall.rille.toml", **where, quiet=True)
    assert "frame 3 lost: 3.npy cannot be read" in capsys.readouterr().err
