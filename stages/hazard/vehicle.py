"""The vehicle, whose limits decide which cells are hazardous: metres and degrees, at the scale of the sequence."""

from __future__ import annotations

from pydantic import Field, model_validator

from rille.stages.core.declare import Params


class Vehicle(Params):
    """Size and limits of a wheeled vehicle.

    The defaults are a full-scale small rover of about 60 kg: what a 0.3 m wheel and a passive rocker climb at half of
    their reach, so that they hold on loose ground too.

    Attributes
    ----------
    name : name of the vehicle in the report.
    wheel_diameter : diameter of a wheel [m]; side of the window in which terrain is judged, since a wheel bridges what
        is finer.
    track : distance between the left and the right wheels [m].
    wheel_base : distance between the front and the rear wheels [m].
    clearance : height of the belly above flat ground [m].
    max_slope_deg : steepest ground that it drives on [degrees]; half of a usual tip-over angle.
    max_step : highest edge that it climbs [m]; 0.4 of the wheel diameter.
    max_roughness : largest roughness [m]: RMS deviation of heights a quarter of a wheel apart; a third of the step.
    margin : distance that a path keeps from hazards [m]; half a wheel, for errors of localisation.
    """

    name: str = Field("default rover", min_length=1)
    wheel_diameter: float = Field(0.30, gt=0)
    track: float = Field(0.60, gt=0)
    wheel_base: float = Field(0.70, gt=0)
    clearance: float = Field(0.20, gt=0)
    max_slope_deg: float = Field(20.0, gt=0, lt=90)
    max_step: float = Field(0.12, gt=0)
    max_roughness: float = Field(0.04, gt=0)
    margin: float = Field(0.15, ge=0)

    @property
    def wheel_width(self) -> float:
        """Metres; half the diameter, as for most rovers."""
        return 0.5 * self.wheel_diameter

    @property
    def half_width(self) -> float:
        """Metres from the middle line to the outer face of the wheels."""
        return 0.5 * (self.track + self.wheel_width)

    @property
    def half_length(self) -> float:
        """Metres from the middle to the front of the front wheels."""
        return 0.5 * (self.wheel_base + self.wheel_diameter)

    @model_validator(mode="after")
    def _one_unit_of_length(self) -> Vehicle:
        # 100: of metres beside centimetres; of a long lorry 5.
        if not 0.01 < self.wheel_base / self.track < 100.0:
            raise ValueError(
                f"wheel_base {self.wheel_base:g} m and track {self.track:g} m are not those of one vehicle: "
                "give both in metres, at the scale of the sequence"
            )
        return self

    @model_validator(mode="after")
    def _wheels_of_this_vehicle(self) -> Vehicle:
        # Wheels of the largest tractors are as high as their track is wide; a wheel climbs less than its diameter.
        for name, ours, most in (
            ("wheel_diameter", self.wheel_diameter, ("track", 3.0 * self.track)),
            ("max_step", self.max_step, ("wheel_diameter", 3.0 * self.wheel_diameter)),
        ):
            if ours > most[1]:
                text = f"{name} {ours:g} m is more than three times {most[0]}, {most[1] / 3.0:g} m"
                raise ValueError(f"{text}: give all lengths in metres, at the scale of the sequence")
        return self

    @model_validator(mode="after")
    def _belly_clears_what_wheels_climb(self) -> Vehicle:
        if self.max_step > self.clearance:
            raise ValueError(
                f"max_step {self.max_step:g} m is higher than clearance {self.clearance:g} m: "
                "the belly would strike what the wheels climb; lower max_step or raise clearance"
            )
        return self


DEFAULT_VEHICLE = Vehicle()
"""Used, and named in the report, if neither the sequence nor the user states a vehicle."""
