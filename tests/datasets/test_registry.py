"""Sequences by name: what is known, and what the near miss was."""

from __future__ import annotations

import pytest

from datasets.registry import catalogue, open_sequence
from stages.errors import ConfigError, InputError


def test_every_listed_name_opens():
    names = [name for name, _ in catalogue()]
    assert names[:2] == ["mockup", "mockup-short"]
    full, short = open_sequence("mockup"), open_sequence("mockup-short")
    assert (full.frames, short.frames) == (40, 9)
    assert full.defaults == {"select.stride": 4, "locus.cell_size": 0.001}
    assert full.evaluation_window == (-0.3, 0.4, 0.3, 0.7)
    assert (full.rig.left.width, full.rig.left.height) == (570, 520)
    assert full.vehicle is not None
    assert all(words for _, words in catalogue())


def test_windows_of_successive_basic_pairs_overlap_by_more_than_half():
    from stages.geometry import level_rotation

    s = open_sequence("mockup")
    a, b = s.truth[0], s.truth[int(s.defaults["select.stride"])]
    dx, dy, _ = level_rotation(a.rotation[2]) @ a.rotation.T @ (b.translation - a.translation)
    x0, y0, x1, y1 = s.evaluation_window
    assert 0.53 < (1 - abs(dx) / (x1 - x0)) * (1 - abs(dy) / (y1 - y0)) < 0.7


def test_overrides_reach_the_mockup_alone():
    s = open_sequence("mockup-short", {"mockup": {"seed": 5, "frames": 4}})
    assert s.frames == 4
    assert s.parameters["mockup"].seed == 5
    assert s.parameters["mockup"].bed_width == 1.2
    with pytest.raises(ConfigError, match=r"\[kitti\] does not belong to mockup"):
        open_sequence("mockup", {"kitti": {}})


def test_folders_have_no_overrides(tmp_path):
    with pytest.raises(ConfigError, match=r"\[mockup\] does not belong to"):
        open_sequence(str(tmp_path), {"mockup": {"seed": 1}})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sed": 1}, r"unknown key 'mockup\.sed' \(value 1\): did you mean 'mockup\.seed'"),
        ({"qqqq": 1}, r"unknown key 'mockup\.qqqq' .*known: attitude_noise_deg"),
        ({"seed": -1}, r"mockup\.seed = -1 is not permitted: .*greater than or equal to 0"),
        ({"noise": "loud"}, r"mockup\.noise = 'loud' is not permitted"),
        ({"noise": float("inf")}, r"mockup\.noise = inf is not permitted"),
    ],
)
def test_bad_overrides_say_what_is_permitted(values, message):
    with pytest.raises(ConfigError, match=message):
        open_sequence("mockup", {"mockup": values})


@pytest.mark.parametrize("name", ["mokup", "mockup_short", "Mockup"])
def test_near_misses_are_suggested(name):
    with pytest.raises(InputError, match=r"no sequence .*: did you mean 'mockup"):
        open_sequence(name)


def test_unknown_folder_names_the_layouts(tmp_path):
    with pytest.raises(InputError, match=r"no layout that is recognised.*calib\.txt"):
        open_sequence(str(tmp_path))
    with pytest.raises(InputError, match="no sequence 'no/such/folder': known names: mockup"):
        open_sequence("no/such/folder")
