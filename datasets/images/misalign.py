"""Any sequence as if its right camera had been knocked, to try the effect of a wrong calibration.

The right images are warped as if taken by the turned camera, while the *given* rig stays. So stage ``rig`` should find
the turn (its corrections pitch, yaw, roll have these signs), and truth remains true.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import scipy
from pydantic import Field

from rille.datasets.facts import ImageFacts
from rille.datasets.images import files
from rille.datasets.protocol import Sequence, Source
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray, Bundle, Params, stage
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import rotation_exp
from rille.stages.geometry.lens import Lens


class MisalignParams(Params):
    """How the right camera is knocked; all 0: not at all.

    Attributes
    ----------
    rows : shift of the right image downwards [pixels], as by a shifted sensor.
    roll_deg : clockwise turn of the right image [degrees].
    pitch_deg : turn about the right camera's x axis [degrees]; the image's contents move up.
    yaw_deg : turn about the right camera's y axis [degrees]; the image's contents move right.
    since : number of the first frame behind the knock.
    """

    rows: float = Field(0.0, ge=-200, le=200)
    roll_deg: float = Field(0.0, ge=-45, le=45)
    pitch_deg: float = Field(0.0, ge=-20, le=20)
    yaw_deg: float = Field(0.0, ge=-20, le=20)
    since: int = Field(0, ge=0)

    @property
    def none(self) -> bool:
        """Whether nothing is changed."""
        return not any((self.rows, self.roll_deg, self.pitch_deg, self.yaw_deg))

    def words(self) -> str:
        """Change of the right images, in words."""
        turns = f"{self.roll_deg:g} degrees of roll, {self.pitch_deg:g} of pitch, {self.yaw_deg:g} of yaw"
        moved = f"{self.rows:g} px in the row, {turns}"
        since = f" from frame {self.since} on" if self.since else ""
        return f"right images are misaligned on purpose{since}: {moved}; the given rig does not say so"


def misalign(sequence: Sequence, params: MisalignParams) -> Sequence:
    """The sequence with its right images warped, without exact disparity; the same object if nothing is to be changed.

    Raises
    ------
    InputError
        The sequence has disparities of another program, which do not fit the warped images.
    """
    if params.none:
        return sequence
    if sequence.disparity is not None:
        text = "the maps of [disparity] do not hold for right images that misalign moves"
        raise InputError("RIL-903", text, remedy="leave one of the two out")
    lens = (sequence.lenses or {}).get("right", Lens(sequence.rig.right))

    def image(frame: int, camera: str) -> Source:
        source = sequence.image(frame, camera)
        if camera != "right" or frame < params.since:
            return source
        args = {"frame": frame, "camera": camera, "lens": lens.to_dict()}
        return Source("rille.datasets.images.misalign", params, args, inputs={"image": source})

    return replace(
        sequence,
        image=image,
        truth_disparity=None,
        notes=(*sequence.notes, params.words()),
        parameters={**sequence.parameters, "misalign": params},
    )


def origins(lens: Lens, params: MisalignParams) -> tuple[Floats, Floats]:
    """Column and row (height, width) in the original image of each pixel of the knocked one; NaN: outside."""
    camera = lens.camera
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height) - params.rows)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    turn = rotation_exp(np.deg2rad([params.pitch_deg, params.yaw_deg, params.roll_deg]))
    if not np.array_equal(turn, np.eye(3)):
        # Row vectors times R: the inverse turn.
        rays = camera.rays(lens.undistort(pixels, camera)) @ turn
        pixels = lens.distort(camera.project(rays), camera)
    shape = (camera.height, camera.width)
    return pixels[:, 0].reshape(shape), pixels[:, 1].reshape(shape)


def warp(image: AnyArray, valid: AnyArray, lens: Lens, params: MisalignParams) -> tuple[AnyArray, AnyArray]:
    """Knocked image and its mask, (row, col), of the types of the original ones.

    Cubic splines (SciPy's, not OpenCV's remap, which rounds positions to a 32nd of a pixel). A pixel is valid if all
    pixels that the kernel reads are.
    """
    column, row = origins(lens, params)
    there = np.isfinite(column) & np.isfinite(row)
    at = np.stack([np.where(there, row, -1e6), np.where(there, column, -1e6)])
    values = scipy.ndimage.map_coordinates(image.astype(np.float64), at, order=3, mode="nearest")
    top = np.iinfo(image.dtype).max if np.issubdtype(image.dtype, np.integer) else np.inf
    values = np.clip(np.rint(values) if np.isfinite(top) else values, 0, top)
    # 4: pixels along either side that cubic interpolation reads; all must be usable.
    kernel = np.ones((4, 4), np.uint8)
    whole = cv2.erode(
        (valid != 0).astype(np.uint8), kernel, anchor=(1, 1), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    # The kernel begins one pixel before the position, and reads less of it where that is a whole pixel.
    mask = scipy.ndimage.map_coordinates(whole, np.floor(at), order=0)
    return np.where(mask != 0, values, 0).astype(image.dtype), mask


@stage("misalign", outputs=files.image_stage.outputs[:2])
def misalign_stage(
    params: MisalignParams, image: Bundle[ImageFacts], *, frame: int, camera: str, lens: Lens
) -> Bundle[ImageFacts]:
    """Right image as a knocked camera would have taken it."""
    turned, valid = warp(np.asarray(image["image"]), np.asarray(image["valid"]), lens, params)
    return Bundle({"image": turned, "valid": valid}, {"frame": frame, "camera": camera})
