"""The rig that all later stages compute with, and nothing else of what stage ``rig`` has to say.

Stage ``rig`` also tells how sure it is and what each pair contributed, which changes with every pair that is added.
What is computed with the rig must not: here only the rig itself passes on, so that as long as it stays the same to the
bit, everything behind it stays cached.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rille.stages.core.declare import Bundle, Inputs, NoParams, Stage
from rille.stages.geometry.geometry import Rig


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    rig = Rig.from_dict(inputs["rig"].meta["rig"])
    return Bundle({}, {"rig": rig.to_dict(), "baseline": rig.baseline})


STAGE = Stage(
    name="calibration",
    version=1,
    summary="the rig that is computed with",
    params=NoParams,
    inputs=("rig",),
    outputs=(),
    run=_run,
)
