"""``rille check``: open everything of a sequence, match its first pair, and say in one line each what to expect.

Images, disparity and motions are the tasks of a reconstruction with the same parameters, made by the same builder: what
is computed here is cached for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.protocol import CAMERAS, Sequence
from rille.pipeline.commands.options import COMPLETE, FAILED, check_output
from rille.pipeline.engine.failures import reported
from rille.pipeline.engine.graph import Graph, Handle, Maybe, MissingError, Wait
from rille.pipeline.engine.run import Result, RunOptions, run
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow.builders import Builder, name
from rille.pipeline.runs import input_checks as judge
from rille.pipeline.runs.input_checks import Finding, doubt, fault, fine
from rille.stages.core.errors import RilleError
from rille.stages.geometry.epipolar import beyond_infinity, inverse_depth
from rille.stages.imaging.image_quality import Look, look

Floats = NDArray[np.float64]
Steps = Generator[Wait, Any, None]

MOST_MOTIONS = 12
"""Successive pairs whose motion is measured, spread over the sequence: a sample tells what a run can expect."""

MOST_PAIRS = 6
"""Pairs whose rows are compared with those of shifted right images, spread over the sequence."""

BEYOND = 1.0
"""Pixels beyond infinity that noise does not reach."""

WIDTH, LOWER = 11.0, 2.8
"""Inches: the picture's width, and the height of its lower plots."""

FIRST_NAMED = 3
"""Damaged images that are named one by one; the rest is counted."""


def check(
    sequence: Sequence,
    config: Any,
    *,
    output: Path | None = None,
    frames: tuple[int, ...],
    cache: Path,
) -> int:
    """Judge a sequence: prints a line for each finding, and draws the first pair's epipolar residuals.

    Parameters
    ----------
    sequence : what to look at.
    config : parameters of the stages.
    output : PNG to write; ``SEQUENCE-check.png`` here by default.
    frames : frames to look at.
    cache : folder of cached artifacts.

    Returns
    -------
    0, or 1 where something fails.

    Raises
    ------
    RilleError
        The picture cannot be written.
    """
    path = output if output is not None else Path(f"{sequence.name}-check.png")
    check_output(path, ".png", ".pdf", ".svg")
    graph, store = Graph(), Store(cache)
    name(graph, sequence, frames)
    inspection = Inspection(Builder(graph, sequence, config), frames, store)
    graph.flow(inspection.steps())
    # In this process: workers would take longer to start than most of this takes.
    result = run(graph, store, RunOptions(executor="inline", keep_going=True))
    # What a stage refuses is a finding, said by then; any other failure is one of the program.
    Result(failures=[f for f in result.failures if not (f.stage and isinstance(f.error, RilleError))]).check()
    found = inspection.found
    if inspection.match is not None and len(inspection.match.left):
        draw(path, sequence.name, sequence.frame_names[inspection.match.frame], inspection.match)
        print(f"picture       {path}")
    counts = {level: sum(v.level == level for v in found) for level in ("OK", "WARN", "FAIL")}
    print(f"{sequence.name}: {counts['FAIL']} fail, {counts['WARN']} to look at, {counts['OK']} fine")
    return FAILED if counts["FAIL"] else COMPLETE


@dataclass(frozen=True)
class Match:
    """The first whole pair: left image (row, col), thinned matches (n, 2), their residuals (n,) px, and all facts."""

    frame: int
    image: NDArray[Any]
    left: Floats
    right: Floats
    residual: Floats
    weight: Floats
    facts: Mapping[str, Any]
    rate: float | None

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which matches (n,) count: those with a weight, or all where none has one."""
        weighed = self.weight > 0
        return weighed if weighed.any() else np.ones(len(weighed), bool)


@dataclass
class Inspection:
    """A flow that prints each finding as soon as it is known."""

    make: Builder
    frames: tuple[int, ...]
    store: Store
    match: Match | None = None
    found: list[Finding] = field(default_factory=list)
    broken: dict[tuple[int, str], RilleError] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.sequence = self.make.sequence
        self.lost = {f: why for f, why in self.sequence.lost.items() if f in self.frames}
        self.frames = tuple(f for f in self.frames if f not in self.lost)

    def say(self, *findings: Finding | None) -> None:
        """Print what was found."""
        for finding in filter(None, findings):
            print(finding, flush=True)
            self.found.append(finding)

    def steps(self) -> Steps:
        """Look at everything, the cheap things first."""
        s = self.sequence
        self.say(fine("sequence", f"{s.name}, {len(self.frames)} of {s.frames} pairs"))
        for frame, why in self.lost.items():
            text = f"frame {s.frame_names[frame]}: {why}"
            self.say(doubt("RIL-668", text, "images", remedy="it gets no pose; its neighbours are joined across it"))
        self.say(*(Finding("", line, "input", "WARN") for line in s.warnings))  # it begins with its code
        self.say(judge.judge_rig(s.rig))
        self.say(judge.judge_times(None if s.times is None else [s.times[k] for k in self.frames]))
        self.say(judge.judge_truth(s.truth, self.frames, s.truth_positions))
        self.say(judge.judge_attitude(s.attitude, s.truth, self.frames))
        self.say(judge.judge_up(s.up, self.frames))
        yield from self._images()
        whole = [k for k in self.frames if not any((k, camera) in self.broken for camera in CAMERAS)]
        if not whole:
            self.say(fault("RIL-669", "no pair of images is whole", "matching"))
            return
        yield from self._first_pair(whole[0])
        yield from self._motions()
        if len(whole) > 1:
            at = sorted({whole[int(k)] for k in np.linspace(0, len(whole) - 1, MOST_PAIRS).round()})
            rows = yield self.make.synchrony("synchrony", at, whole)
            self.say(judge.judge_synchrony(rows.meta))

    def _images(self) -> Steps:
        """Open every image: sizes, repetitions, exposure, sharpness."""
        looks: dict[str, dict[int, Look]] = {camera: {} for camera in CAMERAS}
        digests: dict[str, dict[int, str]] = {camera: {} for camera in CAMERAS}
        sizes = set()
        images = {(frame, camera): self.make.taken(frame, camera) for frame in self.frames for camera in CAMERAS}
        yield Maybe(list(images.values()))
        for (frame, camera), handle in images.items():
            try:
                if handle.ref is None:
                    raise _cause(handle)
                bundle = self.store.open(handle.ref)
            except RilleError as error:
                self.broken[frame, camera] = error
                continue
            image = np.asarray(bundle["image"])
            sizes.add((image.shape[1], image.shape[0], str(image.dtype)))
            looks[camera][frame] = look(image, np.asarray(bundle["valid"]))
            digests[camera][frame] = hashlib.sha256(image.tobytes()).hexdigest()
        for damage in list(self.broken.values())[:FIRST_NAMED]:
            self.say(fault(damage.code, damage.message, "images", remedy=damage.remedy))
        total = len(self.frames) * len(CAMERAS)
        if self.broken:
            self.say(fault("RIL-670", f"{len(self.broken)} of {total} images cannot be used", "images"))
        else:
            words = " and ".join(f"{w} x {h} {kind}" for w, h, kind in sorted(sizes))
            self.say(fine("images", f"all {total} open, {words}"))
        self.say(*self._repeated(digests))
        self.say(*judge.judge_looks(looks, self.sequence.frame_names))

    def _repeated(self, digests: Mapping[str, Mapping[int, str]]) -> list[Finding]:
        names, out = self.sequence.frame_names, []
        same = [k for k, d in digests["left"].items() if digests["right"].get(k) == d]
        if same:
            text = f"left and right are one image in {len(same)} pairs, first frame {names[same[0]]}"
            out.append(fault("RIL-671", text, "images", remedy="give the right camera's images"))
        for camera, of in digests.items():
            frames = list(of)
            stuck = [b for a, b in pairwise(frames) if of[a] == of[b]]
            if stuck:
                text = f"{len(stuck)} {camera} images repeat the one before, first frame {names[stuck[0]]}"
                out.append(doubt("RIL-672", text, "images", remedy="was a frame copied, or did the camera hang?"))
        return out

    def _first_pair(self, pair: int) -> Steps:
        """Match one pair, and compare it with the rig."""
        tasks = [self.make.image(pair, "left"), self.make.disparity(pair), self.make.orientation(pair)]
        try:
            image, disparity, oriented = yield tasks
            found = self.store.open(oriented)
            points = {name: np.asarray(found[name], dtype=np.float64) for name in ("left", "right")}
            self.match = m = Match(
                pair,
                np.asarray(self.store.open(image)["image"]),
                points["left"],
                points["right"],
                np.asarray(found["residual_before"], dtype=np.float64),
                np.asarray(found["weight"], dtype=np.float64),
                found.meta,
                disparity.meta["match_rate"],
            )
        except (MissingError, RilleError) as missing:
            error = _cause(missing.handles[0]) if isinstance(missing, MissingError) else missing
            text = f"frame {self.sequence.frame_names[pair]}: {error.message}"
            self.say(fault(error.code, text, "matching", remedy=error.remedy))
            return
        rig = self.sequence.rig
        rho, _ = inverse_depth(rig, m.left, m.right - m.left)
        ahead = m.used & (rho > 0)
        self.say(judge.judge_matching(m.rate, 1.0 / rho[ahead], rig.baseline))
        if len(m.left):
            beyond = beyond_infinity(rig, m.left[m.used], m.right[m.used])
            self.say(judge.judge_sides(float((beyond > BEYOND).mean())))
        self.say(judge.judge_epipolar(m.facts))

    def _motions(self) -> Steps:
        """Overlap of some successive left images."""
        pairs = list(pairwise(self.frames))
        # Evenly over the sequence, so that a fault of its second half is found as well.
        chosen = sorted({int(k) for k in np.linspace(0, len(pairs) - 1, MOST_MOTIONS).round()}) if pairs else []
        whole = [pairs[k] for k in chosen if not any((frame, "left") in self.broken for frame in pairs[k])]
        tasks = {(a, b): self.make.motion(a, b) for a, b in whole}
        yield Maybe(list(tasks.values()))
        for error in (_cause(task) for task in tasks.values() if task.ref is None):
            self.say(fault(error.code, error.message, "motion", remedy=error.remedy))
        motions = {step: task.ref.meta for step, task in tasks.items() if task.ref is not None}
        self.say(judge.judge_motion(motions, self.sequence.frame_names))


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

    points, residual = match.left[match.used], match.residual[match.used]
    # Scaled by the bulk, not by the worst match: a few outliers would wash all the others out.
    limit = max(0.5, float(np.percentile(np.abs(residual), 98)))
    shades = {"c": residual, "s": 9, "cmap": "coolwarm", "vmin": -limit, "vmax": limit, "linewidths": 0}
    shown = match.image.astype(np.float32)
    height = min(WIDTH * shown.shape[0] / shown.shape[1], 0.8 * WIDTH)
    fig = Figure(figsize=(WIDTH, height + LOWER), layout="constrained")
    parts: Any = fig.subfigures(2, 1, height_ratios=[height, LOWER])
    top, below = parts
    ax = top.subplots()
    ax.imshow(shown, cmap="gray", vmin=np.percentile(shown, 1), vmax=np.percentile(shown, 99))
    drawn = ax.scatter(*points.T, **shades)
    top.colorbar(drawn, ax=ax, label="px below the line", pad=0.01, aspect=30)
    ax.set_title(f"{name}, frame {frame}: epipolar residuals of the right image under the given rig", fontsize=10)
    ax.set(xlabel="column", ylabel="row")
    plots = below.subplots(1, 3)
    for ax, axis, label in ((plots[0], 0, "column in the left image"), (plots[1], 1, "row in the left image")):
        ax.scatter(points[:, axis], residual, s=3, color="0.3", linewidths=0)
        ax.axhline(0.0, color="tab:red", linewidth=1)
        ax.set(xlabel=label, ylabel="residual, px", ylim=(-1.5 * limit, 1.5 * limit))
    plots[2].hist(residual, bins=60, range=(-1.5 * limit, 1.5 * limit), color="0.5")
    plots[2].set(xlabel="residual, px", ylabel="matches")
    with reported("RIL-016", f"cannot write {path}", remedy="choose another --output"):
        fig.savefig(path, dpi=110)
