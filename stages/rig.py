"""The rig that a run reconstructs with: here the given calibration, held fixed.

The relative orientation enters every later stage through this one artifact, so that a refined orientation replaces the
given one in one place (paper, section 5.2.2: relative orientation with the baseline length held fixed).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stages.declare import Bundle, Inputs, NoParams, Stage
from stages.errors import InputError
from stages.geometry import Rig


def fixed(rig: Rig) -> dict[str, Any]:
    """Facts of a given rig.

    Returns
    -------
    dict
        ``rig`` (:meth:`Rig.to_dict`), ``mode`` "fixed", ``baseline`` in metres, ``source`` in words.

    Raises
    ------
    InputError
        The cameras share one projection centre.
    """
    if not rig.baseline > 0:
        raise InputError("the rig's baseline is 0 m", remedy="give T_right_left with a translation in metres")
    return {"rig": rig.to_dict(), "mode": "fixed", "baseline": rig.baseline, "source": "given calibration"}


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    return Bundle({}, fixed(Rig.from_dict(args["rig"])))


STAGE = Stage(
    name="rig",
    version=1,
    summary="the rig's calibration",
    params=NoParams,
    inputs=(),
    outputs=(),
    requires=("numpy",),
    run=_run,
)
