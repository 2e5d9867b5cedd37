"""The vehicle's limits are refused where they contradict each other."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from rille.stages.hazard.vehicle import DEFAULT_VEHICLE, Vehicle


def test_the_default_is_named() -> None:
    assert DEFAULT_VEHICLE.name == "default rover"
    assert Vehicle.meanings().keys() == Vehicle.model_fields.keys()


def test_a_belly_lower_than_the_step_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"max_step 0.12 m .* clearance 0.1 m"):
        Vehicle(clearance=0.1)


@pytest.mark.parametrize("bad", [{"max_slope_deg": 90.0}, {"wheel_diameter": 0.0}, {"margin": -0.1}, {"wheels": 6}])
def test_nonsense_is_refused(bad: dict) -> None:
    with pytest.raises(ValidationError):
        Vehicle(**bad)


@pytest.mark.parametrize("bad", [{"wheel_base": 1e-6}, {"wheel_base": 700}, {"track": 600}])
def test_lengths_in_unlike_units_are_refused(bad: dict[str, float]) -> None:
    """With the default of the other one; a vehicle as short as a millionth of its width took minutes to place."""
    with pytest.raises(ValueError, match="give both in metres"):
        Vehicle(**bad)


@pytest.mark.parametrize(
    ("bad", "named"),
    [({"wheel_diameter": 30}, "wheel_diameter 30 m"), ({"max_step": 12, "clearance": 20}, "max_step 12 m")],
)
def test_wheels_and_steps_of_no_vehicle_are_refused(bad: dict[str, float], named: str) -> None:
    """In centimetres, beside a track in metres; a step that no wheel climbs would make all ground safe."""
    with pytest.raises(ValueError, match=f"{named} is more than three times .* metres"):
        Vehicle(**bad)
