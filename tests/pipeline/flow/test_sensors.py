"""Other sensors enter the trajectory by one task, and only where they say how good they are."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
from dry_chain import FRAMES, Chain, laid_out

from rille.stages.geometry.geometry import RigidTransform


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with laid_out(tmp_path_factory.mktemp("store")) as chain:
        yield chain


def test_odometry_alone_predicts_and_with_its_errors_it_adjusts(chain: Chain) -> None:
    count = chain.sequence.frames
    predicting = replace(chain.sequence, odometry=(RigidTransform.identity(),) * count)
    assert "adjust" not in {h.stage for h in chain.plan({}, predicting).nodes}
    measuring = replace(predicting, priors={"odometry": {"drift": 0.02, "turn": 0.01}, "up": {"sigma": 0.01}})
    nodes = {h.label: h for h in chain.plan({}, replace(measuring, up=None)).nodes}
    known = nodes["trajectory/adjusted"].spec.args["priors"]
    assert len(known["odometry"]["poses"]) == len(known["times"]) == len(FRAMES)
    assert "up" not in known
    assert {up.label for up in nodes["trajectory/adjusted"].upstream()} >= {"trajectory", "resect/0"}
    # What stands on poses stands on the adjusted ones.
    assert "trajectory/adjusted" in {up.label for up in nodes["agreement"].upstream()}
