"""Truth judges, and nothing is estimated from it: neither by an input nor by an argument."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dry_chain import Chain, group, laid_out, short, stale

from rille.datasets.protocol import Positions
from rille.pipeline.engine.graph import Handle
from rille.stages.geometry.geometry import RigidTransform, rotation_exp

OF_DISPARITY = {"truth_disparity", "disparity_accuracy"}
"""These hang on no pose."""

TRUE = {"truth_dem/local", "truth_dem/world", "truth_disparity"}
JUDGES = {"accuracy", "accuracy/crosscheck", "dem_accuracy/local", "dem_accuracy/world", "risk/truth", "path_check"}
JUDGES |= {"disparity_accuracy"}
PICTURES = {"scene", "image/left", "image/right"}
"""They were taken from true poses; all that is estimated is estimated from them."""


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with laid_out(tmp_path_factory.mktemp("store")) as chain:
        yield chain


def behind(handle: Handle) -> set[str]:
    """Groups of all tasks that a task hangs on."""
    ahead, labels = [handle], set[str]()
    while ahead:
        new = [up for up in ahead.pop().upstream() if up.label not in labels]
        labels |= {up.label for up in new}
        ahead += new
    return {group(label) for label in labels}


def test_no_estimate_has_a_path_to_the_truth(chain: Chain) -> None:
    reads = {group(h.label) for h in chain.base.nodes if behind(h) & (JUDGES | TRUE)}
    # True poses are arguments of what judges trajectories.
    assert {name for name in reads if not name.startswith("out")} == JUDGES - {"accuracy", "accuracy/crosscheck"}


def test_another_truth_changes_what_judges_and_no_estimate(chain: Chain) -> None:
    assert chain.sequence.truth is not None
    shift = RigidTransform(rotation_exp([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.3]))
    moved = tuple(None if T is None else T @ shift for T in chain.sequence.truth)
    graph = chain.plan({}, replace(chain.sequence, truth=moved))
    assert {group(label) for label in stale(graph)} == (JUDGES | TRUE) - OF_DISPARITY
    without = chain.plan({}, replace(chain.sequence, truth=None, truth_dem=None, truth_disparity=None))
    assert stale(without) == set()
    lost = {group(h.label) for h in chain.base.nodes} - {group(h.label) for h in without.nodes}
    assert lost == JUDGES | TRUE


def test_true_positions_are_read_by_one_leaf(chain: Chain) -> None:
    without = replace(chain.sequence, truth=None, truth_dem=None, truth_disparity=None)
    places = Positions(tuple((1.0 * k, 2.0) for k in range(without.frames)))
    graph = chain.plan({}, replace(without, truth_positions=places))
    assert stale(graph) == {"position_accuracy"}
    assert not [h.label for h in graph.nodes if "position_accuracy" in behind(h)]


def numbers(value: Any) -> Iterator[float]:
    """All floats in arguments, however nested."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, float):
        yield value


@pytest.mark.parametrize(
    ("exact", "readers"),
    [({}, set()), ({"up_noise_deg": 0.0}, {"ground_frame"}), ({"attitude_noise_deg": 0.0}, {"ground_frame"})],
    ids=["as always", "an exact vertical shows", "an exact attitude shows"],
)
def test_no_argument_of_an_estimate_is_of_a_true_pose_or_motion(
    chain: Chain, exact: dict[str, float], readers: set[str]
) -> None:
    # Shaken, so that no number of a pose is one of the mounting, which is given.
    sequence = short({"mockup": {"jitter_deg": 1.0, **exact}})
    poses = [T for T in sequence.truth or () if T is not None]
    pairs = [a.inverse() @ b for a in poses for b in poses if a is not b]
    known = np.array([T.matrix34 for T in (*poses, *pairs)]).ravel()
    true = known[np.abs(known) > 1e-6]
    arguments = {h.label: np.array(list(numbers(h.spec.args))) for h in chain.plan({}, sequence).nodes}
    told = {
        group(label)
        for label, given in arguments.items()
        if (np.abs(given[:, None] - true) < 1e-9).any() and group(label) not in JUDGES | TRUE | PICTURES
    }
    assert told == readers
