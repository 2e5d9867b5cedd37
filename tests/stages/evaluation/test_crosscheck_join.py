"""Windows to one trajectory: exact poses come back, and a broken chain stays broken."""

from __future__ import annotations

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation.crosscheck_join import crosscheck_join_stage, join
from rille.stages.geometry.geometry import rotation_exp
from rille.stages.geometry.rigid import compose, inverse, posed


def drive(n: int) -> np.ndarray:
    """A drive in a curve, a metre a frame."""
    poses, pose = [], np.eye(4)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation_exp([0.01, 0.05, 0.0]), [0.0, 0.0, 1.0]
    for _ in range(n):
        poses.append(pose[:3].copy())
        pose = pose @ motion
    return np.array(poses)


def cut(poses: np.ndarray, frames: list[int], seed: int) -> tuple[list[int], np.ndarray]:
    """Some frames, in a frame of reference of their own."""
    rng = np.random.default_rng(seed)
    motion = np.column_stack([rotation_exp(rng.normal(size=3)), rng.normal(size=3)])
    return frames, compose(motion, poses[frames])


def bundle(part: tuple[list[int], np.ndarray]) -> Bundle:
    reason = "" if posed(part[1]).any() else "no two images match"
    lines = np.array(part[0]) / 10
    return Bundle({"poses": part[1], "line_distance": lines}, {"frames": part[0], "reason": reason})


def test_windows_of_exact_poses_make_the_whole() -> None:
    true = drive(14)
    parts = [cut(true, list(range(a, a + 6)), a) for a in (0, 4, 8)]
    poses, piece = join(range(14), parts)
    assert piece.tolist() == [0] * 14
    np.testing.assert_allclose(compose(inverse(poses[0]), poses), true, atol=1e-9)


def test_over_the_shared_frames_one_window_fades_into_the_other() -> None:
    """The later window is 10 % too long: three shared frames a metre apart miss by 0.1, 0 and 0.1 m. It stays so."""
    true = np.tile(np.eye(3, 4), (8, 1, 1))
    true[:, 2, 3] = np.arange(8)
    later = true[3:].copy()
    later[:, 2, 3] *= 1.1
    poses, _ = join(range(8), [(list(range(6)), true[:6]), (list(range(3, 8)), later)])
    # of 2.9, 4.0, 5.1 m of the later window, a quarter, a half and three quarters count
    np.testing.assert_allclose(poses[:, 2, 3], [0, 1, 2, 2.975, 4, 5.075, 6.2, 7.3], atol=1e-9)
    np.testing.assert_allclose(poses[:, :, :3], np.tile(np.eye(3), (8, 1, 1)), atol=1e-9)


def test_a_broken_chain_names_its_pieces_and_keeps_the_longest() -> None:
    true = drive(12)
    first, second, third = (
        cut(true, f, k) for k, f in enumerate(([0, 1, 2, 3], [2, 3, 4, 5, 6], [5, 6, 7, 8, 9, 10, 11]))
    )
    second[1][:2] = np.nan  # shares no posed frame with the first
    third[1][2] = np.nan
    out = crosscheck_join_stage.run(
        NoParams(), {"frames": list(range(12))}, {"windows": [bundle(p) for p in (first, second, third)]}
    )
    check_outputs(crosscheck_join_stage, out)
    assert out.meta["pieces"] == [[0, 1, 2, 3], [4, 5, 6, 8, 9, 10, 11]]
    assert out.meta["main"] == 1
    assert posed(out["poses"]).tolist() == [True] * 7 + [False] + [True] * 4
    assert out["piece"].tolist() == [0] * 4 + [1] * 3 + [-1] + [1] * 4
    np.testing.assert_allclose(out["line_distance"], np.arange(12) / 10)


def test_no_window_with_a_model_is_a_fact() -> None:
    nothing = ([0, 1, 2], np.full((3, 3, 4), np.nan))
    out = crosscheck_join_stage.run(NoParams(), {"frames": [0, 1, 2]}, {"windows": [bundle(nothing)]})
    check_outputs(crosscheck_join_stage, out)
    assert out.meta["pieces"] == []
    assert out.meta["reasons"] == ["no two images match"]
    assert np.isnan(out["poses"]).all()
