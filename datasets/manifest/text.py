"""A commented manifest of the findings in a folder, with marks at missing entries."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rille.datasets.inspection.calibration import FoundCalibration
from rille.datasets.inspection.folder import Findings
from rille.datasets.inspection.views import FoundImages
from rille.datasets.manifest.rig import LONGEST_BASELINE
from rille.datasets.text.names import derived_name
from rille.stages.core.quantities import count, some

NEEDED = "NEEDED"
"""Mark of a line that must be filled in before the manifest opens."""


def manifest_text(found: Findings, root: str) -> str:
    """Manifest as TOML; ``root`` is the folder relative to the manifest (or absolute)."""
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters["toml"] = _value
    # Names of files may hold line breaks, which would end a comment.
    environment.finalize = lambda value: " ".join(value.splitlines()) if isinstance(value, str) else value
    # The template, beside this module, has fields for the findings.
    return environment.get_template("template.toml.jinja").render(
        **vars(found),
        name=derived_name(found.folder.resolve().name),
        root=root,
        pairs=pair_words(found.views),
        sizes=size_words,
        longest_baseline=LONGEST_BASELINE,
        mount=_mount(found.calibration),
    )


def _mount(calibration: FoundCalibration | None) -> str:
    """Pose of the left camera in the calibration's reference frame, or an example, as the value of a key."""
    stated = np.eye(3, 4) if calibration is None or calibration.mount is None else calibration.mount.matrix34
    return "[{}]".format(", ".join(f"[{', '.join(f'{x:.9g}' for x in row)}]" for row in stated))


def _value(value: Any) -> str:
    """A value in TOML."""
    return tomli_w.dumps({"key": value}).removeprefix("key = ").rstrip()


def needs(text: str) -> list[str]:
    """Lines of a manifest's text that are marked as needed."""
    return [line.split(NEEDED, 1)[1].lstrip(": ") for line in text.splitlines() if f"# {NEEDED}:" in line]


def pair_words(views: FoundImages) -> str:
    """Number of pairs, and of those that lack an image, in words."""
    return count(views.pairs, "pair") + (f" ({some(views.absent, 1)})" if views.absent else "")


def size_words(sizes: Iterable[tuple[int, int] | None]) -> str:
    """The distinct known sizes, in words."""
    return " and ".join(dict.fromkeys(f"{size[0]} x {size[1]}" for size in sizes if size is not None))
