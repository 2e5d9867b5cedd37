"""Keys of the configuration as earlier versions named them: refused, with the present name in the message."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SECTIONS: Mapping[str, str] = {
    "ceiling": "occlusion_bounds",
    "continuity": "frame_screening",
    "exposure": "radiometry",
    "global_fix": "map_localization",
    "leg": "local_planner",
    "level": "ground_frame",
    "pad": "start_area",
    "reflex": "obstacle_monitor",
    "safety": "fault_monitor",
    "seam_audit": "overlap_audit",
    "select": "keyframes",
}

FIELDS: Mapping[str, str] = {
    "global_fix.ambiguous": "min_chi2_gap",
    "global_fix.least": "min_cells",
    "global_fix.sigma": "sigma_height",
    "global_fix.truncate": "truncation",
    "hfvm.crowd": "min_support",
    "hfvm.relief_bend": "variational_bend",
    "hfvm.relief_steps": "variational_steps",
    "hfvm.relief_stiffness": "variational_stiffness",
    "hfvm.smooth_noise": "denoise_from",
    "leg.avoid": "p_costly",
    "leg.back_price": "reverse_cost",
    "leg.blind": "occluded_radius",
    "leg.blind_price": "occluded_cost",
    "leg.caution_price": "caution_cost",
    "leg.clear": "p_clear",
    "leg.dare": "p_max_traversable",
    "leg.doubt_price": "uncertainty_cost",
    "leg.glance_price": "far_cost",
    "leg.least": "min_length",
    "leg.length": "max_length",
    "leg.looks": "max_looks",
    "leg.loyalty": "replan_hysteresis",
    "leg.near_price": "proximity_cost",
    "leg.sure": "p_certain_hazard",
    "leg.turn_price": "turn_cost",
    "leg.unknown_price": "unknown_cost",
    "leg.vain": "failed_view_radius",
    "path.caution": "caution_cost",
    "path.doubt": "uncertainty_cost",
    "path.sure": "p_certain_hazard",
    "reflex.again_share": "min_share_again",
    "reflex.aside": "side_margin",
    "reflex.blur": "model_radius",
    "reflex.height": "min_rise",
    "reflex.points": "min_points",
    "reflex.share": "min_share",
    "reflex.sigma": "sigma_displacement",
    "safety.least_landmarks": "min_landmarks",
    "safety.least_way": "min_distance",
}
"""Last part of the present name, by the former section and key."""

GONE: Mapping[str, str] = {
    "hfvm.greatest_std": "what is filled was no better with it and it is gone: leave it out",
    "refine.stereo": "it gained little and is gone: leave it out",
}


def present(key: str, given: Any) -> str | None:
    """Return the message for a key or section of an earlier version: the present name, or that it is gone.

    Parameters
    ----------
    key : ``section`` or ``section.name``.
    given : value of the key; for a section, a mapping of its keys.

    Returns
    -------
    None if ``key`` is not of an earlier version.
    """
    if key in GONE:
        return f"{key} is a key of an earlier version: {GONE[key]}"
    if key in SECTIONS:
        keys = [f"{key}.{name}" for name in given] if isinstance(given, Mapping) else []
        named = [f"{old} is {_renamed(old)}" for old in keys] or [f"[{key}] is [{SECTIONS[key]}]"]
        return f"keys of an earlier version: {', '.join(named)} now"
    return f"{key} is a key of an earlier version: write {_renamed(key)}" if key in FIELDS else None


def _renamed(key: str) -> str:
    section, name = key.split(".", 1)
    return f"{SECTIONS.get(section, section)}.{FIELDS.get(key, name)}"
