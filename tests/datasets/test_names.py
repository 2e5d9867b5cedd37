from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from raising import raises

from rille.datasets.mockup.params import MockupParams
from rille.datasets.mockup.sequence import mockup
from rille.datasets.text.names import check_name, derived_name


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "../x",
        "/tmp/x",
        "a/b",
        "a\\b",
        ".hidden",
        "-x",
        "a b",
        "a\nb",
        "a\x1b[2J",
        "ä",
        "x" * 81,
        "latest",
    ],
)
def test_a_sequence_has_no_name_that_leaves_its_folder(name):
    with raises("RIL-764") as caught:
        mockup(MockupParams(), name)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("name", ["x", "kitti-00", "V1_01.easy", "x" * 80])
def test_usual_names_are_permitted(name):
    check_name(name)
    assert derived_name(name) == name


@given(st.text())
def test_any_folder_gives_a_name(text):
    check_name(derived_name(text))
