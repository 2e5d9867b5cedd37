"""``rille match``: any two images to a two-band disparity TIFF, without calibration or rectification."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from rille.datasets.text.warning import warning
from rille.pipeline.commands.options import COMPLETE, HOLES, check_output
from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.plain import raw, warn
from rille.pipeline.flow import config as configuration
from rille.stages.core.errors import ConfigError, InputError
from rille.stages.imaging import levels

if TYPE_CHECKING:
    from rille.stages.hfvm.stage import Disparity

LARGE = 1_000_000
"""Pixels: above, matching takes seconds, and says how far it is."""

INTERVAL = 5.0
"""Seconds between lines where stderr is no terminal."""

FEW = 0.05
"""Share of matched pixels at which two images have little to do with each other; unrelated ones stay below."""

BLANK = 0.5
"""Share of pixels without texture of which a user should hear, however well the others match."""

Tell = Callable[[float, str], None]


def match_files(
    left: Path,
    right: Path,
    output: Path,
    params: Any,
    *,
    dense: bool,
    prior: Path | None = None,
    confidence: Path | None = None,
) -> int:
    """Match two image files and write ``column_disparity`` and ``row_disparity``, float32 pixels, NaN undefined.

    Parameters
    ----------
    left, right : image files.
    output : TIFF to write.
    params : of the matcher, as :func:`matcher_params` gives them.
    dense : write filled values, too, and not only consistent matches.
    prior : disparity TIFF to start from.
    confidence : TIFF to write with standard deviation, validity and back-matching error.

    Returns
    -------
    0, or 3 where hardly a pixel matches (share below ``FEW``).

    Raises
    ------
    ConfigError
        An output is a folder, no TIFF, an image that is read, or the other output.
    InputError
        An image or the prior cannot be read, or the prior is not of the left image's size.
    """
    from rille.datasets.images.files import read_grey
    from rille.pipeline.export.writers import write_confidence, write_disparity

    taken = {left.resolve(): "an image", right.resolve(): "an image"}
    for name, path in (("--output", output), ("--confidence", confidence)):
        if path is None:
            continue
        check_output(path, ".tif", ".tiff")
        if path.resolve() in taken:
            what = taken[path.resolve()]
            raise ConfigError("RIL-043", f"{name} and {what} are both {path}", remedy="give another name")
        taken[path.resolve()] = name
    # Images and the prior are checked before the matcher is imported, which takes seconds.
    images = read_grey(left), read_grey(right)
    found_levels = levels.levels_of(images)
    levelled = [] if found_levels is None else [warning("RIL-705", levels.words(found_levels))]
    images = levels.spread(images[0], found_levels), levels.spread(images[1], found_levels)
    given = _prior(prior, images[0].shape) if prior is not None else None

    from rille.pipeline.flow import tiles
    from rille.stages.core.validity import matched
    from rille.stages.hfvm.stage import match
    from rille.stages.imaging.pyramid import PyramidParams

    side = tiles.side(tiles.Tiling(), params, PyramidParams(), (images[0].shape, images[1].shape))
    with _progress(max(image.size for image in images), sys.stderr) as tell:
        found = match(*images, params, prior=given, tell=tell, side=side)
    kept = np.isfinite(found.column_disparity) if dense else matched(found.validity)
    column = np.where(kept, found.column_disparity, np.nan)
    row = np.where(kept, found.row_disparity, np.nan)
    tags = {"LEFT": left.name, "RIGHT": right.name}
    with _written(output):
        write_disparity(output, column, row, tags | {"FILLED": str(dense).lower()})
    if confidence is not None:
        with _written(confidence):
            write_confidence(confidence, found.disparity_std, found.validity, found.backmatch_error, tags)
    for line in (*levelled, *warnings(found, *images)):
        warn(line)
    share = float(matched(found.validity).mean())
    typical = f", standard deviation {np.nanmedian(found.disparity_std):.2f} px (median)" if share else ""
    figures = f"matched {100 * share:.1f} %, defined {100 * float(kept.mean()):.1f} % of {kept.size} pixels"
    print(f"{output}  {figures}{typical}")
    return COMPLETE if share >= FEW else HOLES


def _written(path: Path) -> AbstractContextManager[None]:
    return reported("RIL-991", f"{path} cannot be written", remedy="name another file", kind=InputError)


def warnings(found: Disparity, left: NDArray[Any], right: NDArray[Any]) -> list[str]:
    """List signs that two matched images do not fit, one line each with its figure."""
    from rille.stages.core.validity import Validity, has, matched, matched_back
    from rille.stages.hfvm import doubt
    from rille.stages.hfvm.swap_check import swapped

    share = float(matched(found.validity).mean())
    if share < FEW:
        reasons = (
            (Validity.NO_TEXTURE, "have no texture (black, saturated or blank)"),
            (Validity.OUT_OF_IMAGE, "have their match outside the right image"),
            (Validity.BACKMATCH_FAILED, "do not match back"),
            (Validity.OVER_THRESHOLD, "look like nothing in the right image"),
            (Validity.SPECKLE, "lie in isolated patches"),
        )
        # The two most frequent reasons: they tell a user whether the light, the order or the scene is at fault.
        shares = sorted(((float(has(found.validity, bit).mean()), words) for bit, words in reasons), reverse=True)
        frequent = ", ".join(f"{100 * s:.0f} % {words}" for s, words in shares[:2] if s >= 0.005)
        text = f"only {100 * share:.1f} % of the pixels match ({frequent}): do both images show one scene in one light?"
        return [warning("RIL-700", text)]
    blank = float(has(found.validity, Validity.NO_TEXTURE).mean())
    if blank > BLANK:
        text = f"{100 * blank:.0f} % of the pixels have no texture (black, saturated or blank) and cannot match"
        return [warning("RIL-701", text)]
    ok = matched_back(found.validity, found.backmatch_error)
    # Of images of unlike size nobody knows how their middles correspond, and so which displacement far things have.
    if left.shape == right.shape and swapped(found.column_disparity, found.row_disparity, ok):
        median = float(np.median(found.column_disparity[ok]))
        text = (
            f"disparities have the sign of swapped images (median {median:+.1f} px, right minus left): if this is "
            "a pair of a left and a right camera, give them in the other order"
        )
        return [warning("RIL-702", text)]
    judged, signs = doubt.judge(left, right, found, ok), list[str]()
    if judged is not None and judged[0] < doubt.RIGID:
        text = (
            f"only {100 * judged[0]:.0f} % of the matches lie within {doubt.NEAR:.0f} px of one epipolar geometry: "
            "wrong matches, things that move, or a lens that distorts: look at them first"
        )
        signs.append(warning("RIL-703", text))
    if judged is not None and judged[1] > doubt.REPEATED:
        text = (
            f"{100 * judged[1]:.0f} % of the matches look as well elsewhere on their epipolar line: on a repeating "
            "pattern they may be off by a period: look at them first"
        )
        signs.append(warning("RIL-704", text))
    return signs


def _prior(path: Path, shape: tuple[int, ...]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Prior disparities, checked against the left image's shape."""
    from rille.pipeline.export.writers import read_disparity

    column, row = read_disparity(path, shape)
    if not (np.isfinite(column) & np.isfinite(row)).any():
        raise InputError(
            "RIL-045", f"prior disparity {path} is undefined everywhere", remedy="leave --prior-disparity out"
        )
    return column, row


def matcher_params(preset: str | None, assignments: tuple[str, ...]) -> Any:
    """Parameters of the matcher from ``--preset`` and ``--set hfvm.key=value``."""
    nested = configuration.parse_assignments(assignments)
    if set(nested) - {"hfvm"}:
        # Refused, not passed over: nothing here reads another section.
        other = next(k for k in nested if k != "hfvm")
        raise ConfigError(
            "RIL-046", f"--set {other}: match has the section hfvm only", remedy="write --set hfvm.key=value"
        )
    values: dict[str, Any] = dict(nested.get("hfvm", {}))
    if preset is not None and values.setdefault("preset", preset) != preset:
        raise ConfigError(
            "RIL-986",
            f"--preset {preset} and --set hfvm.preset={values['preset']} contradict each other",
            remedy="leave one of them out",
        )
    return configuration.validate(configuration.stage("hfvm").params, values, "hfvm")


@contextmanager
def _progress(pixels: int, stream: TextIO) -> Iterator[Tell | None]:
    """Callback that shows share and step of a large match: a bar on a terminal, a line now and then elsewhere."""
    if pixels < LARGE:
        yield None
    elif stream.isatty():
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(file=raw(stream)), transient=True) as bar:
            task = bar.add_task("matching", total=1.0)
            yield lambda share, step: bar.update(task, completed=share, description=step)
    else:
        yield _lines(stream)


def _lines(stream: TextIO) -> Tell:
    shown = time.monotonic()

    def tell(share: float, step: str) -> None:
        nonlocal shown
        if time.monotonic() - shown >= INTERVAL:
            shown = time.monotonic()
            print(f"rille: {step}, {100 * share:.0f} %", file=stream, flush=True)

    return tell
