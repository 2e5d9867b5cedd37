"""The flow of ``rille check``: open everything of a sequence, match its first pair, and print each finding.

Images, disparity and motions are tasks of a reconstruction with the same parameters, by the same builder, and so cached
for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from rille.datasets.images.files import sound
from rille.datasets.protocol import CAMERAS
from rille.pipeline.engine.graph import Handle, Maybe, MissingError, Wait
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow.builders import Builder
from rille.pipeline.flow.reconstruction import vertical
from rille.pipeline.flow.selection import spread
from rille.pipeline.runs.checks import looks, matches, records
from rille.pipeline.runs.checks.limits import Finding, judge
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import RilleError
from rille.stages.geometry.epipolar import beyond_infinity, inverse_depth
from rille.stages.odometry.frame_screening import unlike_sides

Steps = Generator[Wait, Any, None]


class CheckFlow:
    """A flow that prints each finding as soon as it is known."""

    def __init__(self, make: Builder, frames: tuple[int, ...], store: Store) -> None:
        self.make, self.store, self.sequence = make, store, make.sequence
        self.lost = {f: why for f, why in self.sequence.lost.items() if f in frames}
        self.frames = tuple(f for f in frames if f not in self.lost)
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
        """Check everything, the cheap things first."""
        s = self.sequence
        self.say(judge("sequence", f"{s.name}, {len(self.frames)} of {s.frames} pairs"))
        for frame, why in self.lost.items():
            figure = "lost" if why.endswith("missing") else "unusable"
            self.say(judge("images", f"frame {s.frame_names[frame]}: {why}", {figure: 1}))
        self.say(*(Finding("", line, "input", "WARN") for line in s.warnings))  # it begins with its code
        self.say(*(Finding("", line, "input") for line in s.notes))
        self.say(records.judge_rig(s.rig))
        self.say(*(of(s, self.frames) for of in records.RECORDS))
        yield from self._images()
        broken = {frame for frame, _ in self.broken}
        whole = [k for k in self.frames if k not in broken]
        if not whole:
            self.say(judge("matching", "no pair of images is whole", {"whole pairs": 0}))
            return
        pair, exchanged = yield from self._sides(whole)
        yield from self._first_pair(pair, exchanged)
        yield from self._motions()
        if len(whole) > 1:
            yield from self._times(whole)

    def _images(self) -> Steps:
        """Open every image, and map of another program; find repetitions, and judge exposure and sharpness."""
        images = {(frame, camera): self.make.raw_image(frame, camera) for frame in self.frames for camera in CAMERAS}
        maps = {(k, "map"): given for k in self.frames if (given := self.make.given_disparity(k)) is not None}
        seen = {frame: self.make.quality(frame) for frame in self.frames}
        yield Maybe([*images.values(), *maps.values(), *seen.values()])
        self._open(images | maps, "images and maps" if maps else "images")
        known: dict[int, Any] = {k: one.ref.meta for k, one in seen.items() if one.ref is not None}
        shown = {c: {k: of[c] for k, of in known.items() if (k, c) not in self.broken} for c in CAMERAS}
        uniform = self.make.config.frame_screening.uniform
        self.broken |= {(k, camera) for camera, of in shown.items() for k in of if of[k]["deviation"] < uniform}
        # As the cameras took them: one image is two when the lenses of two cameras are taken out of it. Images of one
        # grey value do not count as repeated.
        several = {c: {k: self._pixels(images[k, c]) for k in of if of[k]["deviation"]} for c, of in shown.items()}
        self.say(*looks.judge_repeated(several, self.sequence.frame_names))
        self.say(*looks.judge_looks(shown, self.sequence.frame_names, self.make.config.frame_screening))

    def _open(self, opened: Mapping[tuple[int, str], Handle], kinds: str) -> None:
        """Say which files, of ``kinds`` in words, cannot be used, and note them as broken."""
        errors = list[RilleError]()
        for at, handle in opened.items():
            try:
                if handle.ref is None:
                    raise _cause(handle)
                sound(Bundle({}, handle.ref.meta), handle.spec.hints.get("path", ""))
            except RilleError as error:
                errors.append(error)
                self.broken.add(at)
        # More are only counted.
        for refusal in errors[:3]:
            self.refused(refusal, "images")
        text = f"{len(errors)} of {len(opened)} {kinds} cannot be used" if errors else f"all {len(opened)} open"
        self.say(judge("images", text, {"unusable": len(errors)}))

    def _pixels(self, image: Handle) -> str:
        """Digest of the pixels of an image."""
        return str(self.store.read_manifest(image.stage, image.key)["arrays"]["image"]["sha256"])

    def _sides(self, whole: list[int]) -> Generator[Wait, Any, tuple[int, bool]]:
        """Whether left and right of some pairs fit each other: the first pair that does; whether most are exchanged."""
        # With neighbours, since a recorder may exchange the sides of every other pair.
        chosen = sorted({pair for step in spread(list(pairwise(whole)), 3) for pair in step}) or whole
        tests = {pair: self.make.swap_check(pair) for pair in chosen}
        yield Maybe(list(tests.values()))
        facts = {pair: task.ref.meta for pair, task in tests.items() if task.ref is not None}
        unlike = unlike_sides(facts)
        swapped = sum(one["swapped"] for one in facts.values())
        self.say(matches.judge_pairs(unlike, len(facts), swapped, self.sequence.frame_names))
        return next((pair for pair in tests if pair not in unlike), whole[0]), 2 * swapped > len(facts)

    def _first_pair(self, pair: int, exchanged: bool) -> Steps:
        """Match one pair, and compare it with the rig, which images of ``exchanged`` sides cannot fit."""
        try:
            disparity, oriented = yield [self.make.disparity(pair), self.make.orientation(pair)]
            arrays = {k: np.asarray(v, np.float64) for k, v in self.store.open(oriented).arrays.items()}
        except (MissingError, RilleError) as missing:
            error = _cause(missing.handles[0]) if isinstance(missing, MissingError) else missing
            self.refused(error, "matching", f"frame {self.sequence.frame_names[pair]}: ")
            return
        used = arrays["weight"] > 0
        used = used if used.any() else np.ones(len(used), bool)
        left, right = arrays["left"][used], arrays["right"][used]
        rig = self.sequence.rig
        rho, _ = inverse_depth(rig, left, right - left)
        given, rate = self.sequence.disparity is not None, disparity.meta["match_rate"]
        self.say(matches.judge_matching(rate, 1.0 / rho[rho > 0], rig.baseline, given=given))
        self.say(None if exchanged else matches.judge_epipolar(oriented.meta))
        self.say(matches.judge_repetition(oriented.meta["repeated"]))
        fitted, known = self.make.rig([pair])
        level = self.make.level(pair, vertical(self.make, pair), known)
        yield Maybe([level])
        if not exchanged and fitted.ref is None:  # as when matches lie beyond infinity
            self.refused(_cause(fitted), "rig")
        elif not exchanged and len(left):
            beyond = beyond_infinity(rig, left, right) > 1.0  # px, which noise makes
            self.say(matches.judge_sides(float(beyond.mean())))
        if fitted.ref is not None and "misread" in fitted.ref.meta:
            self.say(judge("distortion", fitted.ref.meta["misread"], {"misread": 1}))
        self.say(*([matches.judge_ground(level.ref.meta)] if level.ref else []))

    def _times(self, whole: list[int]) -> Steps:
        """Whether left and right images are simultaneous; if not, from which pair on."""
        chosen, between = list[int](), whole
        while between:
            chosen = sorted({*chosen, *spread(between, 6)})
            rows = yield self.make.synchrony(f"synchrony/{len(chosen)}", chosen, whole)
            first = next((pair for pair, _ in rows.meta["partners"]), chosen[0])
            last = max((pair for pair in chosen if pair < first), default=first)
            between = [k for k in whole if last < k < first]
        self.say(matches.judge_synchrony(rows.meta))

    def _motions(self) -> Steps:
        """Overlap of some successive left images."""
        # All over the sequence, because a fault may lie in its second half.
        chosen = spread(list(pairwise(self.frames)), 12)
        tasks = {(a, b): self.make.motion(a, b) for a, b in chosen if not {(a, "left"), (b, "left")} & self.broken}
        yield Maybe(list(tasks.values()))
        for task in tasks.values():
            if task.ref is None:
                self.refused(_cause(task), "motion")
        motions = {step: task.ref.meta for step, task in tasks.items() if task.ref is not None}
        self.say(matches.judge_motion(motions, self.sequence.frame_names))


def _cause(handle: Handle) -> RilleError:
    """The error by which a task has no artifact.

    Raises
    ------
    Exception
        It is a fault of the program.
    """
    while handle.error is None:
        handle = next(upstream for upstream in handle.upstream() if not upstream.done)
    if not isinstance(handle.error, RilleError):
        raise handle.error
    return handle.error
