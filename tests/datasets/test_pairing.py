"""Pairing of images: by name, number and order, and what has no partner."""

from __future__ import annotations

import random
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.images.pairing import common_headers, pair_up
from rille.datasets.images.simultaneous import join
from rille.datasets.text.order import natural, stamp_of, times_in_names
from rille.datasets.text.sides import side_of, two_sides


def paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


def found(left: list[Path], right: list[Path], rule: str = "auto") -> list[tuple[str, str, str]]:
    return [(p.name, p.left.name, p.right.name) for p in pair_up(left, right, rule)]


@pytest.mark.parametrize(
    "names",
    [
        ["0.25", "0.5", "1", "1.25", "1.5", "10", "10.25"],
        ["t_9.75", "t_10", "t_10.25"],
        ["t_1.5", "t_1.9", "t_1.10", "t_1.100"],  # no decimals: some fractions end in 0
        ["image", "image (2)", "image (10)"],
    ],
)
def test_pairs_stand_in_the_order_of_the_decimals_in_their_names(names):
    sides = [paths(*(f"{side}/{name}.png" for name in random.Random(3).sample(names, len(names)))) for side in "lr"]
    assert [pair.name for pair in pair_up(*sides)] == names


@pytest.mark.parametrize("mark", ["_", ".", "-"])
def test_nanoseconds_need_not_have_their_zeros(mark):
    """ROS's two numbers of a stamp, joined: 50 ms are ``1700000000_50000000``."""
    stamps = [1_700_000_000_050_000_000 + 300_000_000 * k for k in range(12)]
    sides = [
        paths(*(f"{side}/{later // 10**9}{mark}{later % 10**9}.png" for later in (stamp + shift for stamp in stamps)))
        for side, shift in (("l", 0), ("r", 2_000_000))
    ]
    pairs = pair_up(*(random.Random(3).sample(side, len(side)) for side in sides))
    assert [(pair.left, pair.right) for pair in pairs] == list(zip(*sides, strict=True))
    times = np.array(times_in_names([pair.left for pair in pairs])) - 1.7e9
    np.testing.assert_allclose(times, [0.05 + 0.3 * k for k in range(12)], atol=1e-6)


def test_a_date_that_all_names_share_hides_no_time_stamp():
    names = [f"n015-2018-07-24-11-22-45+0800__CAM_FRONT__{1532402927612460 + 62500 * k}.jpg" for k in range(4)]
    np.testing.assert_allclose(np.diff(times_in_names(paths(*names))), 0.0625, atol=1e-6)


def test_names_of_two_sides_may_say_their_side_twice():
    names = [f"{side}/{side[0].upper()}_{k:03d}.cahv" for k in (0, 1) for side in ("right", "left")]
    assert two_sides([*names, "left/R_002.cahv"]) == [(names[1], names[0]), (names[3], names[2])]


def test_decimals_are_no_nanoseconds_without_zeros():
    names = ["1700000000.05", "1700000000.123456789", "1700000000.35"]
    assert times_in_names(paths(*(f"{name}.png" for name in names))) == tuple(map(float, names))


@pytest.mark.parametrize(
    ("left", "right", "names"),
    [
        (["l/000.png", "l/001.png"], ["r/000.png", "r/001.png"], ["000", "001"]),
        (["left01.jpg", "left02.jpg"], ["right01.jpg", "right02.jpg"], ["01", "02"]),
        (["a_l.png", "b_l.png"], ["a_r.png", "b_r.png"], ["a", "b"]),
        (["s_cam0_7.png", "s_cam0_8.png"], ["s_cam1_7.png", "s_cam1_8.png"], ["s__7", "s__8"]),
    ],
)
def test_names_pair_with_the_sides_token_aside(left, right, names):
    pairs = pair_up(paths(*reversed(left)), paths(*right))
    assert [p.name for p in pairs] == names
    assert [p.left for p in pairs] == paths(*left)
    assert [p.right for p in pairs] == paths(*right)


def test_numbers_pair_where_no_names_agree():
    assert found(paths("x10.png", "x9.png"), paths("y09.png", "y010.png")) == [
        ("x9", "x9.png", "y09.png"),
        ("x10", "x10.png", "y010.png"),
    ]


def test_order_pairs_whatever_the_names():
    assert found(paths("b.png", "a.png"), paths("z.png", "y.png"), "order") == [
        ("a", "a.png", "y.png"),
        ("b", "b.png", "z.png"),
    ]
    assert found(paths("im7.png"), paths("im9.png")) == [("im7", "im7.png", "im9.png")]


@pytest.mark.parametrize(
    ("left", "right", "rule", "expected"),
    [
        (["1.png", "2.png"], ["1.png"], "auto", ("RIL-259", "2.png")),
        (["1.png"], ["1.png", "2.png", "3.png"], "auto", ("RIL-259", "2.png")),
        (["1.png", "2.png"], ["3.png"], "order", ("RIL-256",)),
        (["a1.png", "b1.png"], ["c1.png", "c2.png"], "number", ("RIL-258", "a1.png", "b1.png")),
        (["a.png", "b.png"], ["c.png", "d.png"], "auto", ("RIL-257", "a.png")),
    ],
)
def test_what_has_no_partner_is_named(left, right, rule, expected):
    with raises(*expected):
        pair_up(paths(*left), paths(*right), rule)


def test_a_gap_is_a_pair_of_which_a_file_is_absent():
    left, right = paths("l/cam_left_9.png", "l/cam_left_10.png"), paths("r/cam_right_9.png", "r/cam_right_11.png")
    more = paths("l/cam_left_12.png", "l/cam_left_13.png"), paths("r/cam_right_12.png", "r/cam_right_13.png")
    pairs = pair_up(left + more[0], right + more[1])
    assert [(p.left.name, p.right.name) for p in pairs] == [
        (f"cam_left_{k}.png", f"cam_right_{k}.png") for k in (9, 10, 11, 12, 13)
    ]
    assert [p.absent for p in pairs] == ["", "r/cam_right_10.png is missing", "l/cam_left_11.png is missing", "", ""]
    with raises("RIL-259"):
        pair_up(left, right)  # more is missing than whole


@pytest.mark.parametrize(
    ("names", "lost"),
    [
        ("{k}/{side}.png", "2/right.png"),
        ("frame_{k:02d}/{side}/img.png", "frame_02/right/img.png"),
        ("{side}/{side}_{k}/1.png", "right/right_2/1.png"),
        ("{k}.5/im_{side}.png", "2.5/im_right.png"),
    ],
)
@pytest.mark.parametrize("rule", ["auto", "folder"])
def test_a_missing_image_loses_its_pair_alone_where_each_frame_has_its_folder(names, lost, rule):
    root = Path("/drives/left_1")  # whose name tells no side
    left, right = ([root / names.format(k=k, side=side) for k in (0, 1, 2, 9, 10)] for side in ("left", "right"))
    pairs = pair_up(left[::-1], [path for path in right if path != root / lost], rule)
    assert [(pair.left, pair.right) for pair in pairs] == list(zip(left, right, strict=True))
    assert [pair.absent for pair in pairs] == ["", "", f"{lost} is missing", "", ""]


@pytest.mark.parametrize("name", ["im", "I", "cam", "image_", "image_0", "view"])
@pytest.mark.parametrize("place", ["/d/{side}/{name}{k}.png", "/d/{name}{k}/{side}.png"])
def test_a_word_of_a_side_in_names_that_both_sides_have_tells_no_side(name, place):
    left, right = (paths(*(place.format(side=s, name=name, k=k) for k in range(12))) for s in ("left", "right"))
    pairs = pair_up(left, right[:5] + right[6:])
    assert [(pair.left, pair.right) for pair in pairs] == list(zip(left, right, strict=True))
    assert [k for k, pair in enumerate(pairs) if pair.absent] == [5]


def test_a_stated_rule_is_kept_where_each_frame_has_its_folder():
    sides = [paths(*(f"{k}/{side}.png" for k in range(3))) for side in ("left", "right")]
    for rule, code in (("name", "RIL-258"), ("number", "RIL-257"), ("nearest", "RIL-822")):
        with raises(code):
            pair_up(*sides, rule)
    assert len(pair_up(*sides, "order")) == 3


def test_numbers_in_names_sort_as_numbers():
    names = [f"a{k}b{j}" for k in (1, 2, 10) for j in (3, 20)]
    shuffled = random.Random(4).sample(names, len(names))
    assert sorted(shuffled, key=natural) == names
    assert natural("1²") > natural("1")  # a digit to Python, but no number


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("left/0001", (0, "*/0001")),
        ("Left07", (0, "*07")),
        ("mav0/cam1/data/17", (1, "mav0/*/data/17")),
        ("left/left_3", (0, "*/*_3")),
        ("x_R_4", (1, "x_*_4")),
        ("image_2/000", (0, "*/000")),
        ("imgL_07", (0, "img*_07")),
        ("rightImg8bit/3", (1, "*Img8bit/3")),
        ("frameLeft3", (0, "frame*3")),
    ],
)
def test_tokens_of_sides(name, side):
    at = side_of(name)
    assert at is not None
    assert at[1:] == side


@pytest.mark.parametrize("name", ["leftover", "cam01/3", "aright", "real", "image_25/3", "123", "COLOR/3", "Large"])
def test_words_that_only_look_like_a_side(name):
    assert side_of(name) is None


def test_images_that_do_not_belong_to_the_others_are_absent(tmp_path):
    names = [f"{k}_{side}.png" for k in range(6) for side in "lr"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.zeros((4, 6), np.uint8))
    pairs = pair_up(sorted(tmp_path.glob("*_l.png")), sorted(tmp_path.glob("*_r.png")))
    assert common_headers(pairs) == (((6, 4, 8), (6, 4, 8)), pairs)
    cv2.imwrite(str(tmp_path / "0_l.png"), np.zeros((5, 6), np.uint8))
    cv2.imwrite(str(tmp_path / "0_r.png"), np.zeros((4, 6), np.uint16))
    (tmp_path / "1_r.png").write_bytes(b"")
    (tmp_path / "2_l.png").write_bytes((tmp_path / "3_l.png").read_bytes()[:-12])
    headers, checked = common_headers(pairs)
    assert headers == ((6, 4, 8), (6, 4, 8))
    words = [("6 x 5, 8 bits",), ("/1_r.png is empty",), ("/2_l.png", "truncated"), (), (), ()]
    for pair, of in zip(checked, words, strict=True):
        assert bool(pair.absent) == bool(of)
        assert all(word in pair.absent for word in of)
        assert str(tmp_path) not in pair.absent  # it stands in results
    for pair in pairs:
        pair.left.write_bytes(b"")
    with raises("RIL-170", "0_l.png is empty"):
        common_headers(pairs)


@pytest.mark.parametrize("kind", ["pgm", "ppm", "bmp", "jpg"])
def test_images_of_other_kinds_that_break_off_are_absent(tmp_path, kind):
    for k in range(3):
        for side in "lr":
            cv2.imwrite(
                str(tmp_path / f"{k}_{side}.{kind}"), np.full((40, 60, 3 if kind == "ppm" else 1), 90, np.uint8)
            )
    short = tmp_path / f"1_r.{kind}"
    short.write_bytes(short.read_bytes()[: -short.stat().st_size // 2])
    _, checked = common_headers(pair_up(sorted(tmp_path.glob("*_l*")), sorted(tmp_path.glob("*_r*"))))
    assert [bool(pair.absent) for pair in checked] == [False, True, False]


def test_some_images_without_most_of_one_size_are_refused(tmp_path):
    for k, rows in enumerate((4, 5)):
        for side in "lr":
            cv2.imwrite(str(tmp_path / f"{k}_{side}.png"), np.zeros((rows, 6), np.uint8))
    with raises("RIL-176", "6 x 5", "6 x 4"):
        common_headers(pair_up(sorted(tmp_path.glob("*_l.png")), sorted(tmp_path.glob("*_r.png"))))


def test_size_of_another_kind_of_file_is_read(tmp_path):
    for side in "lr":
        cv2.imwrite(str(tmp_path / f"a_{side}.pgm"), np.zeros((4, 6), np.uint16))
    headers, _ = common_headers(pair_up([tmp_path / "a_l.pgm"], [tmp_path / "a_r.pgm"]))
    assert headers == ((6, 4, 16), (6, 4, 16))


def test_unequal_counts_name_both_ends():
    left, right = [[Path(f"{side}/{k:03d}.png") for k in range(n)] for side, n in (("a", 5), ("b", 2))]
    with raises("RIL-256", "000.png to 004.png", "000.png to 001.png"):
        pair_up(left, right, "order")
    with raises("RIL-259", "000.png to 004.png", "000.png to 001.png"):
        pair_up(left, right, "name")


# -- time stamps -------------------------------------------------------------------------------------------------------

START = 1696059822_123456789


def stamped(form, offsets_ms):
    """Names of images at some times, ms after the start."""
    return [Path(form.format(ns=START + round(t * 1e6), s=(START + round(t * 1e6)) / 1e9)) for t in offsets_ms]


@pytest.mark.parametrize("form", ["{ns}.png", "cam_{ns}.png", "f{s:.6f}.png", "{ns}_left.png"])
@pytest.mark.parametrize("rule", ["auto", "nearest"])
def test_names_whose_stamps_differ_are_paired_by_the_nearest(form, rule):
    left, right = stamped(form, [0, 100, 200, 300]), stamped(form, [0.8, 100 - 0.9, 200.5, 299.7])
    lines: list[str] = []
    pairs = pair_up(left[::-1], right, rule, warnings=lines)
    assert [(p.left, p.right) for p in pairs] == list(zip(left, right, strict=True))
    assert len(lines) == 1
    assert "0.9 ms" in lines[0]


def test_seconds_and_nanoseconds_may_stand_apart():
    assert stamp_of("left_1696059822_023456789") == "1696059822.023456789"
    assert stamp_of("20231104_000012") == stamp_of("000048978") == ""
    names = [
        [Path(f"{side}_{1696059822 + k // 2}_{5 * (k % 2)}0{late}000000.png") for k in range(4)]
        for side, late in ("a1", "b3")
    ]
    assert [(p.left, p.right) for p in pair_up(*names)] == list(zip(*names, strict=True))


def test_an_image_that_was_lost_on_either_side_is_left_out():
    left, right = stamped("{ns}.png", [0, 100, 200]), stamped("{ns}.png", [0.8, 200.5, 299.7])
    lines: list[str] = []
    assert [(p.left, p.right) for p in pair_up(left, right, warnings=lines)] == [
        (left[0], right[0]),
        (left[2], right[1]),
    ]
    assert "2 images without a partner of the same time are left out" in lines[0]


def test_the_tolerance_follows_the_interval_and_is_stated():
    left, right = stamped("{ns}.png", [0, 8, 16, 24]), stamped("{ns}.png", [3, 11, 19, 27])
    with raises("RIL-822", "0.003 s apart"):  # a quarter of 8 ms is less
        pair_up(left, right)
    assert len(pair_up(left, right, tolerance=0.004)) == 4
    assert join([0.0, 1.0, 2.0], [0.02, 1.0, 2.0]).places == [(1, 1), (2, 2)]  # never more than 10 ms
    assert join([0.0, 0.1], [0.004, 0.006, 0.1]).places == [(0, 0), (1, 2)]  # no image in two pairs


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        ([0, 100, 200], [0.8, 200.5, 299.7], ("RIL-823", "was an image lost?")),  # one left and one right lost
        ([100, 200, 300, 400], [0, 100, 200, 300], ("RIL-823", "-0.1 s off")),  # all one frame apart, one clock
        ([0, 100, 200, 300], [7e6, 7e6 + 100, 7e6 + 200, 7e6 + 400], ("RIL-823", "nearest")),
    ],
)
def test_pairs_by_order_are_never_frames_apart(left, right, expected):
    with raises(*expected):
        pair_up(stamped("{ns}.png", left), stamped("{ns}.png", right), "order")


def test_equal_stamps_of_unlike_digits_are_pairs():
    left = [Path(f"left/{1_600_000_000 + k / 10:.3f}.png") for k in range(4)]
    right = [Path(f"right/{1_600_000_000 + k / 10:.6f}.png") for k in range(4)]
    assert [(pair.left, pair.right) for pair in pair_up(left, right)] == list(zip(left, right, strict=True))


def test_stamps_of_two_clocks_are_said():
    left, right = stamped("{ns}.png", [0, 100, 200]), stamped("{ns}.png", [7e6 + 3, 7e6 + 101, 7e6 + 204])
    with raises("RIL-822", "of two clocks"):
        pair_up(left, right)
    lines: list[str] = []
    assert len(pair_up(left, right, "order", warnings=lines)) == 3
    assert ["RIL-824" in line and "7000 s later" in line for line in lines] == [True]
    jitter = stamped("{ns}.png", [20, 115, 230])  # no frame apart, though too far for "nearest"
    assert len(pair_up(left, jitter, "order", warnings=lines)) == 3
    assert "0.02 s later" in lines[1]


@pytest.mark.parametrize("form", ["%Y-%m-%dT%H-%M-%S.%fZ", "%Y%m%d_%H%M%S_%f", "IMG_%Y:%m:%d_%H:%M:%S.%f"])
@pytest.mark.parametrize("later", [0.003, 0.02])
def test_dates_apart_by_a_constant_are_pairs(form, later):
    """3 ms are within the tolerance, 20 of 100 ms are two clocks, which is said."""
    start = datetime(2024, 5, 1, 12, tzinfo=UTC)
    moments = [[start + timedelta(seconds=k / 10 + shift) for k in range(12)] for shift in (0, later)]
    left, right = ([Path(f"{side}/{t.strftime(form)}.png") for t in of] for side, of in zip("ab", moments, strict=True))
    lines: list[str] = []
    pairs = pair_up(left, right, warnings=lines)
    assert [(p.left, p.right) for p in pairs] == list(zip(left, right, strict=True))
    assert ("RIL-824" if later > 0.01 else "RIL-821") in lines[0]
    with raises("RIL-822"):
        pair_up(left[:-1], [p.with_name(p.name.replace("2024", "2025")) for p in right])


def test_whole_seconds_tell_no_pairs():
    """The right image of a pair may be written a second later."""
    names = [(f"l/20231104_1015{k}0_{k}111.png", f"r/20231104_1015{k}{k}_{k}111.png") for k in range(4)]
    left, right = ([Path(name) for name in of] for of in zip(*names, strict=True))
    assert [(p.left, p.right) for p in pair_up(left, right)] == list(zip(left, right, strict=True))


def test_a_counter_after_a_date_is_no_time():
    left, right = ([Path(f"{s}/20231104_101500_{k:06d}{s}.png") for k in range(5, 9)] for s in "xy")
    assert [(p.left, p.right) for p in pair_up(left, right)] == list(zip(left, right, strict=True))


def test_a_date_that_all_names_share_is_no_time_stamp():
    left, right = ([Path(f"{side}_20231104101500_{k}.png") for k in range(3)] for side in ("a", "b"))
    assert [(p.left, p.right) for p in pair_up(left, right)] == list(zip(left, right, strict=True))
    with raises("RIL-822", "not each has its own"):
        pair_up(left, right, "nearest")


@pytest.mark.parametrize(
    ("stems", "told"),
    [
        ([f"run{run}_{k}" for run in (1, 2) for k in range(3)], True),
        (["0_long", "0_short", "1_long", "1_short"], True),
        (["0", "1", "10", "11"], False),
        (["run1_0", "run1_1", "run1_2"], False),
    ],
)
def test_two_sequences_in_one_folder_are_told(stems, told):
    lines = []
    left, right = ([Path(side, f"{stem}.png") for stem in stems] for side in ("left", "right"))
    assert len(pair_up(left, right, warnings=lines)) == len(stems)
    assert [line[:7] for line in lines] == (["RIL-835"] if told else [])


@pytest.mark.parametrize("first", [0, 1])
def test_a_counter_that_began_anew_goes_on_where_it_ended(first):
    names, lines = [f"{k:03d}.png" for k in (*range(996, 1000), *range(first, 3))], []
    shuffled = random.Random(1).sample(names, len(names))
    pairs = pair_up(paths(*(f"l/{n}" for n in shuffled)), paths(*(f"r/{n}" for n in names)), warnings=lines)
    assert [pair.left.name for pair in pairs] == [pair.right.name for pair in pairs] == names
    assert lines == [
        "RIL-707: the counter of the images began anew: they are taken from 996.png on to 002.png; if that is wrong, "
        "rename them"
    ]


@pytest.mark.parametrize(
    ("stems", "anew"),
    [
        (["235958", "235959", "000000", "000001"], True),
        (["t_23-59-58_90", "t_23-59-58_91", "t_00-00-00_10"], True),
        (["000000", "000100", "230000"], False),  # a counter
        (["20260503_000500", "20260503_235900"], False),
        ([f"{k:03x}" for k in (0, 1, 9, 10, 15, 16, 26)], False),
        (["f0a", "f1", "f1b"], False),
    ],
)
def test_times_of_day_pass_midnight_and_hexadecimal_numbers_count(stems, anew):
    lines, shuffled = [], random.Random(1).sample(stems, len(stems))
    pairs = pair_up(paths(*(f"l/{n}.png" for n in shuffled)), paths(*(f"r/{n}.png" for n in stems)), warnings=lines)
    assert [pair.name for pair in pairs] == stems
    assert [line[:7] for line in lines] == (["RIL-707"] if anew else [])


def test_a_counter_before_the_cameras_number_is_said_to_have_begun_anew():
    numbers, lines = [*range(995, 1000), *range(5)], []
    left, right = (paths(*(f"{k:03d}_cam{side}.png" for k in sorted(numbers))) for side in (0, 1))
    assert [pair.name for pair in pair_up(left, right, warnings=lines)] == [f"{k:03d}" for k in numbers]
    assert lines[0].startswith("RIL-707: ")


@pytest.mark.parametrize("numbers", [range(1000), [*range(400), *range(600, 1000)], [1, 2, 998], [2, 3, 999]])
def test_numbers_from_the_least_to_the_greatest_are_no_counter_that_began_anew(numbers):
    names, lines = [f"{k:03d}.png" for k in numbers], []
    pairs = pair_up(paths(*(f"l/{n}" for n in names)), paths(*(f"r/{n}" for n in names)), warnings=lines)
    assert [pair.left.name for pair in pairs if not pair.absent] == names
    assert not lines
