"""Facts of the stages between disparities and the merged terrain."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts

Json = dict[str, Any]


class GroundFacts(Facts):
    """Local frame and reference plane of one pair, in the local frame.

    Where no ground is seen, ``no_ground`` says why, and what describes it is None, except ``cell_size``; ``plane`` and
    ``relief`` are there where larger cells may show it, and where the reference is a plane that is no ground.
    """

    T_local_left: list[float]
    """3 x 4 numbers, row by row."""
    source: str
    """Of the vertical; ``none``: unknown, z is the camera's own up; ``reference plane``: z is its normal."""
    plane: list[float] | None
    """(a, b, c) of z = c + a x + b y."""
    relief: list[float] | None
    """Lowest and highest terrain against the plane, m."""
    cell_size: float
    """m, that suits the rig."""
    footprint: list[float] | None
    """x_min, x_max, y_min, y_max, m, for that cell."""
    ground_share: float
    """Of the sampled pixels, on the reference plane; of a stated one 0."""
    ground_reach: NotRequired[float]
    """Camera heights up to which nine tenths of the pixels on the ground are seen."""
    max_sigma: NotRequired[float]
    """Largest standard deviation, m, of elevations above a plane that is no ground."""
    no_ground: NotRequired[str]
    matched_below: NotRequired[float]
    """Share of matched pixels in the lowest quarter of the left image, where no ground is seen."""
    other_up: NotRequired[list[float]]
    """Normal, in the left camera's frame, of a plane that most pixels lie on and that is no ground by its attitude."""
    why: NotRequired[str]
    """The reference is a plane that is no ground, though none was asked for."""
    seen_up: NotRequired[list[float]]
    """Up, in the left camera's frame, by ground that is seen but contradicts the given vertical."""


class RasterFacts(Facts):
    """Arrays on a ``lattice`` (its ``to_dict``) of a ``frame``."""

    lattice: Json
    frame: str
    reference: NotRequired[str]
    """There where elevations are distances from a plane that is no ground."""


class DemFacts(RasterFacts):
    """Elevation model of a basic ``pair``."""

    pair: int
    z_range: NotRequired[list[float]]
    T_frame_left: NotRequired[list[float]]
    pixel_rad: NotRequired[float]
    """Angle of a pixel, rad."""
    defined: NotRequired[float]
    """Share of the cells."""
    median_elevation_std: NotRequired[float | None]
    """m"""
    coverage: NotRequired[Json]
    """Which matched pixels the map of a pair lacks: see :func:`rille.stages.terrain.locus.coverage.coverage`."""
    pose_covariance: NotRequired[list[float]]
    """6 x 6 numbers, row by row: of position, m, and rotation, rad, in the world."""


class MergeFacts(RasterFacts):
    """Merged tile: its ``pairs``, and the ``defined`` share of its cells."""

    pairs: list[int]
    defined: float


class BoundsFacts(RasterFacts):
    """Bounds of the height of the ground."""


class OverlapFacts(Facts):
    """``seams`` of a ``pair`` with earlier ones: see :func:`rille.stages.terrain.overlap_qa.seam`."""

    pair: int
    seams: list[Json]


class AuditFacts(Facts):
    """``models``, the worst first (see :func:`rille.stages.terrain.overlap_audit.audit`), and the worst ``seams``."""

    models: list[Json]
    seam_count: int
    seams: list[Json]


class RadiometryFacts(Facts):
    """Whole ``steps`` of log-exposure that each model's grey values are raised by."""

    steps: dict[str, int]


class TileIndexFacts(Facts):
    """``tiles`` (column, line, and the model's first column, first line, columns, lines there) that a model touches."""

    pair: int
    cell: float
    box: Json | None
    """Lattice of the defined cells."""
    tiles: list[list[int]]


class MapFixFacts(Facts):
    """First pose in a global map, and how sure it is; one that was handed in has a ``source`` alone."""

    T_global_local: list[float]
    source: str
    std: NotRequired[list[float]]
    """x, y, z, m, and rotation about them, rad."""
    fit: NotRequired[Json]
    """Figures of :class:`rille.stages.terrain.map_localization.Placement`, of elevations."""
