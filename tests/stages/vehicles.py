"""Vehicles that several tests put on their ground."""

from rille.stages.hazard.vehicle import Vehicle

MODEL = Vehicle(
    name="model",
    wheel_diameter=0.03,
    track=0.08,
    wheel_base=0.1,
    clearance=0.03,
    max_slope_deg=20.0,
    max_step=0.015,
    max_roughness=0.01,
    margin=0.01,
)

SHORT = MODEL.model_copy(update={"track": 0.03, "wheel_base": 0.02, "max_step": 0.01, "margin": 0.0})
"""Which covers few cells and keeps no margin."""
