"""Folders of runs."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from raising import raises

from rille.pipeline.runs import session

NOW = datetime(2026, 1, 2, tzinfo=UTC)


@pytest.mark.parametrize("file", [False, True])
def test_what_is_no_link_to_a_run_is_told_before_anything_is_computed(tmp_path, file):
    (tmp_path / "latest").touch() if file else (tmp_path / "latest").mkdir()
    with raises("RIL-765", str(tmp_path / "latest")):
        session._make_folder(tmp_path, NOW, "plan")
    assert [p.name for p in tmp_path.iterdir()] == ["latest"]


def test_a_link_to_a_run_that_has_gone_is_moved(tmp_path):
    (tmp_path / "latest").symlink_to("gone")
    folder = session._make_folder(tmp_path, NOW, "plan")
    session._point_latest(folder)
    assert (tmp_path / "latest").resolve() == folder
