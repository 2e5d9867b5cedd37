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

import json
import os
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field, replace
from os.path import expanduser
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import tomli_w
from numpy.typing import NDArray

from rille.datasets import registry
from rille.datasets.images.files import sound
from rille.datasets.protocol import CAMERAS, Sequence
from rille.datasets.text.reading import read_toml
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.runtime.environment import prepare_environment
from rille.pipeline.engine.spec import map_ports
from rille.pipeline.engine.store.cf_coordinates import DIMS, coordinates, lattice_of
from rille.pipeline.flow import config
from rille.stages.core.declare import AnyArray, Array, Bundle, Stage
from rille.stages.core.errors import ConfigError, InputError, warning
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Rig

if TYPE_CHECKING:
    import xarray

    from rille.pipeline.flow.builders import Builder

Settings = Mapping[str, Any]
Known = dict[Handle, Bundle]


ELSEWHERE: Mapping[str, str] = {
    "column_disparity": "; disparities of another program are read by [disparity] of a manifest",
    "elevation": "; rille.reconstruct(..., vehicle={...}) judges the terrain of a run anew",
}
"""Where data of another origin than the step before are taken, by the variable of that step."""


@dataclass(frozen=True)
class StereoSequence:
    """A calibrated stereo sequence; ``sequence[k]`` is its pair number k, from 0, ``len(sequence)`` how many there are.

    ``sequence[START:STOP]`` and a loop give pairs whose images can be used; of any other pair ``sequence[k]`` raises
    ``InputError`` with the cause.

    Attributes
    ----------
    drawn : images that were read or rendered already, by label.
    """

    source: Sequence
    drawn: dict[str, Bundle] = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        return f"<StereoSequence {self.name}: {len(self)} pairs>"

    def __reduce__(self) -> tuple[Callable[..., StereoSequence], tuple[str, ...]]:
        # How its images come about cannot be pickled; another process opens it anew.
        return _reopened, self.source.opened

    @property
    def name(self) -> str:
        """Short name, also of the folder of its runs."""
        return self.source.name

    @property
    def rig(self) -> Rig:
        """The cameras, without lens distortion, and how they stand to each other, as given.

        ``rig.left`` and ``rig.right`` have ``fx``, ``fy``, ``cx``, ``cy``, ``width`` and ``height`` (px);
        ``rig.T_right_left`` maps the left camera's frame to the right one's (x right, y down, z ahead, m), and
        ``rig.baseline`` is their distance (m).
        """
        return self.source.rig

    def __len__(self) -> int:
        return self.source.frames

    @overload
    def __getitem__(self, frame: int) -> StereoPair: ...
    @overload
    def __getitem__(self, frame: slice) -> list[StereoPair]: ...
    def __getitem__(self, frame: int | slice) -> StereoPair | list[StereoPair]:
        try:
            number = range(len(self))[frame]
        except IndexError:
            raise IndexError(f"pair {frame} of {len(self)}") from None
        except (TypeError, ValueError):
            text = f"{frame!r:.80} is no number of a pair"
            raise InputError("RIL-747", text, remedy="give a whole number, or START:STOP[:STEP]") from None
        if isinstance(number, range):
            return [StereoPair(self, k) for k in number if k not in self.source.lost]
        if number in self.source.lost:
            text = f"frame {number} of {self.name}: {self.source.lost[number]}"
            raise InputError("RIL-863", text, remedy="take another frame")
        return StereoPair(self, number)

    def __iter__(self) -> Iterator[StereoPair]:
        return iter(self[:])


@dataclass(frozen=True)
class StereoPair:
    """Both images of a pair, free of lens distortion, and what is known of it."""

    sequence: StereoSequence
    frame: int

    @property
    def left(self) -> xarray.DataArray:
        """Left image (row, col), grey values as :func:`match` takes them.

        Where its coordinate ``valid`` (row, col) is 0 a pixel is not used.
        """
        return self._image("left")

    @property
    def right(self) -> xarray.DataArray:
        """Right image (row, col), as :attr:`left`."""
        return self._image("right")

    def taken(self, camera: str) -> NDArray[Any]:
        """Grey values (row, col) of the image of camera ``"left"`` or ``"right"`` as taken, with its lens distortion.

        Raises
        ------
        ConfigError
            There is no such camera.
        """
        if camera not in CAMERAS:
            raise ConfigError("RIL-748", f"there is no camera {camera!r:.80}", remedy="give 'left' or 'right'")
        image = _computed(_builder(self, self.settings).raw_image(self.frame, camera), {}, self.sequence.drawn)
        return np.array(image["image"])

    @property
    def settings(self) -> dict[str, Any]:
        """Parameters that suit the sequence, by section; those given to a function come before them."""
        return config.suited(self.sequence.source)

    def _bundle(self, camera: str) -> Bundle:
        return _computed(_builder(self, self.settings).image(self.frame, camera), {}, self.sequence.drawn)

    def _image(self, camera: str) -> xarray.DataArray:
        import xarray

        image = self._bundle(camera)
        valid = image.arrays.get("valid")
        return xarray.DataArray(
            np.array(image["image"]),  # a copy: what a user draws into it must not reach the next step
            dims=("row", "col"),
            coords={} if valid is None else {"valid": (("row", "col"), np.asarray(valid))},
            name=f"{camera}_image",
            attrs={
                "units": "1",
                "long_name": f"{camera} image of pair {self.frame}",
                **_carried({}, self.settings, [self._mark(camera)]),
            },
        )

    def _mark(self, camera: str) -> int:
        """Checksum of an image, by which a disparity of others is known."""
        return zlib.crc32(np.asarray(self._bundle(camera)["image"]).tobytes())


def open(path: str | Path, **settings: Settings) -> StereoSequence:
    """Open a sequence of stereo pairs.

    Parameters
    ----------
    path
        A name from ``rille datasets list``, a folder, or a manifest.
    settings
        Parameters of the sequence by section, e.g. ``mockup={"frames": 5}``.

    Returns
    -------
    StereoSequence
        Its pairs; an image is read or rendered when it is asked for.

    Raises
    ------
    InputError
        There is no such sequence, or it cannot be used.
    ConfigError
        A parameter is unknown, or not permitted.

    Examples
    --------
    >>> import rille
    >>> sequence = rille.open("mockup-short")
    >>> len(sequence), sequence[0].left.dims
    (9, ('row', 'col'))
    """
    words = assignments(settings)
    place = place_of(path, "path")
    opened = registry.open_sequence(place, config.merge({}, settings))
    # Opened anew by another process, or after the program has changed its folder, it is the same one.
    same = place if place in (*registry.BUILT_IN, *registry.MANIFESTS) else os.path.abspath(place)
    said = (word for one in words for word in ("--set", one))
    return StereoSequence(replace(opened, opened=(same, *said)))


def _reopened(path: str, *assigned: str) -> StereoSequence:
    """The sequence of ``Sequence.opened``: its path, and its settings as ``--set section.key=value``."""
    return open(path, **config.parse_assignments(assigned[1::2]))


def place_of(path: object, name: str) -> str:
    """A name or path as a command line has it, from argument ``name``; what can be none is refused."""
    if not isinstance(path, str | Path) or "\0" in str(path):
        remedy = "give a text or a Path"
        if name == "seq":
            remedy += ", or what rille.open returns, with frames='START:STOP' for a part of it"
        raise InputError("RIL-970", f"{name}={path!r:.80} is no name or path", remedy=remedy)
    return expanduser(path)


def check_sections(settings: Mapping[str, object]) -> None:
    """Refuse a parameter that is given without its section."""
    for section, values in settings.items():
        if not isinstance(values, Mapping):
            text = f"{section}={values!r} is no section of parameters"
            raise ConfigError("RIL-861", text, remedy='give them by section, e.g. locus={"cell_size": 0.002}')


def assignments(settings: Mapping[str, Settings]) -> list[str]:
    """Return the same settings as assignments for ``--set``.

    >>> assignments({"locus": {"cell_size": 0.002, "both": True}, "drive": {"goal": (0.1, 2.0)}})
    ['locus.cell_size=0.002', 'locus.both=true', 'drive.goal=[ 0.1, 2.0, ]']
    """
    words = []
    check_sections(settings)
    for section, values in config.merge({}, settings).items():
        for name, value in values.items():
            try:
                lines = tomli_w.dumps({"v": value}).removeprefix("v = ").splitlines()
            except TypeError:
                text = f"{section}.{name} = {value!r} is no value of TOML"
                remedy = "give a number, a text, True or False, or a list of these; or leave it out"
                raise ConfigError("RIL-866", text, remedy=remedy) from None
            # Only a list has several lines: the line feed of a text is escaped.
            words.append(f"{section}.{name}={' '.join(line.strip() for line in lines)}")
    return words


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
        ``validity`` the bit 1 is set where a pixel was matched, 2 where it was interpolated.

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
    from rille.pipeline.runs.doubts import doubts, levelled
    from rille.stages.hfvm.stage import facts, hfvm_stage, match_pyramids
    from rille.stages.imaging import pyramid

    carried, marks = _settings(left), [mark for image in (left, right) for mark in _noted(image).get("images", [None])]
    built: Any = config.build(carried, {"hfvm": hfvm})
    left, right = map(_rows_first, (left, right))
    images = [_pixels(image) for image in (left, right)]
    for camera, image in zip(CAMERAS, images, strict=True):
        if image.dtype.kind in "OSU":  # a path, or nothing
            text = f"the {camera} image is {image.reshape(-1)[:1].tolist()}, no array of pixels"
            raise InputError("RIL-675", text, remedy="read files first: cv2.imread(NAME, cv2.IMREAD_GRAYSCALE), say")
        if image.dtype.kind == "f":
            low, high = float(np.nanmin(image, initial=0)), float(np.nanmax(image, initial=0))
            # From 0 to 1, or with the mean removed and the deviation made 1; 16 bits in floating point.
            if 0 < high <= 1 or (low < 0 and high - low < 16) or high > 2 * 255:
                text = f"the {camera} image's values lie from {low:.3g} to {high:.3g}: {image.dtype} is taken as 0..255"
                raise InputError("RIL-973", text, remedy="scale them to 0..255")
    # Images of a sequence are spread as its others are.
    images, spread = (images, list[str]()) if "valid" in getattr(left, "coords", ()) else levelled(images)
    valid = [_valid(image) for image in (left, right)]
    first, second = (pyramid.build(image, built.pyramid, mask) for image, mask in zip(images, valid, strict=True))
    options = tiles.match_options(built.tiling, built.hfvm, built.pyramid, (images[0].shape, images[1].shape))
    disparity = match_pyramids(first, second, built.hfvm, options=options)
    meta = facts(disparity.arrays, built.hfvm, disparity.unlike, int(np.count_nonzero(first.valid[0])))
    for line in (*spread, *doubts(disparity, *images, closely=False)):
        warnings.warn(line, stacklevel=2)
    return _dataset(hfvm_stage, Bundle(disparity.arrays, meta), config.merge(carried, {"hfvm": hfvm}), marks)


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
    built: Any = config.build(_merged(disparity, pair.settings, {}))
    std = np.full(given["validity"].shape, built.locus.sigma_disparity)
    found = points_of(replace(given, arrays={"disparity_std": std, **given.arrays}), pair.sequence.rig, int(every))
    return xarray.Dataset(
        {
            "position": (("point", "xyz"), found.position, {"units": "m", "frame": "left camera"}),
            "sigma_along": ("point", found.sigma_along, {"units": "m"}),
            "sigma_across": ("point", found.sigma_across, {"units": "m"}),
            "colour": (("point", "rgb"), colours(found.pixel, pair._bundle("left"))),
            "pixel": (("point", "uv"), found.pixel, {"units": "px"}),
        }
    )


def _disparity(disparity: xarray.Dataset, pair: object) -> Bundle:
    """The result of the matcher, if it has the size of the pair's images; what is unknown in it is not matched."""
    from rille.stages.hfvm.stage import hfvm_stage

    if not isinstance(pair, StereoPair):
        text = f"pair is a {type(pair).__name__}"
        raise InputError("RIL-674", text, remedy="give one pair of a sequence: rille.open(...)[0]")
    given = _bundle(disparity, hfvm_stage, ("column_disparity", "row_disparity"), "rille.match")
    size = pair.sequence.rig.left.height, pair.sequence.rig.left.width
    if disparity.column_disparity.shape != size:
        text = f"disparity of {disparity.column_disparity.shape} pixels, the pair's images have {size}"
        raise InputError("RIL-865", text, remedy="give the disparity that rille.match finds for this pair")
    for camera, mark in zip(CAMERAS, _noted(disparity).get("images", ()), strict=False):
        if mark is not None and mark != pair._mark(camera):  # None: of an array of the user's own
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
        ``locus.sigma_disparity``.
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
    settings = _merged(disparity, pair.settings, {"terrain": {"reference": reference}, "locus": locus})
    make = _builder(pair, settings)
    _, known = make.rig([pair.frame])
    at, done = vertical(make, pair.frame), {make.disparity(pair.frame): given}
    level = make.level(pair.frame, at, known)
    plane = other_plane(make.config, [_computed(level, done, pair.sequence.drawn).meta], placed=False)
    if plane is not None:
        level = make.level(pair.frame, at, known, plane)
    dem = _computed(make.pair(pair.frame, level, known, None).dem, done, pair.sequence.drawn)
    return _dataset(locus_stage.locus_stage, dem, settings)


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
    settings = _merged(dem, {"vehicle": limits, "risk": risk})
    built: Any = config.build(settings)
    args = {"vehicle": built.vehicle.model_dump(mode="json", exclude={"name"})}
    given = _bundle(dem, locus_stage.locus_stage, ("elevation",), "rille.terrain", {})
    if "reference" in given.meta:
        text = "the elevations are distances from a plane that is no ground, so nothing can drive there"
        raise InputError("RIL-386", text, remedy="if it is ground, state its normal as world.up in the manifest")
    hazards = risk_stage.risk_stage.run(built.risk, args, {"dem": [given]})
    return _dataset(risk_stage.risk_stage, hazards, settings)


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
    settings = _merged(hazards, {"path": {**path, **ends}})
    built: Any = config.build(settings)
    needs = "risk", "reason", "elevation"
    given = _bundle(hazards, risk_stage.risk_stage, needs, "rille.hazards", risk_stage.NOTHING)
    asked = built.path.start is not None or built.path.target is not None
    planned = path_stage.path_stage.run(built.path, {} if asked else {"use": "local"}, {"risk": given})
    return _dataset(path_stage.path_stage, planned, settings)


# -- tasks in this process ----------------------------------------------------------------------------------------


def _builder(pair: StereoPair, settings: Settings) -> Builder:
    prepare_environment()
    from rille.pipeline.flow.builders import Builder

    return Builder(Graph(), pair.sequence.source, config.build(settings))


def _computed(handle: Handle, known: Known, drawn: dict[str, Bundle]) -> Bundle:
    """Result of a task; of those that it needs what is ``known``, or an image that was ``drawn`` before, is taken."""
    if handle in known:
        return known[handle]
    # Images are kept: left and right of one pair, and every step of it, ask for them again.
    spec, recorded = handle.spec, handle.spec.module.startswith("rille.datasets.")
    if recorded and handle.label in drawn:
        return drawn[handle.label]
    inputs = map_ports(lambda source: _computed(source, known, drawn), handle.inputs)
    result = known[handle] = spec.stage.run(spec.params, {**spec.args, **spec.hints}, inputs)
    if recorded:
        drawn[handle.label] = sound(result, handle.spec.hints.get("path", ""))
    return result


# -- datasets -----------------------------------------------------------------------------------------------------


def _carried(meta: Settings, settings: Settings, images: Series[int | None] = ()) -> dict[str, str]:
    """Attribute for the next step; ``images``: checksums of one image, or of the left and the right one."""
    return {"rille": json.dumps({"meta": dict(meta), "settings": dict(settings), "images": images})}


def _noted(data: Any) -> dict[str, Any]:
    """What the step before has :func:`_carried`."""
    try:
        noted = json.loads(getattr(data, "attrs", {}).get("rille", "{}"))
    except (TypeError, ValueError):  # of the user's own
        noted = {}
    return noted if isinstance(noted, dict) else {}


def _settings(data: Any) -> dict[str, Any]:
    return dict(_noted(data).get("settings", {}))


def _merged(data: xarray.Dataset, *more: Settings) -> dict[str, Any]:
    """Settings of the step before, and what is given now over them."""
    settings: dict[str, Any] = {}
    # Later layers win: settings of the sequence, settings of the step before, settings of this call.
    for layer in (*more[:-1], _settings(data), more[-1]):
        config.merge(settings, layer)
    return settings


def _bundle(
    data: xarray.Dataset, stage: Stage, needs: Series[str], maker: str, nothing: Mapping[str, int] | None = None
) -> Bundle:
    """What a step before has made by ``stage``.

    ``needs``: variables without which the next step cannot be; the first tells the datasets of ``stage`` from those of
    others. ``nothing``: values of whole numbers where a mask hides them, 0 where none is named; None: the next step
    needs none of the facts that :func:`_carried` attaches.
    """
    given = getattr(data, "data_vars", ())
    bands = [array for array in stage.outputs if array.name in given]
    lacking = [name for name in needs if name not in given]
    lacking += [f"{b.name} ({', '.join(b.dims)})" for b in bands if data[b.name].dims != b.dims]
    meta = _noted(data).get("meta", {})
    if not (lacking or meta or nothing is None):
        lacking = ["attribute rille"]
        remedy = f"where xarray has dropped it, data.attrs = MADE.attrs, with MADE what {maker} returned, restores it"
    else:
        remedy = f"give what {maker} returns, whole"
    lattice = None if lacking else lattice_of(meta)
    # Cut, turned or thinned out, the values would be taken for those of other places.
    places = {} if lattice is None else coordinates(lattice, "")
    same = (name in data.coords and np.array_equal(data[name], values) for name, (values, _, _) in places.items())
    lacking += [] if all(same) else ["x and y of all its cells, as they were"]
    if lacking:
        elsewhere = ELSEWHERE.get(needs[0], "")
        raise InputError("RIL-864", f"the dataset has no {lacking[0]}", remedy=f"{remedy}{elsewhere}")
    hidden = nothing or {}
    return Bundle({b.name: _as_declared(b, np.asarray(data[b.name]), hidden.get(b.name, 0)) for b in bands}, meta)


def _as_declared(about: Array, values: AnyArray, nothing: int) -> AnyArray:
    """Values of the declared type, ``nothing`` where a mask over the whole dataset hides whole numbers by NaN."""
    dtype = np.dtype(about.dtype)
    if values.dtype.kind in "biuf":
        shown = np.where(np.isnan(values), nothing, values) if dtype.kind != "f" else values
        with np.errstate(invalid="ignore"):
            made = shown.astype(dtype)
        if dtype.kind == "f" or np.array_equal(made, shown):
            return made
    text = f"{about.name} is {values.dtype} with other values than {dtype} has"
    remedy = f"mask it by a whole number, e.g. data.assign({about.name}=data.{about.name}.where(mask, 0))"
    raise InputError("RIL-971", text, remedy=remedy)


def _dataset(stage: Stage, result: Bundle, settings: Settings, images: Series[int | None] = ()) -> xarray.Dataset:
    """Arrays with the dimensions, units and words that the stage declares, and coordinates of their lattice."""
    import xarray

    variables, lattice = {}, lattice_of(result.meta)
    for name, values in result.arrays.items():
        about = next(array for array in stage.outputs if array.matches(name))
        attrs = {"units": about.unit, "long_name": about.long_name}
        variables[name] = (about.dims, np.asarray(values), attrs)
    on_it = lattice is not None and any(list(dims) == DIMS for dims, _, _ in variables.values())
    places = coordinates(lattice, str(result.meta.get("frame", "local"))) if lattice is not None and on_it else {}
    coords = {name: (dims, values, attrs) for name, (values, dims, attrs) in places.items()}
    plain = {k: v for k, v in result.meta.items() if isinstance(v, str | int | float) and not isinstance(v, bool)}
    return xarray.Dataset(variables, coords, {**plain, **_carried(result.meta, settings, images)})
