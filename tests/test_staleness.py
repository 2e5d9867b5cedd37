"""What each parameter and each edit makes stale: every parameter of every stage against a table written by hand.

Nothing is computed: the dry driver lays the whole chain out over a store that has everything, and then tells what it
would compute once a parameter or a source file is another.
"""

from __future__ import annotations

import re
import shutil
import typing
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rille.datasets.images.misalign import MisalignParams
from rille.datasets.mockup.params import SHORT, MockupParams
from rille.datasets.protocol import Positions, Sequence
from rille.datasets.registry import open_sequence
from rille.pipeline.engine import code_digest, provenance, spec
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.manifest import Ref
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow import unread
from rille.pipeline.flow.closed_loop import dataflow
from rille.stages.core.errors import RilleError
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens

ROOT = Path(__file__).resolve().parent.parent
FRAMES = (0, 1, 2, 3, 4)
LATTICE = {"x0": -0.2, "y0": 0.4, "cell": 0.004, "rows": 60, "cols": 80}
IDENTITY = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0]

BASIC = (0, 2, 4)

TOUCHED = (
    [[0, 0, 10, 20, 60, 80]],
    [[0, -1, 30, -70, 60, 70], [0, 0, 30, 0, 60, 10]],
    [[0, -1, 40, -90, 60, 60]],
)
"""World tiles of the three models: the second shares one with the first, the third another one with the second."""

META: dict[str, dict[str, Any]] = {
    "keyframes": {
        "basic": list(BASIC),
        "segments": [[0, 1, 2], [2, 3, 4]],
        "displacement": [1.0] * 4,
        "match_rate": [1.0] * 4,
    },
    "ground_frame": {"T_local_left": IDENTITY},
    "locus": {"lattice": LATTICE},
    "frame_screening": {"asks": {"bridges": [], "sides": []}, "chain": list(FRAMES), "unfit": [], "lost": []},
    "trajectory": {"frames": list(FRAMES), "positions": [[0.0, 0.0, 0.0]] * 5, "pieces": [[0, 4]], "main": 0},
    "crosscheck_join": {
        "frames": list(FRAMES),
        "positions": [[0.0, 0.0, 0.0]] * 5,
        "pieces": [list(FRAMES)],
        "longest": 0,
    },
    "common_tilt": {"undone": False},
    "radiometry": {"steps": {"2": 3}},
}
EACH: dict[str, Callable[[int], dict[str, Any]]] = {
    "tile_index": lambda n: {"pair": BASIC[n], "cell": LATTICE["cell"], "box": LATTICE, "tiles": TOUCHED[n]},
}
"""What the layout of the chain reads of results; of some, of the n-th of a stage, in order of the pairs."""

# -- the table: what must be computed again; a group of tasks is a label without its numbers ------------------------

MERGED = {"merge", "risk/world", "path/world", "dem_accuracy/world", "path_check"}
# each model in the world, the tiles that it touches, and its differences from its neighbours
MODELS = {"locus/world", "tile_index", "overlap_qa", "overlap_audit", "radiometry"}
MISSION = MODELS | MERGED
LOCAL = {"locus/local", "risk/local", "path/local", "dem_accuracy/local"}
REFINED = {"refine", "common_tilt", "trajectory", "agreement", "accuracy", "pose"} | MISSION
POSES = {"resect"} | REFINED
LEVELLED = {"ground_frame"} | LOCAL | POSES
RIG = {"rig", "calibration"} | LEVELLED
MATCHED = {"hfvm", "orientation"} | RIG
MOVED = {"motion", "step_table", "frame_screening", "keyframes", "track"} | POSES
COUNTERCHECK = {"crosscheck", "crosscheck_join", "agreement", "accuracy/crosscheck"}
PYRAMIDS = {"pyramid/left", "pyramid/right"} | MATCHED | MOVED
RISK = {"risk/local", "risk/world", "risk/truth", "path/local", "path/world", "path_check"}

TILES = {f"hfvm/{step}" for step in ("coarse", "left", "right", "band", "check", "refine", "patches", "final")}
TILES |= {"hfvm/fine/left", "hfvm/fine/right"}

STALE: dict[str, set[str]] = {
    "undistort": {"undistort/left", "undistort/right", "image_quality"} | PYRAMIDS | COUNTERCHECK,
    "pyramid": PYRAMIDS,
    "motion": MOVED,
    "frame_screening": {"frame_screening"},  # what follows hangs on its result, not on it
    "keyframes": {"keyframes"},  # what follows hangs on its result, not on it
    "hfvm": MATCHED,
    "orientation": {"orientation"} | RIG,
    "rig": RIG,
    "ground_frame": LEVELLED,
    "locus": LOCAL | MISSION,
    "track": {"track"} | POSES,
    "resect": POSES,
    "refine": REFINED,
    "overlap_audit": {"overlap_audit"},  # nothing is computed from what it says
    "radiometry": {"radiometry"},  # as with select: tiles hang on the steps that it finds
    "merge": MERGED,
    "risk": RISK,
    "path": {"path/local", "path/world", "path_check"},
    "crosscheck": COUNTERCHECK,
    "agreement": {"agreement"},
    "terrain": LOCAL | MISSION,
    "tiling": TILES | MATCHED,  # as far as a plan can tell: that the same comes out is seen once it has
    "vehicle": RISK,
    # of a drive, which this chain is not
    **{
        key: set()
        for key in (
            "occlusion_bounds",
            "drive",
            "map_localization",
            "local_planner",
            "start_area",
            "obstacle_monitor",
            "fault_monitor",
        )
    },
}
EXCEPTIONS: dict[str, set[str]] = {
    "keyframes.preset": {"orientation"} | RIG | MOVED,  # navigation sets parameters of other stages, too
    "rig.mode": {"rig", "calibration"},  # what follows hangs on the rigs' results, which no run had yet
    "locus.both": {"hfvm/back"} | LOCAL | MISSION,  # the other direction is matched as well
    # the other direction, and more points; the matcher's own preset is given here
    "terrain.preset": {"hfvm/back", "track"} | POSES | LOCAL | MISSION,
    "refine.enabled": REFINED - {"refine", "common_tilt"},  # without it there is less to compute
    "resect.landmarks": POSES - {"refine", "common_tilt"},  # refined are landmarks of the disparity alone
    "crosscheck.enabled": set(),  # without it there is less to compute
    "merge.max_hole": {"tile_index"} | MERGED,  # how far beyond its edge a tile depends on what is there
    "tiling.memory": set(),  # small pairs are matched whole with some more or less of it
    "vehicle.name": set(),  # a name changes no risk
}


SOURCES = {"scene", "image/left", "image/right", "truth", "truth_dem/local", "truth_dem/world"}
"""They hang on the sequence alone."""

IMAGES = {"image/left", "image/right", "undistort/left", "undistort/right", "truth_dem/local", "truth_dem/world"}
EVERYTHING = IMAGES | {"image_quality"} | PYRAMIDS | COUNTERCHECK | RISK | {"scene", "truth"}
GIVEN_RIG = {"orientation"} | RIG | COUNTERCHECK
RIGHT_IMAGE = (
    {"image/right", "undistort/right", "pyramid/right", "image_quality", "frame_screening"} | MATCHED | COUNTERCHECK
)

SCENE = ("seed", "bed_width", "bed_length", "cell", "relief", "rocks", "rock_cover", "craters", "grain")
SCENE += ("sun_elevation_deg", "sun_azimuth_deg")
RENDERED = ("sampling", "noise", "exposure", "exposure_jitter")
DRIVE = (
    "frames",
    "baseline",
    "toe_in_deg",
    "pitch_deg",
    "camera_height",
    "forward",
    "sideways",
    "roll_deg",
)
DRIVE += ("roll_swing_deg", "jitter_deg")
CAMERA = ("image_width", "image_height", "focal_length")

SEQUENCE: dict[str, set[str]] = {
    **dict.fromkeys([f"mockup.{name}" for name in SCENE], EVERYTHING - {"truth"}),
    **dict.fromkeys(
        [f"mockup.{name}" for name in RENDERED],
        EVERYTHING - {"truth", "scene", "truth_dem/local", "truth_dem/world", "risk/truth"},
    ),
    **dict.fromkeys([f"mockup.{name}" for name in DRIVE], EVERYTHING - {"scene"}),
    **dict.fromkeys([f"mockup.{name}" for name in CAMERA], EVERYTHING - {"scene", "truth"}),
    "mockup.slope_deg": EVERYTHING,  # the cameras go along with the ground
    "mockup.up_noise_deg": LEVELLED,
    "mockup.attitude_noise_deg": {"motion", "step_table", "frame_screening", "keyframes", "track"} | LEVELLED,
    "mockup.rig_error_deg": GIVEN_RIG,
    **dict.fromkeys([f"misalign.{name}" for name in MisalignParams.model_fields], RIGHT_IMAGE),
}
"""Parameters of a built-in sequence, whose stages are its sources."""


class Everything(Store):
    """Has every artifact that it is asked for while it learns, and later only those."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.known: dict[str, Ref] = {}
        self.labels: dict[str, Ref] = {}
        self.learning = True
        self.asked: Counter[str] = Counter()

    def lookup(self, stage: str, key: str, *, use: bool = True) -> Ref | None:
        if self.learning:
            facts = EACH[stage](self.asked[stage]) if stage in EACH else META.get(stage, {})
            self.asked[stage] += 1
            self.known[key] = Ref(key, stage, digest([stage, key]), facts)
        return self.known.get(key)


class Chain:
    """Plans of one sequence over one store."""

    def __init__(self, sequence: Sequence, root: Path) -> None:
        self.sequence, self.store = sequence, Everything(root)
        graph = self.plan({})
        assert all(h.done for h in graph.nodes)
        self.store.labels = {h.label: h.ref for h in graph.nodes if h.ref is not None}
        self.store.learning = False
        self.leaves = leaves(graph)
        self.groups = {group(label) for label in self.store.labels} - set(self.leaves)

    def plan(self, given: dict[str, Any]) -> Graph:
        graph = Graph()
        config = configuration.build(configuration.expand(self.sequence.defaults), given)
        dataflow(graph, self.sequence, config, FRAMES)
        result = driver.run(graph, self.store, driver.RunOptions(dry=True))
        assert not result.failures
        return graph

    def stale(self, given: dict[str, Any]) -> set[str]:
        """Groups of the table of which something would be computed; a leaf must be where something that it reads is."""
        graph = self.plan(given)
        fates: dict[str, set[str]] = {}
        for h in graph.nodes:
            fates.setdefault(group(h.label), set()).add(h.status)
        found = {name for name, fate in fates.items() if "planned" in fate}
        for leaf, (stage, reads) in self.leaves.items():
            assert leaf in found or not (reads & found or stage in given), leaf
        return found - set(self.leaves)


def leaves(graph: Graph) -> dict[str, tuple[str, set[str]]]:
    """Groups that the table does not name and that nothing reads: their stage and the groups that they read."""
    named = set().union(*STALE.values(), *EXCEPTIONS.values()) | SOURCES
    read = {group(up.label) for handle in graph.nodes for up in handle.upstream()}
    found: dict[str, tuple[str, set[str]]] = {}
    for h in graph.nodes:
        if group(h.label) not in named | read:
            found.setdefault(group(h.label), (h.stage, set()))[1].update(group(up.label) for up in h.upstream())
    return found


def group(label: str) -> str:
    return re.sub(r"[/_-]-?\d+", "", label)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(provenance.Known, "reason", lambda *_: "")
        patch.setattr(provenance.Known, "latest", lambda known, store, stage, label: store.labels.get(label))
        yield Chain(short({}), tmp_path_factory.mktemp("store"))


def test_a_reconstruction_reads_all_sections_but_those_of_a_drive(chain: Chain) -> None:
    config = configuration.build(configuration.expand(chain.sequence.defaults))
    every = [f"{section}.x" for section in type(config).model_fields if section != "terrain"]
    lost = {key.partition(".")[0] for key in unread.unread(every, config, chain.plan({}))}
    assert lost == unread.driven() & set(type(config).model_fields) - {"drive"}
    assert lost >= {"local_planner", "fault_monitor", "obstacle_monitor", "start_area"}


def short(given: dict[str, dict[str, Any]]) -> Sequence:
    """A mockup with distorted images, that can be matched in tiles."""
    mockup = {"frames": len(FRAMES), **given.get("mockup", {})}
    sequence = open_sequence("mockup-short", {**given, "mockup": mockup})
    lens = {c: Lens(getattr(sequence.rig, c), "radtan", (-0.1, 0.01, 0.0, 0.0)) for c in ("left", "right")}
    return replace(sequence, lenses=lens, defaults={**sequence.defaults, "hfvm.preset": "default"})


PARAMETERS = [
    f"{section}.{name}"
    for section, field in configuration.model().model_fields.items()
    for name in field.annotation.model_fields  # type: ignore[union-attr]
]


def candidates(kind: Any, value: Any) -> Iterator[Any]:
    """Other values of a parameter, the nearest first."""
    if typing.get_origin(kind) is typing.Literal:
        yield from (v for v in typing.get_args(kind) if v != value)
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value - 1, value + 2, 1, 2)
    elif isinstance(value, float):
        yield from (value * 1.01, value * 0.99, value + 1e-6, 0.1)
    elif isinstance(value, str):
        yield f"{value}x"
    elif isinstance(value, tuple):
        yield tuple(v * 1.01 for v in value)
        yield tuple(v + 0.1 for v in value)
    elif value is None:
        yield from (0.0123, (0.1, 0.2), (-1.0, 0.5, 1.0, 2.0), (0.1, 0.2, 0.3), 320, 1)


def changes(parameter: str, defaults: Any) -> dict[str, Any]:
    section, name = parameter.split(".")
    kind = configuration.model().model_fields[section].annotation
    assert kind is not None
    now = getattr(getattr(configuration.build(defaults), section), name)
    for value in candidates(kind.model_fields[name].annotation, now):
        given = {section: {name: value}}
        try:
            if getattr(getattr(configuration.build(defaults, given), section), name) != now:
                return given
        except RilleError:
            continue
    raise AssertionError(f"{parameter}: find another value than {now}")


def test_the_table_is_whole(chain: Chain) -> None:
    assert set(STALE) == {p.split(".")[0] for p in PARAMETERS} - {stage for stage, _ in chain.leaves.values()}
    assert set(EXCEPTIONS) <= set(PARAMETERS)
    assert set().union(*STALE.values()) - TILES <= chain.groups
    assert chain.groups - set().union(*STALE.values()) == SOURCES
    assert chain.groups == EVERYTHING
    assert {f"{section}.{name}" for section, kind in KINDS.items() for name in kind.model_fields} == set(SEQUENCE)


def test_the_same_again_is_stale_nowhere(chain: Chain) -> None:
    assert chain.stale({}) == set()


@pytest.mark.parametrize("parameter", PARAMETERS)
def test_a_parameter_makes_stale_exactly(chain: Chain, parameter: str) -> None:
    given = changes(parameter, configuration.expand(chain.sequence.defaults))
    expected = EXCEPTIONS.get(parameter, STALE.get(parameter.split(".")[0], set()))
    assert chain.stale(given) == expected, given


KINDS = {"mockup": MockupParams, "misalign": MisalignParams}


@pytest.mark.parametrize("parameter", SEQUENCE)
def test_a_parameter_of_the_sequence_makes_stale_exactly(chain: Chain, parameter: str) -> None:
    section, name = parameter.split(".")
    field = KINDS[section].model_fields[name]
    now = {**SHORT, "frames": len(FRAMES)}.get(name, field.default) if section == "mockup" else field.default
    for value in candidates(field.annotation, now):
        if value != now:
            with suppress(RilleError):
                chain.sequence, before = short({section: {name: value}}), chain.sequence
                break
    else:
        raise AssertionError(f"{parameter}: find another value than {now}")
    try:
        assert chain.stale({}) == SEQUENCE[parameter], value
    finally:
        chain.sequence = before


# -- truth: it judges, and nothing is estimated from it ----------------------------------------------------------------

TRUE = {"truth", "truth_dem/local", "truth_dem/world"}
JUDGES = {"accuracy", "accuracy/crosscheck", "dem_accuracy/local", "dem_accuracy/world", "risk/truth", "path_check"}
ESTIMATES_BY = {"scene", "image/left", "image/right"}
"""The pictures were taken from true poses; all that is estimated is estimated from them."""


def with_sequence(chain: Chain, sequence: Sequence) -> Graph:
    chain.sequence, before = sequence, chain.sequence
    try:
        return chain.plan({})
    finally:
        chain.sequence = before


def behind(handle: Handle) -> set[str]:
    """Groups of all tasks that a task hangs on."""
    found, ahead = set[int](), [handle]
    groups = set()
    while ahead:
        for h in ahead.pop().upstream():
            if h.index not in found:
                found.add(h.index)
                groups.add(group(h.label))
                ahead.append(h)
    return groups


def numbers(value: Any) -> Iterator[float]:
    """All floats in arguments, however nested."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, float):
        yield value


def test_no_estimate_has_a_path_to_the_truth(chain: Chain) -> None:
    for h in chain.plan({}).nodes:
        if group(h.label) not in JUDGES | TRUE:
            assert not behind(h) & (JUDGES | TRUE), h.label
    assert {group(h.label) for h in chain.plan({}).nodes if behind(h) & TRUE} == JUDGES


def test_another_truth_changes_what_judges_and_no_estimate(chain: Chain) -> None:
    assert chain.sequence.truth is not None
    shift = RigidTransform(rotation_exp([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.3]))
    moved = tuple(None if T is None else T @ shift for T in chain.sequence.truth)
    graph = with_sequence(chain, replace(chain.sequence, truth=moved))
    assert {group(h.label) for h in graph.nodes if h.status == "planned"} == JUDGES | TRUE
    without = with_sequence(chain, replace(chain.sequence, truth=None, truth_dem=None, truth_disparity=None))
    assert {h.status for h in without.nodes} == {"cached"}
    assert {group(h.label) for h in without.nodes} - set(chain.leaves) == chain.groups - JUDGES - TRUE


def test_true_positions_are_read_by_one_leaf(chain: Chain) -> None:
    none = replace(chain.sequence, truth=None, truth_dem=None, truth_disparity=None)
    places = Positions(tuple((1.0 * k, 2.0) for k in range(none.frames)))
    graph = with_sequence(chain, replace(none, truth_positions=places))
    assert {group(h.label) for h in graph.nodes if h.status == "planned"} == {"position_accuracy"}
    assert not [h.label for h in graph.nodes if "position_accuracy" in behind(h)]


def test_no_estimate_is_told_a_true_pose(chain: Chain) -> None:
    """No argument of an estimate is a number of a true pose, or of a true motion from frame to frame."""

    def told(**mockup: Any) -> set[str]:
        # Shaken, so that no number of a pose is one of the mounting, which is given.
        sequence = short({"mockup": {"jitter_deg": 1.0, **mockup}})
        poses = [T for T in sequence.truth or () if T is not None]
        pairs = [a.inverse() @ b for a in poses for b in poses if a is not b]
        known = np.array([T.matrix34 for T in (*poses, *pairs)]).ravel()
        true = np.sort(known[np.abs(known) > 1e-6])
        found = set()
        for h in with_sequence(chain, sequence).nodes:
            given = np.array(list(numbers(h.spec.args)))
            at = np.searchsorted(true, given)
            near = [np.abs(true[np.clip(at - k, 0, len(true) - 1)] - given) for k in (0, 1)]
            if group(h.label) not in JUDGES | TRUE | ESTIMATES_BY and (np.min(near, axis=0) < 1e-9).any():
                found.add(group(h.label))
        return found

    assert told() == set()
    assert told(up_noise_deg=0.0) == {"ground_frame"}, "an exact vertical is found out"
    assert told(attitude_noise_deg=0.0) == {"ground_frame", "motion"}


# -- edits of the sources: a module counts with all that it reaches ---------------------------------------------------

WORDS = "\n# only words\n"

EDITS: dict[str, tuple[str, str, str, set[str]]] = {
    "a comment, in what all reach": ("stages/geometry/geometry.py", "", WORDS, set()),
    "a docstring, in what all reach": (
        "stages/core/declare.py",
        '"""Input or result of a stage',
        '"""Input or result of any stage',
        set(),
    ),
    "a docstring of a kernel": ("stages/hfvm/level/search.py", '"""', '"""Said otherwise. ', set()),
    "the engine": ("pipeline/engine/run.py", "MAX_HEALS = 3", "MAX_HEALS = 4", set()),
    "the report": ("pipeline/report/words.py", "", "\nMORE = 1\n", set()),
    "a stage itself": ("stages/terrain/merge.py", "", "\nMORE = 1\n", {"merge"}),
    "a helper of one stage": ("stages/planning/path_words.py", "", "\nMORE = 1\n", {"path/local", "path/world"}),
    "a njit callee of one stage": (
        "stages/terrain/locus/kernel.py",
        "",
        "\nMORE = 1\n",
        {"locus/local", "locus/world"},
    ),
    "a njit callee of several": ("stages/hfvm/level/features.py", "", "\nMORE = 1\n", {"motion", "hfvm", "track"}),
    "a helper of the seams": ("stages/terrain/overlap_qa.py", "", "\nMORE = 1\n", {"overlap_qa"}),
    "a stage that others hang on by its result": ("stages/terrain/tile_index.py", "", "\nMORE = 1\n", {"tile_index"}),
    "a helper's helper": ("stages/geometry/epipolar.py", "", "\nMORE = 1\n", {"orientation", "rig"}),
    "a helper of three stages": (
        "stages/evaluation/pose_alignment.py",
        "",
        "\nMORE = 1\n",
        {"accuracy", "agreement", "crosscheck_join"},
    ),
}
"""File, what in it becomes what (at its end, if nothing), and the groups whose *own* code it is part of."""


@pytest.fixture
def edited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """``edited(file, old, new)``: the sources as a new process would find them after that edit."""
    for package in ("stages", "datasets", "pipeline"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    caches = (code_digest._read, code_digest._file, code_digest._reachable, spec._shared)

    def edit(file: str, old: str, new: str) -> None:
        path = tmp_path / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1) if old else text + new)
        monkeypatch.setattr(code_digest, "_roots", lambda package: (tmp_path / package.removeprefix("rille."),))
        for cached in caches:
            cached.cache_clear()

    yield edit
    monkeypatch.undo()
    for cached in caches:
        cached.cache_clear()


def downstream(chain: Chain, own: set[str]) -> set[str]:
    """Groups that are fed by a task of one of these, themselves included."""
    found = set()
    for h in chain.plan({}).nodes:
        if group(h.label) in own or any(group(up.label) in found for up in h.upstream()):
            found.add(group(h.label))
    return found - set(chain.leaves)


@pytest.mark.parametrize("what", EDITS)
def test_an_edit_makes_stale_exactly_what_depends_on_it(chain: Chain, edited: Any, what: str) -> None:
    file, old, new, own = EDITS[what]
    expected = downstream(chain, {g for g in chain.groups if g in own or g.split("/")[0] in own})
    edited(file, old, new)
    assert chain.stale({}) == expected
