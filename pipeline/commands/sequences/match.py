"""``rille match``: any two images to a two-band disparity TIFF, without calibration or rectification."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from rille.datasets.images.files import read_grey, refuse_swapped
from rille.pipeline.engine.plain import raw, warn
from rille.pipeline.export.writers import Meaning, write_image
from rille.pipeline.flow import config as configuration
from rille.pipeline.runs.options import COMPLETE, FLAG, HOLES, Assignments, Output, check_output
from rille.stages.calibration.doubt import MIN_MATCHED_SHARE, doubts
from rille.stages.core.validity import Validity, matched
from rille.stages.imaging.levels import levelled


def match(
    left: Path,
    right: Path,
    *,
    output: Annotated[Path, Output] = Path("disparity.tif"),
    preset: Literal["default", "fast", "accurate", "paper"] | None = None,
    assignments: Assignments = (),
    dense: Annotated[bool, FLAG] = False,
    confidence: Path | None = None,
) -> int:
    """Match any two images, without calibration or rectification, to a two-band disparity TIFF.

    Band 1 is column_disparity and band 2 row_disparity, float32 pixels, right minus left (negative columns on a
    rectified pair), NaN where undefined.

    Parameters
    ----------
    left
        Reference image.
    right
        Search image.
    output
        TIFF to write.
    preset
        Parameter set of the matcher: fast matches at half the resolution, accurate takes several times as long, paper
        follows the publication to the letter.
    dense
        Fill undefined disparities by interpolation.
    confidence
        TIFF to write with the bands disparity_std (pixels, standard deviation along the epipolar line), validity (bits)
        and backmatch_error (pixels).
    """
    nested = configuration.parse_assignments(assignments)
    configuration.refuse_other_sections(nested, ("hfvm",), "match")
    # --set overrides --preset, as it does --config.
    given = ({} if preset is None else {"preset": preset}) | nested.get("hfvm", {})
    params: Any = configuration.validate(configuration.stages()["hfvm"].params, given, "hfvm")
    taken = {left.resolve(): "an image", right.resolve(): "an image"}
    check_output(output, ".tif", ".tiff", others=taken)
    if confidence is not None:
        check_output(confidence, ".tif", ".tiff", option="--confidence", others=taken | {output.resolve(): "--output"})
    # Images are checked before the import of the matcher, which takes seconds.
    stored = read_grey(left), read_grey(right)
    refuse_swapped(stored, f"{left} and {right}")
    images, spread = levelled(stored)

    from rille.pipeline.flow import tiles
    from rille.stages.hfvm import stage as hfvm
    from rille.stages.imaging.pyramid import PyramidParams

    shapes = images[0].shape, images[1].shape
    with _progress(max(image.size for image in images)) as tell:
        options = tiles.match_options(tiles.Tiling(), params, PyramidParams(), shapes, tell)
        result = hfvm.match(images[0], images[1], params, options=options)
    kept = np.isfinite(result.column_disparity) if dense else matched(result.validity)
    tags = {"LEFT": left.name, "RIGHT": right.name}
    about = {"convention": "right minus left, pixels of the left image, NaN undefined", "FILLED": str(dense).lower()}
    disparities = {n: np.where(kept, getattr(result, n), np.nan) for n in ("column_disparity", "row_disparity")}
    write_image(output, disparities, Meaning("pixel", tags=about | tags))
    if confidence is not None:
        bits = ", ".join(f"{bit.value} {str(bit.name).lower()}" for bit in Validity)
        units = {"disparity_std": "pixel", "validity": "", "backmatch_error": "pixel"}
        bands = {name: getattr(result, name) for name in units}
        write_image(confidence, bands, Meaning(units, tags={"validity": f"sum of {bits}", **tags}))
    for line in (*spread, *doubts(result, *images)):
        warn(line)
    share = float(matched(result.validity).mean())
    typical = f", standard deviation {np.nanmedian(result.disparity_std):.2f} px (median)" if share else ""
    figures = f"matched {100 * share:.1f} %, defined {100 * float(kept.mean()):.1f} % of {kept.size} pixels"
    print(f"{output}  {figures}{typical}")
    return COMPLETE if share >= MIN_MATCHED_SHARE else HOLES


@contextmanager
def _progress(pixels: int) -> Iterator[Callable[[float, str], None]]:
    """Callback that shows share and step of a large match as a bar, if stderr is a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    # Images below a megapixel match in less than seconds.
    disable = pixels < 1_000_000 or not sys.stderr.isatty()
    with Progress(console=Console(file=raw(sys.stderr)), transient=True, disable=disable) as bar:
        task = bar.add_task("matching", total=1.0)
        yield lambda share, step: bar.update(task, completed=share, description=step)
