"""Restore the links of ``rille/`` where they were lost, and compile the matcher's native solver."""

from __future__ import annotations

import importlib.util
import sysconfig
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NATIVE = "stages/hfvm/native"


class Preparation(BuildHookInterface):
    """Run before the files of a wheel, of an editable one, too, are collected."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Replace each file that holds the text of a link by the link, and compile."""
        root = Path(self.root)
        for name in ("pipeline", "stages", "datasets"):
            link = root / "rille" / name
            # A zip of the repository that pip unpacks has the text of a link in its place.
            if link.is_file():
                link.unlink()
                link.symlink_to(f"../{name}")
        if self.target_name != "wheel":
            return
        binary = _builder(root / "rille" / NATIVE / "build.py").compiled()
        if binary is None:
            self.app.display_warning("rille: no C compiler (cc), so that matching will take two to three times as long")
            return
        # It calls nothing of Python's, so that one binary serves every version.
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
        if version != "editable":
            build_data["force_include"][str(binary)] = f"rille/{NATIVE}/{binary.name}"


def _builder(path: Path) -> ModuleType:
    """Load the module that compiles: by its path, since the package is not there yet."""
    spec = importlib.util.spec_from_file_location("rille_native_build", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
