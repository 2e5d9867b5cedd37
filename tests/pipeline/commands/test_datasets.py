"""``rille datasets``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rille.pipeline import cli
from rille.pipeline.commands.sequences import datasets


def test_a_full_disk_is_said_with_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> Path:
        raise OSError(28, "No space left on device")  # as a write gives it: without a name

    monkeypatch.setattr(datasets, "export", full)
    command = ["datasets", "export", "mockup-short", str(tmp_path / "copy"), "--cache", str(tmp_path / "cache")]
    assert cli._run(command) == 1
    assert f"RIL-737: {tmp_path / 'copy'}: No space left on device" in capsys.readouterr().err
