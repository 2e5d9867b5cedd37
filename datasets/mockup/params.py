"""What can be varied in the simulated experiment, and what each half of it (bed, camera) needs to know.

The figures are the paper's (sections 3.2, 7.1-7.4) where it gives them.
"""

from __future__ import annotations

from pydantic import Field

from rille.stages.core.declare import Params


class SceneParams(Params):
    """The bed: its terrain and its light. Everything here enters the key of the one cached scene."""

    seed: int = Field(1, ge=0, description="seed of terrain, grain and sensor noise")
    bed_width: float = Field(1.6, ge=0.1, le=4.0, description="m, across; the paper's bed is 1.6 x 2 m")
    bed_length: float = Field(2.0, ge=0.1, le=4.0, description="m, along the drive")
    cell: float = Field(
        0.001, ge=0.0005, le=0.01, description="m, spacing of the heights; grain is drawn at half of it"
    )
    relief: float = Field(0.007, ge=0.0, le=0.03, description="m, RMS of the longest (0.5 m) octave of the relief")
    rocks: float = Field(30.0, ge=0.0, le=200.0, description="1/m2, rocks wider than 30 mm; smaller ones follow D^-2")
    rock_cover: float | None = Field(
        None,
        gt=0.0,
        le=0.3,
        description="share of the bed under rocks wider than 4 mm, sizes by Golombek and Rapp (1997), none "
        "over another; none: as rocks says",
    )
    slope_deg: float = Field(
        0.0,
        ge=-25.0,
        le=25.0,
        description="degrees; rise of the bed ahead. The body stands square on it",
    )
    craters: float = Field(8.0, ge=0.0, le=50.0, description="1/m2, craters wider than 100 mm; others follow D^-2")
    grain: float = Field(0.06, ge=0.0, le=0.3, description="relative RMS of each octave of the albedo grain")
    sun_elevation_deg: float = Field(20.0, ge=3.0, le=90.0, description="degrees above the horizon")
    sun_azimuth_deg: float = Field(
        -110.0, ge=-360.0, le=360.0, description="degrees, where the light comes from, clockwise from straight ahead"
    )
    sun_diameter_deg: float = Field(
        1.5, ge=0.0, le=10.0, description="degrees; a studio lamp some metres away, gives soft shadow edges"
    )


class RenderParams(Params):
    """The camera as a sensor: optics, exposure and noise."""

    seed: int = Field(1, ge=0, description="seed of the sensor noise")
    sampling: int = Field(
        2, ge=1, le=4, description="rays a pixel, along either axis; what a ray sees of the grain is as wide as it"
    )
    blur: float = Field(0.6, ge=0.0, le=5.0, description="px, standard deviation of the optics' point spread")
    noise: float = Field(1.5, ge=0.0, le=50.0, description="grey levels, standard deviation of the sensor noise")
    exposure: float = Field(1.0, gt=0.0, le=10.0, description="factor on the grey values; 1 gives a mean of about 100")
    exposure_jitter: float = Field(0.0, ge=0.0, le=0.5, description="relative standard deviation from image to image")
    right_gain: float = Field(
        0.97, gt=0.0, le=2.0, description="sensitivity of the right camera over the left; no two are equal"
    )
    vignetting: float = Field(0.1, ge=0.0, le=0.9, description="relative loss of light in the image corners")


class MockupParams(SceneParams, RenderParams):
    """Every choice of the simulated experiment."""

    frames: int = Field(40, ge=1, le=2000, description="stereo pairs")
    image_width: int = Field(570, ge=16, le=4096, description="px")
    image_height: int = Field(520, ge=16, le=4096, description="px")
    focal_length: float = Field(600.0, gt=10.0, le=10000.0, description="px; 51 degrees across at 570 px")
    baseline: float = Field(0.097, gt=0.0, le=1.0, description="m (section 7.4)")
    toe_in_deg: float = Field(5.0, ge=-20.0, le=20.0, description="degrees inward, of each camera, about the vertical")
    pitch_deg: float = Field(18.0, ge=0.0, le=60.0, description="degrees downward; the paper says 15-20")
    camera_height: float = Field(0.18, gt=0.05, le=1.0, description="m above the mean of the bed")
    forward: float = Field(0.03, ge=-0.5, le=0.5, description="m a frame, along the heading (section 7.4)")
    sideways: float = Field(0.015, ge=-0.5, le=0.5, description="m a frame, to the right (section 7.4)")
    turn_deg: float = Field(0.0, ge=-45.0, le=45.0, description="degrees a frame, heading change to the right")
    roll_deg: float = Field(0.0, ge=-30.0, le=30.0, description="degrees, constant roll to the right")
    roll_swing_deg: float = Field(
        0.0, ge=0.0, le=60.0, description="degrees, roll from each frame to the next, to the right and back in turn"
    )
    jitter_deg: float = Field(
        0.0, ge=0.0, le=10.0, description="degrees, standard deviation of pitch, roll and heading from frame to frame"
    )
    up_noise_deg: float | None = Field(
        0.2,
        ge=0.0,
        le=10.0,
        description="degrees, standard deviation of the inclinometer's error about each axis, anew in every frame; 0: "
        "the vertical is exact; none: there is no inclinometer, the ground is levelled by its own plane",
    )
    attitude_noise_deg: float | None = Field(
        None,
        ge=0.0,
        le=10.0,
        description="degrees, error of an attitude sensor, which takes the inclinometer's place and gives rotations "
        "from frame to frame, too; none: there is none",
    )
    rig_error_deg: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="degrees about the right camera's x, y, z: error of the rig as it is given"
    )
    focal_error: float = Field(0.0, ge=-0.2, le=0.2, description="relative error of the focal length as it is given")

    def scene(self) -> SceneParams:
        """The bed's part."""
        return SceneParams(**{name: getattr(self, name) for name in SceneParams.model_fields})

    def render(self) -> RenderParams:
        """The sensor's part."""
        return RenderParams(**{name: getattr(self, name) for name in RenderParams.model_fields})


SHORT = {"frames": 9, "bed_width": 1.2, "bed_length": 1.2}
"""``mockup-short``: two segments and the pair that ends the second, on a smaller bed."""

RECORDED_ONLY = (
    *("frames", "forward", "sideways", "turn_deg", "roll_deg", "roll_swing_deg", "jitter_deg"),
    "attitude_noise_deg",
)
"""What says how the body moves and what is told of it; a rover that is driven has its own (``RoverParams``)."""
