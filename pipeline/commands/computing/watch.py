"""``rille watch``: reconstruct a sequence repeatedly, with the cache, while its images arrive."""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from rille.datasets.images.arrivals import SETTLE_SECONDS, Arrivals
from rille.datasets.images.files import image_stage
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.datasets.registry import open_sequence
from rille.datasets.text.names import shell_word
from rille.pipeline.commands.complaints import complain
from rille.pipeline.engine.plain import warned
from rille.pipeline.engine.workers import Workers
from rille.pipeline.flow import config as configuration
from rille.pipeline.runs import session
from rille.pipeline.runs.options import HOLES, INTERRUPTED, WatchOptions, cache_folder
from rille.stages.core.errors import ConfigError, IncompleteError, InputError, RilleError
from rille.stages.core.quantities import some

UPDATED = ("trajectory.tum", "trajectory.kitti", "dem.tif", "dem_sigma.tif", "risk.tif", "path.gpkg")
"""Files of each update; all others, COLMAP's trajectory and the figures follow at the end."""


def watch(seq: str, *, options: WatchOptions = WatchOptions()) -> int:
    """Reconstruct a sequence while its images arrive: trajectory, terrain, risk and path grow with it.

    The end is a whole run of all that has arrived, with the results of `rille reconstruct`, to the bit.

    Parameters
    ----------
    seq
        A folder or a manifest of image files. A file is taken once it is whole.
    """
    # A wrong parameter should not wait for the first pair.
    of_sequence, of_stages = session.configured(options)
    configuration.build(of_stages)
    if of_sequence:
        text = f"{next(iter(of_sequence))}: a sequence that is watched has no parameters"
        raise ConfigError("RIL-088", text, remedy="leave it out; `rille reconstruct` takes it")
    kept, arrivals = list[Workers](), Arrivals(cache_folder(options.cache) / "files.json")
    watched = _Watched(seq, options, kept, arrivals)
    try:
        return watched.to_the_end()
    except KeyboardInterrupt:
        last = f"the last result is {watched.folder}" if watched.folder else "there is no result yet"
        print(f"rille: interrupted; {last}; `rille reconstruct {shell_word(seq)}` computes the rest", file=sys.stderr)
        return INTERRUPTED
    finally:
        for workers in kept:
            workers.close()


class _Seen(NamedTuple):
    """A sequence as it has arrived; ``frames``: number of usable frames; ``files``: digests of their images."""

    sequence: Sequence
    frames: int
    files: dict[Path, str]


@dataclass
class _Watched:
    """State of a watch: the sequence as seen and as reconstructed, and ``folder`` of the last results.

    Attributes
    ----------
    said : lines that were printed on stderr, because every update has the same warnings.
    gaps : time, by the monotonic clock, when a frame between others was first missing, by its name.
    """

    seq: str
    options: WatchOptions
    kept: list[Workers]
    arrivals: Arrivals
    folder: Path | None = None
    taken: _Seen | None = None
    said: set[str] = field(default_factory=set)
    gaps: dict[str, float] = field(default_factory=dict)

    def to_the_end(self) -> int:
        """Update until the end of the watch, then reconstruct everything; return the exit code."""
        while True:
            begin = time.monotonic()
            seen, took = self.look(), time.monotonic() - begin
            if seen is not None and self.is_more(seen):
                self.update(seen)
            elif self.is_over(seen):
                return self.finish()
            else:
                time.sleep(max(0.25, 5 * took))  # looking takes at most a sixth of the time

    def look(self) -> _Seen | None:
        """Open the sequence as far as it has arrived; None if that is not enough to open it.

        Raises
        ------
        InputError
            It cannot be opened, whatever may still arrive.
        ConfigError
            Its images are no files.
        """
        try:
            sequence = open_sequence(self.seq, digests=self.arrivals)
        except InputError as error:
            if self.taken is None and not isinstance(error, IncompleteError):
                raise
            # While files change it is unknown whether one is missing.
            if time.monotonic() - self.arrivals.changed > SETTLE_SECONDS:
                self.say(f"rille: waiting: {error.message}")
            return None
        now = time.monotonic()
        names = {sequence.frame_names[k]: k for k in sequence.lost}
        self.gaps = {name: self.gaps.get(name, now) for name in names}
        # 10.0 seconds: time to wait for a missing pair between others, which then counts as lost until it arrives.
        frames = min((names[n] for n, t in self.gaps.items() if now - t < 10.0), default=sequence.frames)
        if frames < sequence.frames:
            self.say(f"rille: waiting: {sequence.lost[frames]}")
        images = [_image(sequence.image(k, c)) for k in range(frames) if k not in sequence.lost for c in CAMERAS]
        return _Seen(sequence, frames, {Path(image.hints["path"]): image.args["sha256"] for image in images})

    def is_more(self, seen: _Seen) -> bool:
        """Whether there is something new, and nothing less than before, as while files are written anew."""
        before = self.taken
        return bool(seen.files) and (before is None or (seen.frames >= before.frames and seen.files != before.files))

    def is_over(self, seen: _Seen | None) -> bool:
        """Whether the watch has ended."""
        idle, count = self.options.until_idle, self.options.count
        enough = count is not None and seen is not None and len(seen.files) >= 2 * count
        return enough or (idle is not None and time.monotonic() - self.arrivals.changed >= idle)

    def update(self, seen: _Seen) -> None:
        """Reconstruct the usable frames; after an error, which is printed, the watch goes on."""
        before, self.taken = {} if self.taken is None else self.taken.files, seen
        replaced = [path.name for path, digest in seen.files.items() if before.get(path, digest) != digest]
        if replaced:
            self.say(f"rille: written anew, so that what depends on it is computed anew: {some(replaced, 6)}")
        part = not (self.options.until or self.options.only)
        options = replace(self.options, quiet=True, only=UPDATED if part else self.options.only)
        try:
            result = self.run(options, seen)
        except ConfigError:
            raise
        except RilleError as error:
            complain(error)
            return
        for line in result.complaints:
            self.say(line)
        since = time.monotonic() - max(self.arrivals.first_seen(path) for path in seen.files)
        print(f"{len(seen.files) // 2} pairs, {since:.1f} s after the last file: {result.lines[0]}", flush=True)

    def finish(self) -> int:
        """Reconstruct all that has arrived, as ``rille reconstruct`` does; return the exit code."""
        left_out = []
        self.arrivals.growing = False
        try:
            sequence = open_sequence(self.seq, digests=self.arrivals)
        except InputError as error:
            if self.taken is None:
                raise
            # Not all has arrived: a run would refuse images without a partner, or a table with more rows.
            self.arrivals.growing = True
            sequence = open_sequence(self.seq, digests=self.arrivals)
            left_out = [error.message]
        result = self.run(self.options, _Seen(sequence, sequence.frames, {}))
        result.print()
        left_out += self.arrivals.troubles()
        if left_out:
            self.say(f"rille: not all has arrived: {'; '.join(left_out)}")
        return HOLES if left_out else result.code

    def run(self, options: WatchOptions, seen: _Seen) -> session.RunResult:
        """Run, and replace the folder of the run before."""
        options = replace(options, frames=None if seen.frames == seen.sequence.frames else f"0:{seen.frames}")
        result = session.perform(seen.sequence, options, kept=self.kept, warn=lambda line: self.say(warned(line)))
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
        self.folder = result.folder
        return result

    def say(self, line: str) -> None:
        """Print a line on stderr, unless it was printed before."""
        if line not in self.said:
            self.said.add(line)
            print(line, file=sys.stderr)


def _image(source: Source) -> Source:
    """The source of the image file behind a source.

    Raises
    ------
    ConfigError
        There is none.
    """
    while "image" in source.inputs:
        source = source.inputs["image"]
    if source.module != image_stage.module:
        remedy = "give a folder or a manifest of image files"
        raise ConfigError("RIL-087", "the images of this sequence do not arrive as files", remedy=remedy)
    return source
