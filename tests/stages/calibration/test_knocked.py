import numpy as np
import pytest

from rille.stages.calibration.knocked import knocked_stage, turned
from rille.stages.core.declare import Bundle, NoParams
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp

LEFT = Camera(700.0, 700.0, 320.0, 240.0, 640, 480)
FINER = Camera(1400.0, 1400.0, 640.0, 480.0, 1280, 960)


@pytest.mark.parametrize(
    ("axis", "centre", "sign"), [(1, [0.3, 0.0, 0.0], 1.0), (0, [0.0, 0.3, 0.0], -1.0)], ids=["beside", "below"]
)
@pytest.mark.parametrize(("right", "finer"), [(LEFT, 1.0), (FINER, 2.0)], ids=["equal", "finer"])
def test_a_knock_is_undone_by_the_jump_of_far_disparities(axis, centre, sign, right, finer):
    def rig(degrees: float) -> Rig:
        rotation = rotation_exp(np.radians([degrees * (axis == 0), degrees * (axis == 1), 0.0]))
        return Rig(LEFT, right, RigidTransform(rotation, -rotation @ np.array(centre)))

    given, knocked = rig(0.05), rig(0.35)
    far = np.array([0.0, 0.0, 1e4])
    seen = [one.right.project(one.T_right_left.apply(far)) for one in (given, knocked)]
    used, angle = turned(given, (seen[1] - seen[0]) / finer)
    assert np.degrees(angle) == pytest.approx(0.3, abs=1e-3)
    np.testing.assert_allclose(used.T_right_left.matrix34, knocked.T_right_left.matrix34, atol=2e-5)

    facts = {"rig": given.to_dict(), "changed": False, "warnings": ["as before"], "source": "given"}
    said = knocked_stage(NoParams(), Bundle({}, facts), jump=[0.0, 1.5][:: 1 if axis == 0 else -1], cause="moved").meta
    assert {name: said[name] for name in ("changed", "knocked", "source")} == {
        "changed": True,
        "knocked": "moved",
        "source": "given",
    }
    expected = sign * np.degrees(1.5 / 700.0)
    assert said["warnings"][0] == "as before"
    assert (
        f"moved: from there on all is computed with the right camera turned by {expected:+.3f}" in said["warnings"][1]
    )
