"""Restore the links of ``rille/`` where the repository was unpacked without them, as pip unpacks a zip of it."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Links(BuildHookInterface):
    """Run before the files of a wheel are collected."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Replace each file that holds the text of a link by the link."""
        for name in ("pipeline", "stages", "datasets"):
            link = Path(self.root) / "rille" / name
            if link.is_file():
                link.unlink()
                link.symlink_to(f"../{name}")
