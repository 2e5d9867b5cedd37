"""Parameters of the simulated experiment, and the parts of them that bed and camera read.

The figures are the paper's (sections 3.2, 7.1-7.4), as far as it states them.
"""

from __future__ import annotations

from typing import TypeVar

from pydantic import Field

from rille.stages.core.declare import Params

Part = TypeVar("Part", bound=Params)


class SceneParams(Params):
    """The bed: its terrain and its light. Everything here enters the key of the one cached scene.

    Attributes
    ----------
    seed : seed of terrain, grain and sensor noise.
    bed_width : width of the bed [m]; the paper's bed is 1.6 x 2 m.
    bed_length : length of the bed along the drive [m].
    cell : spacing of the heights [m]; of the grain, half of it.
    relief : RMS [m] of the longest octave (0.5 m) of the relief.
    rocks : rocks wider than 30 mm a square metre; numbers follow D^-2.
    rock_cover : share of the bed under rocks wider than 4 mm, sizes by Golombek and Rapp (1997), no rock over another;
        not set: mockup.rocks decides.
    slope_deg : slope of the bed ahead [degrees]; the body is square on it.
    craters : craters wider than 0.1 m a square metre; numbers follow D^-2.
    grain : relative RMS of each octave of the albedo grain.
    sun_elevation_deg : elevation of the light [degrees].
    sun_azimuth_deg : azimuth of the light [degrees], clockwise from ahead.
    """

    seed: int = Field(1, ge=0)
    bed_width: float = Field(1.6, ge=0.1, le=4.0)
    bed_length: float = Field(2.0, ge=0.1, le=4.0)
    cell: float = Field(0.001, ge=0.0005, le=0.01)
    relief: float = Field(0.007, ge=0.0, le=0.03)
    rocks: float = Field(30.0, ge=0.0, le=200.0)
    rock_cover: float | None = Field(None, gt=0.0, le=0.3)
    slope_deg: float = Field(0.0, ge=-25.0, le=25.0)
    craters: float = Field(8.0, ge=0.0, le=50.0)
    grain: float = Field(0.06, ge=0.0, le=0.3)
    sun_elevation_deg: float = Field(20.0, ge=3.0, le=90.0)
    sun_azimuth_deg: float = Field(-110.0, ge=-360.0, le=360.0)


class RenderParams(Params):
    """The camera as a sensor: optics, exposure and noise.

    Attributes
    ----------
    seed : seed of the sensor noise.
    sampling : rays a pixel along either axis; each averages its own width.
    noise : standard deviation [grey levels] of the sensor noise.
    exposure : factor on the grey values; 1: a mean of about 100.
    exposure_jitter : relative standard deviation of the images' exposures.
    """

    seed: int = Field(1, ge=0)
    sampling: int = Field(2, ge=1, le=4)
    noise: float = Field(1.5, ge=0.0, le=50.0)
    exposure: float = Field(1.0, gt=0.0, le=10.0)
    exposure_jitter: float = Field(0.0, ge=0.0, le=0.5)


class SetupParams(SceneParams, RenderParams):
    """The bed, and the two cameras over it.

    Attributes
    ----------
    image_width : width of the images [px].
    image_height : height of the images [px].
    focal_length : focal length [px]; 600: 51 degrees at 570 px.
    baseline : distance between the cameras [m] (section 7.4).
    toe_in_deg : inward turn of each camera [degrees].
    pitch_deg : downward pitch of the cameras [degrees]; the paper: 15-20.
    camera_height : height of the cameras above the mean of the bed [m].
    rig_error_deg : rotation errors of the given rig about the right camera's x, y, z [degrees].
    """

    image_width: int = Field(570, ge=16, le=4096)
    image_height: int = Field(520, ge=16, le=4096)
    focal_length: float = Field(600.0, gt=10.0, le=10000.0)
    baseline: float = Field(0.097, gt=0.0, le=1.0)
    toe_in_deg: float = Field(5.0, ge=-20.0, le=20.0)
    pitch_deg: float = Field(18.0, ge=0.0, le=60.0)
    camera_height: float = Field(0.18, gt=0.05, le=1.0)
    rig_error_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def part(self, kind: type[Part]) -> Part:
        """The parameters of one part, bed or camera."""
        return kind(**{name: getattr(self, name) for name in kind.model_fields})


class MockupParams(SetupParams):
    """Every choice of the simulated experiment: a recorded motion, and the vertical and attitude given with it.

    Attributes
    ----------
    frames : number of stereo pairs.
    forward : motion ahead per frame [m] (section 7.4).
    sideways : motion to the right per frame [m] (section 7.4).
    turn_deg : turn to the left per frame [degrees]; 360 over the frames: a closed way.
    roll_deg : constant roll to the right [degrees].
    jitter_deg : standard deviation of each frame's angles [degrees].
    inclinometer : whether the vertical is measured; false: the ground is levelled by its own plane.
    up_noise_deg : standard deviation of the inclinometer's error about each axis [degrees], anew in every frame; 0: the
        vertical is exact.
    attitude_noise_deg : standard deviation of an attitude sensor's error about each axis [degrees]; it replaces the
        inclinometer and gives rotations from frame to frame as well; not set: no such sensor.
    """

    frames: int = Field(40, ge=1, le=2000)
    forward: float = Field(0.03, ge=-0.5, le=0.5)
    sideways: float = Field(0.015, ge=-0.5, le=0.5)
    turn_deg: float = Field(0.0, ge=-45.0, le=45.0)
    roll_deg: float = Field(0.0, ge=-30.0, le=30.0)
    jitter_deg: float = Field(0.0, ge=0.0, le=10.0)
    inclinometer: bool = True
    up_noise_deg: float = Field(0.2, ge=0.0, le=10.0)
    attitude_noise_deg: float | None = Field(None, ge=0.0, le=10.0)


SHORT = {"frames": 9, "bed_width": 1.2, "bed_length": 1.2}
"""``mockup-short``: two segments and the pair that ends the second, on a smaller bed."""
