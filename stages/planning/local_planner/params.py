"""Parameters of the stage ``leg``: how far, how sure, and at which prices."""

from __future__ import annotations

from pydantic import Field

from rille.stages.core.declare import Params


class LegParams(Params):
    """Parameters of the stage ``leg``."""

    length: float = Field(
        2.0, gt=0, description="longest leg [wheelbases], which is driven to its end without a new map"
    )
    least: float = Field(
        0.3,
        gt=0,
        description="shortest leg [wheelbases] that is worth a stop; instead of a shorter one, look elsewhere",
    )
    max_turn_deg: float = Field(
        40.0,
        gt=5,
        le=120,
        description="largest angle [degrees] between any two headings of a leg, so that at least half of the landmarks "
        "stay in view",
    )
    sure: tuple[float, float] = Field(
        (0.9, 0.995),
        description="probability of a hazard from which ground is closed; second value: the same where the first "
        "leaves no path (distant ground is uncertain, and better known once the rover is nearer)",
    )
    dare: float = Field(
        0.3,
        ge=0,
        le=0.5,
        description="probability of a hazard below which ground that exceeds a limit only within its standard "
        "deviation is driven on, at a price; the vehicle's limits are half of what tips it over, and with 0 many rock "
        "fields have no path",
    )
    avoid: float = Field(
        0.06,
        gt=0,
        le=1,
        description="probability of a hazard from which ground is expensive; in the simulator every edge that the map "
        "had missed lay on ground of at least 0.07",
    )
    clear: float = Field(
        0.02,
        ge=0,
        lt=1,
        description="probability of a hazard below which ground is driven on that was seen from a distance only; in "
        "the simulator 0.05 per mille of such wheel positions had an edge that the map had missed, against 3.7 per "
        "mille of all",
    )
    glance_price: float = Field(
        1.3, ge=1, description="cost of a metre over ground that was seen from a distance only; known ground costs 1"
    )
    unknown_price: float = Field(2.0, ge=1, description="cost of a metre over unknown ground; known ground costs 1")
    doubt_price: float = Field(
        4.0,
        ge=1,
        description="cost of a metre over ground that is probably but not certainly hazardous, or over unseen gaps "
        "narrower than a wheel (the shadows of stones): both mostly remain when seen from nearer",
    )
    caution_price: float = Field(
        0.2,
        ge=0,
        description="added to the cost of a metre where all wheels are on caution ground: a detour of a fifth",
    )
    blind: float = Field(
        1.5,
        ge=0,
        description="radius [wheelbases] around the vehicle within which looking there does not show unknown ground; "
        "within twice this radius, doubtful ground is taken to remain doubtful",
    )
    blind_price: float = Field(
        6.0,
        ge=1,
        description="cost of a metre over unknown ground within that radius, so that other paths are tried first",
    )
    loyalty: float = Field(
        0.15,
        ge=0,
        description="share by which a new path must be cheaper than the one being followed to replace it",
    )
    near_price: float = Field(
        0.5, ge=0, description="added to the cost of a metre at a hazard's margin; falls to 0 within another margin"
    )
    back_price: float = Field(
        3.0, ge=1, description="cost of a metre driven backwards, where no camera looks; a metre ahead costs 1"
    )
    turn_price: float = Field(0.3, ge=0, description="cost [wheelbases] of a turn on the spot by one radian")
    spacing: float = Field(
        0.25, gt=0, le=1, description="spacing [wheel diameters] of the positions over which paths are planned"
    )
    tolerance: float = Field(0.3, gt=0, description="distance [wheelbases] from the goal at which it counts as reached")
    looks: int = Field(
        3, ge=1, description="number of looks without progress after which the way ahead counts as closed"
    )
    vain: float = Field(
        0.8, gt=0, description="radius [wheelbases] within which unknown ground is then closed to planning"
    )
