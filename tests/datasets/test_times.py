"""Time stamps: unit, order."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises

from rille.datasets.text.times import UNITS, seconds, undated


@pytest.mark.parametrize(
    ("first", "step"),
    [
        ("1403715273262142976", 50_000_000),
        ("1403715273262142", 50_000),
        ("1403715273262", 50),
        ("1403715273", 1),
    ],
    ids=["ns", "us", "ms", "s"],
)
def test_stamps_since_1970_tell_their_unit(first, step):
    stamps = [str(int(first) + k * step) for k in range(4)]
    times = seconds(stamps, "stamps")
    assert int(times[0]) == 1403715273
    np.testing.assert_allclose(np.diff(times), 1.0 if step == 1 else 0.05, atol=3e-7)


def test_digits_survive_until_the_division():
    # as a float64 the stamp itself would already be 64 ns off
    times = seconds(["1403715273262142977", "1403715274262142977"], "stamps")
    assert times[0] == float(Fraction(1403715273262142977, 10**9))


def test_small_stamps_are_seconds_unless_stated():
    assert seconds([0, 0.1, np.float64(0.2)], "t") == (0.0, 0.1, 0.2)
    assert seconds([0, 100, 200], "t", unit="ms") == (0.0, 0.1, 0.2)
    assert seconds([np.int64(0), np.int64(10**8)], "t", unit="ns") == (0.0, 0.1)
    assert seconds([], "t") == ()


def test_small_stamps_in_a_larger_unit_are_refused():
    with raises("RIL-687", "5e+04 s", 'unit = "us"'):
        seconds([51_648_500_652 + 50_000 * k for k in range(3)], "t")  # since the start, no year 3606
    with raises("RIL-687", "5e+07 s"):
        seconds([0, 50_000_000, 100_000_000], "t")
    with raises("RIL-687", "1e-10 s", 'unit = "s"'):
        seconds([0.0, 0.1, 0.2], "t", unit="ns")
    assert seconds([0, 5000], "t", unit="s") == (0.0, 5000.0)
    assert seconds(["1500000000", "1500086400"], "t") == (1.5e9, 1500086400.0)


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        (["1403715273262142976", "1403715273312"], ("RIL-292", "line 22")),
        (["1", "2", "2", "3"], ("RIL-293", "line 23")),
        (["1", "2", "1.5"], ("RIL-293", "line 23", "1.5")),
        (["1400000000.1", "1400000000.4", "1400000000.40000005", "1400000000.7"], ("RIL-293", "line 23", "twice")),
        (["1", "two"], ("RIL-291", "line 22", "'two'")),
        (["1", "nan"], ("RIL-291", "line 22", "'nan'")),
        (["0", "1e-999999999", "1", "2"], ("RIL-291", "line 22")),
    ],
)
def test_what_is_wrong_names_the_line(stamps, expected):
    with raises(*expected) as caught:
        seconds(stamps, "t.csv", lines=range(21, 21 + len(stamps)))
    assert str(caught.value).startswith("t.csv")
    assert caught.value.remedy


@given(
    steps=st.lists(st.integers(1000, 10**12), min_size=1, max_size=20),
    start=st.integers(0, 2 * 10**18),
    unit=st.sampled_from(sorted(UNITS)),
)
@settings(max_examples=50, deadline=None)
def test_any_increasing_stamps_of_a_stated_unit(steps, start, unit):
    stamps = [start + int(v) for v in np.cumsum(steps)]
    assert seconds(stamps, "t", unit=unit) == tuple(float(Fraction(s, UNITS[unit])) for s in stamps)


@pytest.mark.parametrize(
    "text",
    [
        "20240101120000.png",
        "2024-01-01T12:00:00Z",
        "2024/01/01 12:00:00 a",
        "img_20240101-120000",
        "2024-01-01T14:00:00+02:00",
        "2024-01-01 06:00:00.000 -0600",
    ],
)
def test_dates_become_seconds(text):
    assert "1704110400.0" in undated(text)


@pytest.mark.parametrize(
    "text", ["1912010203040506", "1403715273262142976", "20241301_120000", "20090101_000061", "1920x1080"]
)
def test_other_numbers_stay(text):
    assert undated(text) == text
