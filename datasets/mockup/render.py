"""Stage ``mockup.render``: one image of the bed by one camera.

Some rays per pixel; McEwen's lunar-Lambert reflectance 2 L mu0 / (mu0 + mu) + (1 - L) mu0 (doi:10.1016/0019-1035(91)
90038-7), the first term Lommel-Seeliger; anisotropic look-up of the albedo pyramid by footprint; then optics blur,
vignetting, exposure, noise and quantisation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from rille.datasets.facts import ImageFacts
from rille.datasets.mockup.facts import SceneFacts
from rille.datasets.mockup.params import RenderParams
from rille.datasets.mockup.raycast import HeightField
from rille.datasets.mockup.scene import ALBEDO_LEVELS, height_field
from rille.datasets.protocol import CAMERAS
from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, Memory, stage
from rille.stages.core.kernel import inlined, kernel
from rille.stages.geometry.geometry import Camera, RigidTransform

MCEWEN_L = 0.6
"""McEwen's L near a phase angle of 70 degrees, usual here."""
AMBIENT_LIGHT = 0.05
"""Stray light of the room, relative to the lamp on a surface that faces it."""


def camera_rays(camera: Camera, T_bed_camera: RigidTransform, sampling: int = 1) -> Floats:
    """Directions (sampling * height * sampling * width, 3) in the bed frame, z = 1 in the camera frame, row-major."""
    offset = (np.arange(sampling) + 0.5) / sampling - 0.5
    x = (np.arange(camera.width)[:, None] + offset).ravel()
    y = (np.arange(camera.height)[:, None] + offset).ravel()
    columns, rows = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    r = T_bed_camera.rotation
    # Written out instead of a matrix product, for the same bits with any BLAS.
    return np.stack([columns * r[k, 0] + rows * r[k, 1] + r[k, 2] for k in range(3)], axis=-1).reshape(-1, 3)


def transform(T_dst_src: RigidTransform, points: Floats) -> Floats:
    """Points (n, 3) of the source frame in the destination frame; written out for the same reason."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    r, t = T_dst_src.rotation, T_dst_src.translation
    return np.stack([x * r[k, 0] + y * r[k, 1] + z * r[k, 2] + t[k] for k in range(3)], axis=1)


class _Bed(NamedTuple):
    """Grids (row, col) of the bed: ``height`` m, ``sunlit`` and ``tint``; ``x0``, ``y0`` of their first cell and
    ``cell``, m; ``rise``: m upwards a metre ahead; ``sun`` (3,) direction towards it."""

    height: Floats32
    sunlit: Bytes
    tint: Bytes
    x0: float
    y0: float
    cell: float
    rise: float
    sun: Floats


@kernel
def _shade(bed, albedo, origin, directions, distance, pixel_angle):  # type: ignore[no-untyped-def]
    """Radiance (n,) of the hit points, NaN for rays without one; ``albedo``: its levels, the finest first."""
    height, cell, sun = bed.height, bed.cell, bed.sun
    n = directions.shape[0]
    out = np.full(n, np.nan, np.float32)
    for i in range(n):
        t = distance[i]
        if not t >= 0.0:
            continue
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        x, y = origin[0] + t * dx, origin[1] + t * dy
        c, r = (x - bed.x0) / cell, (bed.y0 - y) / cell
        vx, vy, vz = -dx / length, -dy / length, -dz / length
        minor = t * length * pixel_angle
        # Slopes over the footprint, or one cell if that is larger: finer ones are not resolved.
        s = max(1.0, 0.5 * minor / cell)
        gx = (_bilinear(height, r, c + s) - _bilinear(height, r, c - s)) / (2.0 * s * cell)
        gy = (_bilinear(height, r - s, c) - _bilinear(height, r + s, c)) / (2.0 * s * cell)
        norm = math.sqrt(1.0 + gx * gx + gy * gy)
        mu0 = max((sun[2] - gx * sun[0] - gy * sun[1]) / norm, 0.0)
        # A slope over the footprint may face away from a camera that sees the point: keep the cosine positive.
        mu = max((vz - gx * vx - gy * vy) / norm, 0.05)
        lit = _bilinear(bed.sunlit, r, c) / 255.0
        # Lunar-Lambert: Lommel and Seeliger's law, which knows no limb darkening, mixed with Lambert's.
        direct = lit * (2.0 * MCEWEN_L * mu0 / (mu0 + mu) + (1.0 - MCEWEN_L) * mu0) if mu0 > 0.0 else 0.0
        # Grain is draped over rocks, not projected from above, so that walls are not streaked; without the rise of a
        # sloped bed, whose far end would lie beyond the grain.
        drape = (origin[2] + t * dz - bed.rise * y) / cell
        # Footprint on the ground: an ellipse stretched along the line of sight.
        stretch = min(1.0 / mu, 8.0)
        taps = int(stretch + 0.5)
        flat = math.sqrt(vx * vx + vy * vy) + 1e-12
        ax, ay = vx / flat * minor * stretch, vy / flat * minor * stretch
        level = math.log2(max(minor * stretch / taps / (0.5 * cell), 1.0))
        # Just below the last level, since the one above it is read as well.
        level = min(level, len(albedo) - 1.001)
        low = int(level)
        f = level - low
        total = 0.0
        for k in range(taps):
            a = (k + 0.5) / taps - 0.5
            # The albedo has two texels a cell; rows grow where y falls.
            tr = 2.0 * (r - drape - a * ay / cell)
            tc = 2.0 * (c + a * ax / cell)
            total += (1.0 - f) * _texel(albedo, low, tr, tc)
            total += f * _texel(albedo, low + 1, tr, tc)
        # 128 and 100 are the bytes that stand for 1 in the albedo and in the tint.
        out[i] = total / taps / 128.0 * _bilinear(bed.tint, r, c) / 100.0 * (direct + AMBIENT_LIGHT)
    return out


@inlined
def _bilinear(a, r, c):  # type: ignore[no-untyped-def]
    """Bilinear value at (row, column), clamped to the grid."""
    r = min(max(r, 0.0), a.shape[0] - 1.000001)
    c = min(max(c, 0.0), a.shape[1] - 1.000001)
    i, j = int(r), int(c)
    u, v = r - i, c - j
    top = (1.0 - v) * a[i, j] + v * a[i, j + 1]
    return (1.0 - u) * top + u * ((1.0 - v) * a[i + 1, j] + v * a[i + 1, j + 1])


@kernel
def _texel(albedo, level, r, c):  # type: ignore[no-untyped-def]
    """Bilinear value of one level of the albedo at (row, column) of level 0."""
    size = float(1 << level)
    # A texel of a coarser level lies in the middle of those that it is the mean of.
    return _bilinear(albedo[level], (r + 0.5) / size - 0.5, (c + 0.5) / size - 0.5)


def radiance(
    scene: Bundle, field: HeightField, camera: Camera, T_bed_camera: RigidTransform, sampling: int = 2
) -> tuple[Floats32, Bools]:
    """Radiance of every ray, float32 (row, n, col, n) for n = ``sampling``, NaN beside the bed; and the bed's mask,
    bool (row, col).

    The mask is true where all rays of the pixel and of its eight neighbours hit the bed.
    """
    rays = camera_rays(camera, T_bed_camera, sampling)
    origin = T_bed_camera.translation
    distance = field.cast(origin[None, :], rays)
    # Copies, so that all levels have one type, none read-only.
    albedo = tuple(np.array(scene[f"albedo_{k}"][:], order="C") for k in range(ALBEDO_LEVELS))
    light = scene.meta["scene"]
    e, a = math.radians(light["sun_elevation_deg"]), math.radians(light["sun_azimuth_deg"])
    sun = np.array([math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)])
    rise = math.tan(math.radians(light["slope_deg"]))
    sunlit, tint = (np.ascontiguousarray(scene[name][:]) for name in ("sunlit", "tint"))
    bed = _Bed(field.height, sunlit, tint, field.x0, field.y0, field.cell, rise, sun)
    values = _shade(bed, albedo, np.ascontiguousarray(origin), rays, distance, 1.0 / (sampling * camera.fx))
    blocks = values.reshape(camera.height, sampling, camera.width, sampling)
    hit = np.isfinite(blocks).all(axis=(1, 3))
    # border_value 1: beyond the image's border there may be bed, so the border itself costs no pixels.
    mask = scipy.ndimage.binary_erosion(hit, np.ones((3, 3)), border_value=1)
    return blocks, np.asarray(mask)


@stage(
    "mockup.render",
    outputs=[
        Array("image", ("row", "col"), "uint8", "grey", "image"),
        Array("valid", ("row", "col"), "uint8", "1", "1 = usable, 0 = background beyond the bed"),
    ],
    memory=Memory(result=0.02),
)
def render_stage(
    params: RenderParams,
    scene: Bundle[SceneFacts],
    *,
    frame: int,
    camera: str,
    geometry: Camera,
    T_bed_camera: RigidTransform,
) -> Bundle[ImageFacts]:
    """One image of the simulated bed."""
    blocks, mask = radiance(scene, height_field(scene), geometry, T_bed_camera, params.sampling)
    # A stream for each image, whose noise does not depend on other images.
    rng = np.random.default_rng([params.seed, 50, frame, CAMERAS.index(camera)])
    mu0 = math.sin(math.radians(scene.meta["scene"]["sun_elevation_deg"]))
    # Radiance of level ground of mean albedo on the camera's axis.
    # 0.31: cosine of the emission angle for which the exposure is set: ground seen 18 degrees below the horizon.
    flat = 2.0 * MCEWEN_L * mu0 / (mu0 + 0.31) + (1.0 - MCEWEN_L) * mu0 + AMBIENT_LIGHT
    # 112.0: grey level of sunlit level ground; shadows and vignetting bring the mean of a picture to about 100.
    gain = 112.0 / flat * params.exposure * (1.0 + params.exposure_jitter * float(rng.standard_normal()))
    # No two cameras are equally sensitive.
    gain *= 0.97 if camera == "right" else 1.0
    # The room around the bed is dark.
    samples = np.where(np.isnan(blocks), np.float32(9.0), blocks * np.float32(gain))
    # The optics' point spread.
    grey = scipy.ndimage.gaussian_filter(samples.astype(np.float64).mean(axis=(1, 3)), 0.6, mode="nearest")
    y, x = np.ogrid[-1.0 : 1.0 : geometry.height * 1j, -1.0 : 1.0 : geometry.width * 1j]
    # A tenth of the light is lost in the corners.
    grey = grey * (1.0 - 0.1 * (x * x + y * y) / 2.0)
    # Noise of the sensor: white, neither blurred nor vignetted.
    noisy = grey + params.noise * rng.standard_normal(grey.shape)
    image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return Bundle({"image": image, "valid": mask.astype(np.uint8)}, {"frame": frame, "camera": camera})
