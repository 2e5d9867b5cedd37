"""``rille check``: open everything of a sequence, match its first pair, and say in one line each what to expect.

Images, disparity and motions are the tasks of a reconstruction with the same parameters, made by the same builder: what
is computed here is cached for it.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.protocol import CAMERAS, Sequence
from rille.pipeline.commands.options import COMPLETE, FAILED, Output, Settings, cache_folder, check_output
from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.graph import Graph, Handle, Maybe, MissingError, Wait
from rille.pipeline.engine.run import Result, RunOptions, run
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow.builders import Builder, name
from rille.pipeline.flow.unread import refuse_unchecked
from rille.pipeline.runs import input_checks as judge
from rille.pipeline.runs.input_checks import Finding
from rille.pipeline.runs.session import settings
from rille.stages.core.errors import RilleError
from rille.stages.geometry.epipolar import beyond_infinity, inverse_depth
from rille.stages.imaging.image_quality import Look, look

Floats = NDArray[np.float64]
Steps = Generator[Wait, Any, None]

MAX_MOTIONS = 12
"""Successive pairs whose motion is measured, spread over the sequence: a sample tells what a run can expect."""

MAX_PAIRS = 6
"""Pairs whose rows are compared with those of shifted right images, spread over the sequence."""

NOISE_BEYOND_INFINITY_PX = 1.0

MAX_NAMED = 3
"""Damaged images that are named one by one; the rest is counted."""

_SETTINGS = Settings()


def check(seq: str, *, output: Annotated[Path | None, Output] = None, options: Settings = _SETTINGS) -> int:
    """Check a sequence: one finding a line, and a picture of the first pair's epipolar residuals.

    Parameters
    ----------
    seq
        As for reconstruct.
    output
        PNG to write; SEQUENCE-check.png by default.
    """
    settled = settings(replace(options, sequence=seq))
    refuse_unchecked(settled.given, settled.config)
    path = output if output is not None else Path(f"{settled.sequence.name}-check.png")
    check_output(path, ".png", ".pdf", ".svg")
    return inspect(settled.sequence, settled.config, path, settled.frames, cache_folder(options.cache))


def inspect(sequence: Sequence, config: Any, path: Path, frames: tuple[int, ...], cache: Path) -> int:
    """Print a line for each finding, and draw the first pair's epipolar residuals; 0, or 1 where something fails.

    Raises
    ------
    RilleError
        The picture cannot be written.
    """
    graph, store = Graph(), Store(cache)
    name(graph, sequence, frames)
    inspection = Inspection(Builder(graph, sequence, config), frames, store)
    graph.flow(inspection.steps())
    # In this process: workers would take longer to start than most of this takes.
    result = run(graph, store, RunOptions(executor="inline", keep_going=True))
    # What a stage refuses is a finding, said by then; any other failure is one of the program.
    Result(failures=[f for f in result.failures if not (f.stage and isinstance(f.error, RilleError))]).check()
    if inspection.match is not None and len(inspection.match.left):
        draw(path, sequence.name, sequence.frame_names[inspection.match.frame], inspection.match)
        print(f"picture       {path}")
    levels = inspection.levels
    print(f"{sequence.name}: {levels['FAIL']} fail, {levels['WARN']} to look at, {levels['OK']} fine")
    return FAILED if levels["FAIL"] else COMPLETE


@dataclass(frozen=True)
class Match:
    """A matched pair: left image (row, col), thinned matches (n, 2) px and their epipolar residuals (n,) px."""

    frame: int
    image: NDArray[Any]
    left: Floats
    right: Floats
    residual: Floats


class Inspection:
    """A flow that prints each finding as soon as it is known."""

    def __init__(self, make: Builder, frames: tuple[int, ...], store: Store) -> None:
        self.make, self.store, self.sequence = make, store, make.sequence
        self.lost = {f: why for f, why in self.sequence.lost.items() if f in frames}
        self.frames = tuple(f for f in frames if f not in self.lost)
        self.match: Match | None = None
        self.levels: Counter[str] = Counter()
        self.broken: set[tuple[int, str]] = set()

    def say(self, *findings: Finding | None) -> None:
        """Print findings, and count them by level."""
        for finding in filter(None, findings):
            print(finding, flush=True)
            self.levels[finding.level] += 1

    def refused(self, error: RilleError, subject: str, where: str = "") -> None:
        """Print the finding that an error is."""
        self.say(Finding(error.code, f"{where}{error.message}", subject, "FAIL", error.remedy))

    def steps(self) -> Steps:
        """Look at everything, the cheap things first."""
        s = self.sequence
        self.say(judge.judge("sequence", f"{s.name}, {len(self.frames)} of {s.frames} pairs"))
        for frame, why in self.lost.items():
            self.say(judge.judge("images", f"frame {s.frame_names[frame]}: {why}", {"lost": 1}))
        self.say(*(Finding("", line, "input", "WARN") for line in s.warnings))  # it begins with its code
        self.say(judge.judge_rig(s.rig))
        self.say(judge.judge_times(None if s.times is None else [s.times[k] for k in self.frames]))
        self.say(judge.judge_truth(s.truth, self.frames, s.truth_positions))
        self.say(judge.judge_attitude(s.attitude, s.truth, self.frames))
        self.say(judge.judge_up(s.up, self.frames))
        yield from self._images()
        whole = [k for k in self.frames if not any((k, camera) in self.broken for camera in CAMERAS)]
        if not whole:
            self.say(judge.judge("matching", "no pair of images is whole", {"whole pairs": 0}))
            return
        yield from self._first_pair(whole[0])
        yield from self._motions()
        if len(whole) > 1:
            rows = yield self.make.synchrony("synchrony", _spread(whole, MAX_PAIRS), whole)
            self.say(judge.judge_synchrony(rows.meta))

    def _images(self) -> Steps:
        """Open every image: sizes, repetitions, exposure, sharpness."""
        looks: dict[str, dict[int, Look]] = {camera: {} for camera in CAMERAS}
        digests: dict[str, dict[int, str]] = {camera: {} for camera in CAMERAS}
        sizes, errors = set(), list[RilleError]()
        images = {(frame, camera): self.make.taken(frame, camera) for frame in self.frames for camera in CAMERAS}
        yield Maybe(list(images.values()))
        for (frame, camera), handle in images.items():
            try:
                if handle.ref is None:
                    raise _cause(handle)
                bundle = self.store.open(handle.ref)
            except RilleError as error:
                errors.append(error)
                self.broken.add((frame, camera))
                continue
            image = np.asarray(bundle["image"])
            sizes.add(f"{image.shape[1]} x {image.shape[0]} {image.dtype}")
            looks[camera][frame] = look(image, np.asarray(bundle["valid"]))
            digests[camera][frame] = hashlib.sha256(image.tobytes()).hexdigest()
        for refusal in errors[:MAX_NAMED]:
            self.refused(refusal, "images")
        whole = f"all {len(images)} open, {' and '.join(sorted(sizes))}"
        text = f"{len(errors)} of {len(images)} images cannot be used" if errors else whole
        self.say(judge.judge("images", text, {"unusable": len(errors)}))
        self.say(*self._repeated(digests))
        self.say(*judge.judge_looks(looks, self.sequence.frame_names))

    def _repeated(self, digests: Mapping[str, Mapping[int, str]]) -> Generator[Finding, None, None]:
        names = self.sequence.frame_names
        same = [k for k, digest in digests["left"].items() if digests["right"].get(k) == digest]
        if same:
            text = f"left and right are one image in {len(same)} pairs, first frame {names[same[0]]}"
            yield judge.judge("images", text, {"left and right are one": len(same)})
        for camera, of in digests.items():
            stuck = [b for a, b in pairwise(of) if of[a] == of[b]]
            if stuck:
                text = f"{len(stuck)} {camera} images repeat the one before, first frame {names[stuck[0]]}"
                yield judge.judge("images", text, {"repeated": len(stuck)})

    def _first_pair(self, pair: int) -> Steps:
        """Match one pair, and compare it with the rig."""
        tasks = [self.make.image(pair, "left"), self.make.disparity(pair), self.make.orientation(pair)]
        try:
            image, disparity, oriented = yield tasks
            arrays = {k: np.asarray(v, np.float64) for k, v in self.store.open(oriented).arrays.items()}
            shown = np.asarray(self.store.open(image)["image"])
        except (MissingError, RilleError) as missing:
            error = _cause(missing.handles[0]) if isinstance(missing, MissingError) else missing
            self.refused(error, "matching", f"frame {self.sequence.frame_names[pair]}: ")
            return
        used = arrays["weight"] > 0
        used = used if used.any() else np.ones(len(used), bool)
        left, right, residual = (arrays[name][used] for name in ("left", "right", "residual_before"))
        self.match = Match(pair, shown, left, right, residual)
        rig = self.sequence.rig
        rho, _ = inverse_depth(rig, left, right - left)
        self.say(judge.judge_matching(disparity.meta["match_rate"], 1.0 / rho[rho > 0], rig.baseline))
        if len(left):
            beyond = beyond_infinity(rig, left, right) > NOISE_BEYOND_INFINITY_PX
            self.say(judge.judge_sides(float(beyond.mean())))
        self.say(judge.judge_epipolar(oriented.meta))

    def _motions(self) -> Steps:
        """Overlap of some successive left images."""
        # Evenly over the sequence, so that a fault of its second half is found as well.
        chosen = _spread(list(pairwise(self.frames)), MAX_MOTIONS)
        tasks = {(a, b): self.make.motion(a, b) for a, b in chosen if not {(a, "left"), (b, "left")} & self.broken}
        yield Maybe(list(tasks.values()))
        for task in tasks.values():
            if task.ref is None:
                self.refused(_cause(task), "motion")
        motions = {step: task.ref.meta for step, task in tasks.items() if task.ref is not None}
        self.say(judge.judge_motion(motions, self.sequence.frame_names))


def _spread(items: list[Any], most: int) -> list[Any]:
    """At most so many of the items, evenly over all of them."""
    return [items[k] for k in sorted({int(k) for k in np.linspace(0, len(items) - 1, most).round()})] if items else []


def _cause(handle: Handle) -> RilleError:
    """Why a task has no artifact.

    Raises
    ------
    Exception
        What no stage should raise.
    """
    while handle.error is None:
        handle = next(upstream for upstream in handle.upstream() if not upstream.done)
    if not isinstance(handle.error, RilleError):
        raise handle.error
    return handle.error


def draw(path: Path, name: str, frame: str, match: Match) -> None:
    """Picture of the epipolar residuals of one pair under the given rig: where, how large, and along columns and rows.

    Raises
    ------
    RilleError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    points, residual, shown = match.left, match.residual, match.image.astype(np.float32)
    # Scaled by the bulk, not by the worst match: a few outliers would wash all the others out.
    limit = max(0.5, float(np.percentile(np.abs(residual), 98)))
    height = 11.0 * min(shown.shape[0] / shown.shape[1], 0.8)  # inches
    fig = Figure(figsize=(11.0, height + 2.8), layout="constrained")
    plots: Any = fig.subplot_mosaic("III;CRH", height_ratios=[height, 2.8])
    plots["I"].imshow(shown, cmap="gray", vmin=np.percentile(shown, 1), vmax=np.percentile(shown, 99))
    shades = {"c": residual, "cmap": "coolwarm", "vmin": -limit, "vmax": limit}
    drawn = plots["I"].scatter(*points.T, s=9, linewidths=0, **shades)
    fig.colorbar(drawn, ax=plots["I"], label="px below the line", pad=0.01, aspect=30)
    plots["I"].set_title(f"{name}, frame {frame}: epipolar residuals of the right image under the given rig")
    for plot, axis, label in (("C", 0, "column in the left image"), ("R", 1, "row in the left image")):
        plots[plot].scatter(points[:, axis], residual, s=3, color="0.3", linewidths=0)
        plots[plot].axhline(0.0, color="tab:red", linewidth=1)
        plots[plot].set(xlabel=label, ylabel="residual, px", ylim=(-1.5 * limit, 1.5 * limit))
    plots["H"].hist(residual, bins=60, range=(-1.5 * limit, 1.5 * limit), color="0.5")
    plots["H"].set(xlabel="residual, px", ylabel="matches")
    with reported("RIL-016", f"cannot write {path}", remedy="choose another --output"):
        fig.savefig(path, dpi=110)
