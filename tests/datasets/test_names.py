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


@pytest.mark.parametrize(
    ("folder", "name"), [("été", "ete"), ("Süd 2", "Sud_2"), ("day 1 #ä", "day_1_a"), ("latest", "sequence")]
)
def test_letters_lose_their_accents(folder, name):
    assert derived_name(folder) == name


@pytest.mark.parametrize("folders", [("東京", "京都"), ("день1", "ночь1"), ("Straße", "Strae")])
def test_folders_in_other_alphabets_do_not_share_a_name(folders):
    names = {derived_name(folder) for folder in folders}
    assert len(names) == 2
    for name in names:
        check_name(name)


@given(st.text())
def test_any_folder_gives_a_name(text):
    check_name(derived_name(text))
