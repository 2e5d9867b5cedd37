"""One rig from the matches of several runs."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from raising import raises
from rig_scenes import bed_depth, bed_rig, knocked, matches

from rille.pipeline.commands.results.rig import _table, _toml, rig
from rille.stages.calibration.joint_rig import disagreements, joint
from rille.stages.calibration.rig import RigParams
from rille.stages.geometry.epipolar import NAMES

TURNED = {"pitch_deg": 0.3, "roll_deg": 0.4}
PITCH, ROLL = NAMES.index("pitch"), NAMES.index("roll")


def run(seed, count=3, noise=0.2, **knock):
    true = knocked(bed_rig(), **knock)
    return [matches(true, bed_depth, pair=k, noise=noise, seed=10 * seed + k, samples=600) for k in range(count)]


def test_a_run_of_less_certain_matches_counts_less():
    params = RigParams()
    found = joint(bed_rig(), {"a": run(1, **TURNED), "b": run(2, count=1, noise=0.6, **TURNED)}, params)
    values = np.array([parameter.value for parameter in found.parameters])
    np.testing.assert_allclose(np.degrees(values[[PITCH, ROLL]]), [0.3, 0.4], atol=0.02)
    a, b = found.estimates
    assert b.sigma[PITCH] > a.sigma[PITCH]
    assert abs(values[PITCH] - a.values[PITCH]) < abs(values[PITCH] - b.values[PITCH])
    assert list(disagreements(found, params.significance)) == []
    assert found.rig.baseline == pytest.approx(bed_rig().baseline, abs=1e-12)


def test_a_calibration_that_nothing_contradicts_stays_to_the_bit():
    found = joint(bed_rig(), {"a": run(1), "b": run(2)}, RigParams())
    assert found.rig.to_dict() == bed_rig().to_dict()


def test_a_rig_that_moved_between_runs_is_said():
    other = TURNED | {"pitch_deg": 0.6}
    found = joint(bed_rig(), {"a": run(1, **TURNED), "b": run(2, **TURNED), "c": run(3, **other)}, RigParams())
    lines = list(disagreements(found, RigParams().significance))
    assert any("pitch of run c" in line for line in lines)
    assert len(list(_table(found))) == 1 + len(NAMES)
    assert tomllib.loads(_toml(found))["rig"] == found.rig.to_dict()


def test_a_manifest_is_not_overwritten_by_a_rig(tmp_path):
    (tmp_path / "rover.toml").write_text('[images]\nleft = "left/*.png"\n')
    with raises("RIL-038"):
        rig("latest", output=tmp_path / "rover.toml")


def test_a_run_without_matches_is_refused():
    with raises("RIL-030", "run b"):
        joint(bed_rig(), {"a": run(1), "b": []}, RigParams())
