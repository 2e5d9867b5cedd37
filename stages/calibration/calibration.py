"""The rig that all later stages use, without the other facts of stage ``rig``.

These facts, such as the uncertainty of the rig and the values of each pair, change with every added pair. Later stages
read the rig alone, so that their results stay cached as long as no bit of the rig changes.
"""

from __future__ import annotations

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import CalibrationFacts, RigFacts


@stage("calibration")
def calibration_stage(params: NoParams, rig: Bundle[RigFacts]) -> Bundle[CalibrationFacts]:
    """The rig that is computed with."""
    return Bundle({}, {"rig": rig.meta["rig"], "changed": rig.meta["changed"]})
