"""Ideas of navigation and of the calibration behind it, each left out in turn: what it costs a trajectory.

An idea is left out by parameters, or by a function that is put in the place of another one.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

STAGES = "rille.stages"
KNOCK = ("misalign.rows=3", "misalign.roll_deg=0.3", "misalign.pitch_deg=0.3")


@dataclass(frozen=True)
class Idea:
    """What is left out, in words; as parameters, or as ``function`` in the place of the one that ``name`` names."""

    words: str
    parameters: tuple[str, ...] = ()
    name: str = ""
    function: Any = None

    @contextmanager
    def left_out(self) -> Iterator[tuple[str, ...]]:
        """The parameters to run with, while the function is another one."""
        if self.function is None:
            yield self.parameters
            return
        module, name = self.name.rsplit(".", 1)
        owner = importlib.import_module(f"{STAGES}.{module}")
        whole = getattr(owner, name)
        setattr(owner, name, self.function)
        try:
            yield self.parameters
        finally:
            setattr(owner, name, whole)


def _no_change(origin: Any, moved: Any, use: Any, at: Any) -> Any:
    """Affinities that say nothing on shape: the median displacement."""
    shift = np.median((moved - origin)[use], axis=0) if use.any() else np.zeros(2)
    return np.tile(np.eye(2), (len(at), 1, 1)), np.tile(shift, (len(at), 1))


def _level(points: Any, disparity: Any, unit: float = 1.0) -> Any:
    """Disparities under templates that neither slope nor have relief."""
    return np.zeros((len(points), 2, 2)), np.zeros(len(points))


IDEAS = (
    Idea("as it is"),
    Idea("no joint adjustment", ("resect.joint=false",)),
    Idea("no error that all disparities share", ("resect.bias_sigma=0",)),
    Idea("landmarks taken as exact", ("resect.disparity_sigma=0.001",)),
    Idea("templates on level ground", name="odometry.resection.landmarks.template_planes", function=_level),
    Idea("no affinity of the neighbours", name="odometry.track.fit_affinity", function=_no_change),
    Idea("points aligned one way only", name="odometry.track.MAX_RETURN_PX", function=1e9),
    Idea("no new points in empty parts", name="odometry.track._reseed", function=lambda state, *given: state),
    Idea("no turned frames", ("motion.turn_below=0",)),
    Idea("no random samples", name="odometry.resection.robust_pose._sampled", function=lambda *given: []),
    Idea(
        "second motions not looked for",
        name="odometry.resection.resect.moving_by_themselves",
        function=lambda *given: np.zeros(0, np.intp),
    ),
    Idea("rig as it is given", ("rig.mode=fixed",)),
    Idea("no smooth error beside the rig", name="calibration.parameter_selection.SYSTEMATIC_PX", function=0.001),
    Idea("no principal point beside the angles", ("rig.prior_principal=0.00001",)),
)


def figures(sequence: str, frames: tuple[int, int], assignments: list[str]) -> dict[str, float]:
    """Lost frames, error a frame and drift of one run of preset ``navigation`` on a piece of a sequence."""
    from odometry import chain
    from odometry.measures import judge
    from rille.datasets.registry import open_sequence
    from rille.pipeline.flow import config as configuration

    overrides, _ = configuration.split_dataset(configuration.parse_assignments(assignments))
    opened = open_sequence(sequence, overrides)
    first, last = frames
    images = chain.Images(opened, range(first, min(last, opened.frames)))
    found = chain.Chain(images, chain.settings(opened, assignments)).run()
    return judge(found.poses, chain.truth(images))


def pieces(data: Path, half: str) -> dict[str, tuple[str, tuple[int, int], tuple[str, ...]]]:
    """Name, frames and parameters of each piece: those that settings may be chosen with, or those to judge with."""
    street = str(data / "kitti06_51")
    if half == "chosen":
        return {"street 0-14": (street, (0, 15), ()), "the same, knocked": (street, (0, 15), KNOCK)}
    return {
        "street 20-34": (street, (20, 35), ()),
        "the same, knocked": (street, (20, 35), KNOCK),
        "mockup-short, other rocks": ("mockup-short", (0, 9), ("mockup.seed=5",)),
        "the same, exposure jitter .3": ("mockup-short", (0, 9), ("mockup.seed=5", "mockup.exposure_jitter=0.3")),
    }


def table(data: Path, half: str) -> None:
    """Print a row an idea: of each piece lost frames, error a frame and drift, over those of the first row."""
    chosen = pieces(data, half)
    print("| left out | " + " | ".join(f"{name}: lost, error a frame, drift" for name in chosen) + " |")
    print("|---" * (len(chosen) + 1) + "|")
    whole: dict[str, dict[str, float]] = {}
    for idea in IDEAS:
        cells = []
        with idea.left_out() as parameters:
            for name, (sequence, frames, more) in chosen.items():
                now = figures(sequence, frames, ["keyframes.preset=navigation", *more, *parameters])
                base = whole.setdefault(name, now)
                over = [now[key] / base[key] for key in ("one_frame", "drift")]
                cells.append(f"{now['lost']:.0f}, {over[0]:.3f}, {over[1]:.3f}")
        print(f"| {idea.words} | {' | '.join(cells)} |", flush=True)
