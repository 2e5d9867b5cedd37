"""Basic pairs and segments."""

import itertools

import pytest

from stages.errors import ConfigError
from stages.select import basic_pairs, segments


def test_the_papers_stride_on_forty_frames() -> None:
    basic = basic_pairs(40, 4)
    assert basic == [0, 4, 8, 12, 16, 20, 24, 28, 32, 36]
    parts = segments(basic, 40)
    assert parts[0] == [0, 1, 2, 3, 4]
    assert parts[-1] == [36, 37, 38, 39]
    assert len(parts) == 10


@pytest.mark.parametrize(("frames", "stride"), [(2, 1), (9, 4), (51, 2), (5, 9)])
def test_segments_cover_every_step_once(frames: int, stride: int) -> None:
    parts = segments(basic_pairs(frames, stride), frames)
    steps = [(a, b) for part in parts for a, b in itertools.pairwise(part)]
    assert steps == [(i, i + 1) for i in range(frames - 1)]
    assert all(len(part) > 1 for part in parts)


def test_one_frame_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least two"):
        basic_pairs(1, 4)
