"""``rille datasets export``: a folder as a whole, or none."""

from __future__ import annotations

from pathlib import Path

import pytest
from raising import raises

from rille.pipeline.commands.sequences import datasets


def test_existing_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for there in (tmp_path, tmp_path / "mine.txt"):
        with raises("RIL-607"):
            datasets.export_dataset("mockup-short", there, cache=str(tmp_path / "cache"))
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_interrupted_export_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks_off(_: object, folder: Path, __: object) -> None:
        folder.mkdir()
        (folder / "calib.txt").write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr(datasets, "export", breaks_off)
    with pytest.raises(KeyboardInterrupt):
        datasets.export_dataset("mockup-short", tmp_path / "here" / "bed", cache=str(tmp_path / "cache"))
    assert list((tmp_path / "here").iterdir()) == []
