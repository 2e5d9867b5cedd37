"""The rig that all later stages compute with, and nothing else of what stage ``rig`` has to say.

Stage ``rig`` also tells how sure it is and what each pair contributed, which changes with every pair that is added.
What is computed with the rig must not: here only the rig itself passes on, so that as long as it stays the same to the
bit, everything behind it stays cached.
"""

from __future__ import annotations

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import CalibrationFacts, RigFacts
from rille.stages.geometry.geometry import Rig


@stage("calibration")
def calibration_stage(params: NoParams, rig: Bundle[RigFacts]) -> Bundle[CalibrationFacts]:
    """The rig that is computed with."""
    used = Rig.from_dict(rig.meta["rig"])
    return Bundle({}, {"rig": used.to_dict(), "baseline": used.baseline})
