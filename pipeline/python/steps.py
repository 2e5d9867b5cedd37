"""One stereo pair, one step at a time from Python: images to disparity, elevation model, hazards and path.

Each function runs the stages that a run has for the same step, in this process and without a cache: the values are
those of a run, to the bit. Datasets are those of the stages' outputs, with coordinates and units;
their attributes carry the facts and settings that the next step needs.

>>> import rille
>>> small = {"frames": 1, "image_width": 190, "image_height": 174, "focal_length": 200}
>>> pair = rille.open("mockup-short", mockup=small)[0]
>>> disparity = rille.match(pair.left, pair.right)
>>> disparity.column_disparity.dims, disparity.column_disparity.units
(('row', 'col'), 'px')
>>> dem = rille.terrain(disparity, pair, cell_size=0.005)
>>> hazards = rille.hazards(dem)
>>> path = rille.path(hazards)
>>> dem.elevation.units, hazards.risk.dtype, path.path.dims
('m', dtype('uint8'), ('vertex', 'xyz'))
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence as Series
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rille.datasets.protocol import CAMERAS
from rille.datasets.text.reading import read_toml
from rille.pipeline.engine.runtime.environment import prepare_environment
from rille.pipeline.flow import config
from rille.pipeline.python.arguments import Settings, check_sections, place_of
from rille.pipeline.python.datasets import bundle_of, dataset_of, merged, noted, settings_of
from rille.pipeline.python.sequence import StereoPair, builder, checksum, computed, image_of
from rille.stages.core.declare import AnyArray, Bundle
from rille.stages.core.errors import ConfigError, InputError, warning
from rille.stages.core.validity import Validity

if TYPE_CHECKING:
    import xarray


def match(left: Any, right: Any, **hfvm: Any) -> xarray.Dataset:
    """Match two images of any two cameras, as ``rille match --dense`` does and, of a pair, a run.

    Parameters
    ----------
    left, right
        Images of a :class:`StereoPair`, or arrays (row, col), uint8, uint16 (0..65535) or floating point (0..255).
        Pixels that are NaN, or masked by :mod:`numpy.ma`, are not used. Their sizes may differ.
    hfvm
        Parameters of section ``hfvm``, e.g. ``preset="fast"``.

    Returns
    -------
    xarray.Dataset
        Of each pixel of the left image (row, col): ``column_disparity`` and ``row_disparity``, right minus left,
        ``disparity_std``, standard deviation along the epipolar line, and ``backmatch_error``, float32 pixels, NaN
        undefined; ``distance``, float32, least feature distance; ``validity``, uint8. Gaps along rows are filled: of
        ``validity`` the bit 1 is set where a pixel was matched, 2 where it was interpolated. Attributes: ``usable``,
        how many pixels show the scene and are not masked, and ``match_rate``, the matched share of these.

    Raises
    ------
    InputError
        An image is not grey, or its values are floating point from 0 to 1, or normalised.
    ConfigError
        A parameter is unknown, or not permitted.

    Warns
    -----
    UserWarning
        Hardly a pixel matches, most have no texture, one image is blurred beside the other one, or samples of 16 bits
        use a small part of their range and are spread.

    Examples
    --------
    Any two arrays do; here the right image shows the same, 7 columns to the left and 2 rows down.

    >>> import numpy as np, rille
    >>> left = np.random.default_rng(1).integers(0, 256, (120, 160)).astype(np.uint8)
    >>> disparity = rille.match(left, np.roll(left, (2, -7), (0, 1)))
    >>> [round(float(disparity[name].median()), 1) for name in ("column_disparity", "row_disparity")]
    [-7.0, 2.0]
    """
    prepare_environment()
    from rille.pipeline.flow import tiles
    from rille.stages.calibration.doubt import doubts
    from rille.stages.hfvm.stage import facts, hfvm_stage, match_pyramids
    from rille.stages.imaging import levels, pyramid

    carried, marks = settings_of(left), [mark for image in (left, right) for mark in noted(image).get("images", [None])]
    built: Any = config.build(carried, {"hfvm": hfvm})
    left, right = map(_rows_first, (left, right))
    images = [_pixels(image) for image in (left, right)]
    for camera, image in zip(CAMERAS, images, strict=True):
        if image.dtype.kind in "OSU":  # a path, or nothing
            text = f"the {camera} image is {image.reshape(-1)[:1].tolist()}, no array of pixels"
            raise InputError("RIL-675", text, remedy="read files first: cv2.imread(NAME, cv2.IMREAD_GRAYSCALE), say")
        if image.dtype.kind == "f":
            known = image[np.isfinite(image)]
            low, high = float(known.min(initial=0)), float(known.max(initial=0))
            # From 0 to 1, or with the mean removed and the deviation made 1; 16 bits in floating point.
            if 0 < high <= 1 or (low < 0 and (high - low < 16 or high == 0)) or high > 2 * 255:
                text = f"the {camera} image's values lie from {low:.3g} to {high:.3g}: {image.dtype} is taken as 0..255"
                raise InputError("RIL-973", text, remedy="scale them to 0..255")
    # Images of a sequence are spread as its others are.
    images, spread = (images, list[str]()) if "valid" in getattr(left, "coords", ()) else levels.levelled(images)
    valid = [_valid(image) for image in (left, right)]
    first, second = (pyramid.build(image, built.pyramid, mask) for image, mask in zip(images, valid, strict=True))
    options = tiles.match_options(built.tiling, built.hfvm, built.pyramid, (images[0].shape, images[1].shape))
    disparity = match_pyramids(first, second, built.hfvm, options=options)
    meta = facts(disparity.arrays, built.hfvm, disparity.unlike, int(np.count_nonzero(first.valid[0])))
    for line in (*spread, *doubts(disparity, *images, closely=False)):
        warnings.warn(line, stacklevel=2)
    return dataset_of(hfvm_stage, Bundle(disparity.arrays, meta), config.merge(carried, {"hfvm": hfvm}), marks)


def _pixels(image: Any) -> AnyArray:
    """An image as an array; the name of its type if it is none."""
    try:
        return np.asarray(image)
    except (TypeError, ValueError):  # a Dataset, or rows of unlike lengths
        return np.asarray([type(image).__name__])


def _rows_first(image: Any) -> Any:
    """An image of xarray whose dimensions by their names are column and row, transposed; any other as it is."""
    dims: tuple[object, ...] = tuple(getattr(image, "dims", ()))  # those of a Dataset have no order
    return image.transpose() if len(dims) == 2 and dims[0] in ("x", "col", "column", "width") else image


def _valid(image: Any) -> AnyArray | None:
    """Which pixels to use (row, col): of a :class:`StereoPair`, or of an array of :mod:`numpy.ma`; None: all."""
    if "valid" in getattr(image, "coords", ()):
        return np.asarray(image.valid)
    return ~np.ma.getmaskarray(image) if isinstance(image, np.ma.MaskedArray) else None


def points(disparity: xarray.Dataset, pair: StereoPair, every: int = 1) -> xarray.Dataset:
    """Place every matched pixel of a pair in space, in the frame of its left camera: x right, y down, z ahead, metres.

    No ground is needed. The rig is used as given; :func:`terrain` repairs its orientation where the matches ask for it.

    Parameters
    ----------
    disparity
        Of :func:`match`, of this pair, or as :func:`terrain` takes it.
    pair
        The pair.
    every
        Take each so many-th row and column alone.

    Returns
    -------
    xarray.Dataset
        ``position`` (point, xyz), m, float64; ``sigma_along`` and ``sigma_across`` (point), standard deviations along
        and across the ray, m, float32, without errors of the rig; ``colour`` (point, rgb), 0..255, uint8; ``pixel``
        (point, uv), column and row in the left image, int32.

    Raises
    ------
    InputError
        The disparity is none of images of this size.
    ConfigError
        ``every`` is no whole number from 1.

    Warns
    -----
    UserWarning
        The disparity was found in other images.

    Examples
    --------
    >>> import rille
    >>> small = {"frames": 1, "image_width": 190, "image_height": 174, "focal_length": 200}
    >>> pair = rille.open("mockup-short", mockup=small)[0]
    >>> cloud = rille.points(rille.match(pair.left, pair.right, preset="fast"), pair)
    >>> bool(cloud.sizes["point"] > 10000), round(float(cloud.position[:, 2].median()), 1)
    (True, 0.4)
    """
    import xarray

    from rille.stages.terrain.points import colours
    from rille.stages.terrain.points import points as points_of

    if every not in range(1, 100_000):
        raise ConfigError("RIL-867", f"every = {every!r:.80} is no step of rows", remedy="give a whole number from 1")
    given = _disparity(disparity, pair)
    built: Any = config.build(merged(disparity, pair.settings, {}))
    std = np.full(given["validity"].shape, built.locus.sigma_disparity)
    found = points_of(replace(given, arrays={"disparity_std": std, **given.arrays}), pair.sequence.rig, int(every))
    return xarray.Dataset(
        {
            "position": (("point", "xyz"), found.position, {"units": "m", "frame": "left camera"}),
            "sigma_along": ("point", found.sigma_along, {"units": "m"}),
            "sigma_across": ("point", found.sigma_across, {"units": "m"}),
            "colour": (("point", "rgb"), colours(found.pixel, image_of(pair, "left"))),
            "pixel": (("point", "uv"), found.pixel, {"units": "px"}),
        }
    )


def _disparity(disparity: xarray.Dataset, pair: object) -> Bundle:
    """The result of the matcher, if it has the size of the pair's images; what is unknown in it is not matched."""
    from rille.stages.hfvm.stage import hfvm_stage

    if not isinstance(pair, StereoPair):
        text = f"pair is a {type(pair).__name__}"
        raise InputError("RIL-674", text, remedy="give one pair of a sequence: rille.open(...)[0]")
    given = bundle_of(disparity, hfvm_stage, ("column_disparity", "row_disparity"), "rille.match")
    size = pair.sequence.rig.left.height, pair.sequence.rig.left.width
    if disparity.column_disparity.shape != size:
        text = f"disparity of {disparity.column_disparity.shape} pixels, the pair's images have {size}"
        raise InputError("RIL-865", text, remedy="give the disparity that rille.match finds for this pair")
    for camera, mark in zip(CAMERAS, noted(disparity).get("images", ()), strict=False):
        if mark is not None and mark != checksum(pair, camera):  # None: of an array of the user's own
            text = f"the disparity was not found in the {camera} image of pair {pair.frame} of {pair.sequence.name}"
            line = f"{text}: unless that shows the same, give the pair whose images rille.match was given"
            warnings.warn(warning("RIL-796", line), stacklevel=3)
    arrays = dict(given.arrays)
    known = np.isfinite(arrays["column_disparity"]) & np.isfinite(arrays["row_disparity"])
    validity = arrays.get("validity", np.isfinite(arrays.get("disparity_std", 0)) * np.uint8(Validity.MATCHED))
    arrays["validity"] = np.where(known, validity, validity & ~np.uint8(Validity.MATCHED | Validity.INTERPOLATED))
    # Without errors of matching back all that is matched counts as confirmed.
    return replace(given, arrays={"backmatch_error": np.zeros(size, np.float32), **arrays})


def terrain(
    disparity: xarray.Dataset, pair: StereoPair, reference: str | Series[float] | None = None, **locus: Any
) -> xarray.Dataset:
    """Reconstruct the elevation model of a pair (Locus), in the pair's own frame: x right, y ahead, z up, metres.

    The origin is the left camera's centre. The relative orientation is repaired where the matches contradict it, and
    the vertical is found, as in a run that has this pair alone. Where no ground is seen, z is the distance from the
    plane that most of the scene lies on.

    Parameters
    ----------
    disparity
        Of :func:`match`, of this pair; pixels that :meth:`xarray.Dataset.where` masks count as unmatched. Enough are
        ``column_disparity`` and ``row_disparity`` (row, col), right minus left, px, NaN unknown: without ``validity``
        all known pixels count as matched, without ``disparity_std`` their standard deviation is
        ``locus.sigma_disparity``. Without its attributes no parameter follows its preset.
    pair
        The pair.
    reference
        What elevations are measured from: ``"ground"``, ``"scene"``, or a plane ``[nx, ny, nz, x, y, z]``, its normal
        and a point of it in the left camera's frame (m), as parameter ``terrain.reference``; None: the ground if it
        is seen, else the scene's plane.
    locus
        Parameters of section ``locus``, e.g. ``cell_size=0.01`` (m).

    Returns
    -------
    xarray.Dataset
        Of each cell (row, col), float32, NaN undefined: ``elevation`` and ``elevation_std`` (m), ``ortho``, grey value
        0..255 of the left image. Coordinates ``x`` (col) and ``y`` (row) are those of the cells' centres (m); y falls
        from row to row.

    Raises
    ------
    DegenerateError
        Nothing is matched, or the pair shows no ground and ``reference`` is ``"ground"``.
    InputError
        The disparity is none of images of this size.
    ConfigError
        A parameter is unknown, or not permitted.

    Warns
    -----
    UserWarning
        The disparity was found in other images.

    Examples
    --------
    The cameras stand 0.18 m above the ground.

    >>> import rille
    >>> small = {"frames": 1, "image_width": 190, "image_height": 174, "focal_length": 200}
    >>> pair = rille.open("mockup-short", mockup=small)[0]
    >>> dem = rille.terrain(rille.match(pair.left, pair.right, preset="fast"), pair, cell_size=0.005)
    >>> round(float(dem.elevation.median()), 2), dem.elevation.units
    (-0.18, 'm')
    """
    from rille.pipeline.flow.builders import other_plane
    from rille.pipeline.flow.reconstruction import vertical
    from rille.stages.terrain.locus import stage as locus_stage

    given = _disparity(disparity, pair)
    settings = merged(disparity, pair.settings, {"terrain": {"reference": reference}, "locus": locus})
    make = builder(pair, settings)
    _, known = make.rig([pair.frame])
    at, done = vertical(make, pair.frame), {make.disparity(pair.frame): given}
    level = make.level(pair.frame, at, known)
    plane = other_plane(make.config, [computed(level, done, pair.sequence.drawn).meta], placed=False)
    if plane is not None:
        level = make.level(pair.frame, at, known, plane)
    dem = computed(make.pair(pair.frame, level, known, None).dem, done, pair.sequence.drawn)
    return dataset_of(locus_stage.locus_stage, dem, settings)


def hazards(dem: xarray.Dataset, vehicle: Settings | str | Path | None = None, **risk: Any) -> xarray.Dataset:
    """Classify the ground of an elevation model for a vehicle.

    Parameters
    ----------
    dem
        Of :func:`terrain`, whole; cells may be masked by :meth:`xarray.Dataset.where`.
    vehicle
        Limits and sizes (metres, degrees), as in section ``vehicle``, or a TOML file of them; None: that of the
        sequence.
    risk
        Parameters of section ``risk``.

    Returns
    -------
    xarray.Dataset
        Of each cell (row, col): ``risk``, uint8, 0 safe, 1 caution, 2 hazard, 3 unknown; ``p_hazard`` and ``p_wheel``,
        probabilities that a measure, or one of a wheel's window, exceeds its limit; ``reason``, uint16, bits of the
        exceeded limits; ``filled``, uint8, 1 where a small hole was closed, and ``elevation`` (m) so; the measures
        ``height_range``, ``step``, ``roughness``, ``clearance`` (m), ``inclination``, ``slope`` and ``tilt``
        (radians). All others are float32. Coordinates are those of ``dem``.

    Raises
    ------
    InputError
        The dataset is not that of :func:`terrain`, or its elevations are distances from a plane that is no ground.
    ConfigError
        A limit or parameter is unknown, or not permitted.

    Examples
    --------
    >>> import rille
    >>> small = {"frames": 1, "image_width": 190, "image_height": 174, "focal_length": 200}
    >>> pair = rille.open("mockup-short", mockup=small)[0]
    >>> dem = rille.terrain(rille.match(pair.left, pair.right, preset="fast"), pair, cell_size=0.005)
    >>> agile = rille.hazards(dem, vehicle={"max_slope_deg": 30, "max_step": 0.02})
    >>> timid = rille.hazards(dem, vehicle={"max_slope_deg": 5, "max_step": 0.005})
    >>> bool((agile.risk == 2).sum() < (timid.risk == 2).sum())
    True
    """
    prepare_environment()
    from rille.stages.hazard import risk as risk_stage
    from rille.stages.terrain.locus import stage as locus_stage

    limits: dict[str, Any] = {}
    if isinstance(vehicle, str | Path):
        read = read_toml(Path(place_of(vehicle, "vehicle")), "configuration")
        limits = read.get("vehicle", read)
    elif vehicle is not None:
        check_sections({"vehicle": vehicle})
        limits = dict(vehicle)
    settings = merged(dem, {"vehicle": limits, "risk": risk})
    built: Any = config.build(settings)
    args = {"vehicle": built.vehicle.model_dump(mode="json", exclude={"name"})}
    given = bundle_of(dem, locus_stage.locus_stage, ("elevation",), "rille.terrain", {})
    if "reference" in given.meta:
        text = "the elevations are distances from a plane that is no ground, so nothing can drive there"
        raise InputError("RIL-386", text, remedy="if it is ground, state its normal as world.up in the manifest")
    hazards = risk_stage.risk_stage.run(built.risk, args, {"dem": [given]})
    return dataset_of(risk_stage.risk_stage, hazards, settings)


def path(
    hazards: xarray.Dataset,
    goal: tuple[float, float] | None = None,
    start: tuple[float, float] | None = None,
    **path: Any,
) -> xarray.Dataset:
    """Plan a path of least height differences that keeps the vehicle off hazards.

    Parameters
    ----------
    hazards
        Of :func:`hazards`, whole; what :meth:`xarray.Dataset.where` masks is unknown.
    goal, start
        (x, y), metres, in the frame of the elevation model; None: as far ahead as the ground is known and safe, from
        the rows nearest to the camera.
    path
        Parameters of section ``path``.

    Returns
    -------
    xarray.Dataset
        ``path`` (vertex, xyz), float64 metres, in the frame of the elevation model: positions of the vehicle's middle
        from start to goal, z the mean height under a wheel. Where there is none it is empty, and the attribute
        ``reason`` says why.

    Raises
    ------
    InputError
        Goal or start lies outside the map, in a hazard or on unknown ground.
    ConfigError
        A parameter is unknown, or not permitted.

    Examples
    --------
    >>> import rille
    >>> small = {"frames": 1, "image_width": 190, "image_height": 174, "focal_length": 200}
    >>> pair = rille.open("mockup-short", mockup=small)[0]
    >>> dem = rille.terrain(rille.match(pair.left, pair.right, preset="fast"), pair, cell_size=0.005)
    >>> rover = {"wheel_diameter": 0.02, "track": 0.04, "wheel_base": 0.04, "clearance": 0.02, "max_step": 0.015}
    >>> hazards = rille.hazards(dem, vehicle={**rover, "max_slope_deg": 30, "max_roughness": 0.01, "margin": 0.0})
    >>> found = rille.path(hazards, start=(0.05, 0.5), goal=(0.195, 0.63), p_certain_hazard=0.5)
    >>> found.path[-1].values.round(2)[:2].tolist()
    [0.2, 0.63]
    """
    prepare_environment()
    from rille.stages.hazard import risk as risk_stage
    from rille.stages.planning import path as path_stage

    ends = {name: end for name, end in (("target", goal), ("start", start)) if end is not None}
    settings = merged(hazards, {"path": {**path, **ends}})
    built: Any = config.build(settings)
    needs = "risk", "reason", "elevation"
    given = bundle_of(hazards, risk_stage.risk_stage, needs, "rille.hazards", risk_stage.NOTHING)
    asked = built.path.start is not None or built.path.target is not None
    planned = path_stage.path_stage.run(built.path, {} if asked else {"use": "local"}, {"risk": given})
    return dataset_of(path_stage.path_stage, planned, settings)
