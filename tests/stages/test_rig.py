from __future__ import annotations

import pytest
from terrain_scenes import toed_in_rig

from stages import rig as rig_stage
from stages.declare import NoParams
from stages.errors import InputError
from stages.geometry import Rig, RigidTransform


def test_given_rig_passes_through() -> None:
    rig = toed_in_rig()
    meta = rig_stage.STAGE.run(NoParams(), {"rig": rig.to_dict()}, {}).meta
    assert Rig.from_dict(meta["rig"]).to_dict() == rig.to_dict()
    assert meta["mode"] == "fixed"
    assert meta["baseline"] == pytest.approx((0.1**2 + 0.004**2 + 0.003**2) ** 0.5)


def test_no_baseline_is_refused() -> None:
    rig = toed_in_rig()
    with pytest.raises(InputError, match="baseline"):
        rig_stage.fixed(Rig(rig.left, rig.right, RigidTransform.identity()))
