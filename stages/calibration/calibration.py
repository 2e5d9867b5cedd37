"""The rig that all later stages compute with, without the other facts of stage ``rig``.

Stage ``rig`` also states how certain the rig is and what each pair contributed; these facts change with every pair that
is added. Later stages read the rig alone, so their results stay cached as long as the rig itself is the same to the
bit.
"""

from __future__ import annotations

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import CalibrationFacts, RigFacts
from rille.stages.geometry.geometry import Rig


@stage("calibration")
def calibration_stage(params: NoParams, rig: Bundle[RigFacts]) -> Bundle[CalibrationFacts]:
    """The rig that is computed with."""
    used = Rig.from_dict(rig.meta["rig"])
    return Bundle({}, {"rig": used.to_dict(), "baseline": used.baseline, "changed": rig.meta["changed"]})
