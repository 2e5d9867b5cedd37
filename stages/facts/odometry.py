"""Facts of the stages between the images and the trajectory."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts


class MotionFacts(Facts):
    """Coarse displacements, px of level 0 (None: nothing matches), and shares of the pixels with texture;
    ``turn_found_deg`` of the image, where one was undone."""

    level: int
    median_length: float | None
    match_rate: float | None
    overlap: float | None
    turn_found_deg: float


class StepTableFacts(Facts):
    """``side`` of a block, px."""

    side: float


class ScreeningFacts(Facts):
    """Frames that the trajectory goes through, and those that it does not.

    ``asks``: facts still needed, by ``bridges`` (pairs of frames) and ``sides`` (frames); if both are empty the rest is
    final. ``lost`` are frame and cause, ``late`` those of them whose left and right are not of one time, ``unfit``
    frames that may not be basic, ``match_rate`` the shares along the ``chain``.
    """

    asks: dict[str, list[Any]]
    chain: list[int]
    lost: list[dict[str, Any]]
    late: NotRequired[list[int]]
    unfit: list[int]
    match_rate: list[float | None]


class KeyframesFacts(Facts):
    """Places in the chain that are ``basic``, and the ``segments`` between them (places).

    ``why`` and ``overlap`` are of each basic pair, ``displacement`` (px, None: not known) and ``match_rate`` of each
    step.
    """

    basic: list[int]
    segments: list[list[int]]
    overlap: list[float | None]
    why: list[str]
    displacement: list[float | None]
    match_rate: list[float | None]


class TrackFacts(Facts):
    """Numbers of the ``frames`` of a segment."""

    frames: list[int]


class ResectFacts(Facts):
    """Poses of a segment's frames.

    ``per_frame``: frame, landmarks, inliers, rms_px of each, why it is ``lost``, and ``bias_px``, an error of all
    disparities with which it has a pose. ``intrinsics``: what the segment, adjusted jointly, says of errors of the
    calibration (:class:`rille.stages.odometry.resection.calibration_errors.IntrinsicsPart`, ``turn_deg``), and the
    ``bias_px`` of its disparities; empty where nothing was adjusted.
    ``jump`` (column, row, px) and ``knocked``: the rig moved before the pair at the segment's end. ``torn``: share of
    that pair's disparities that depart otherwise than the others. ``distance_px``: error of all disparities by which
    landmarks are at wrong distances, as that pair shows it.
    """

    per_frame: list[dict[str, Any]]
    intrinsics: dict[str, Any]
    jump: NotRequired[list[float]]
    knocked: NotRequired[str]
    torn: NotRequired[float]
    distance_px: NotRequired[float]


class IntrinsicsFacts(Facts):
    """``errors`` of the calibration, each with its sigma, and the ``covariance`` of those that poses keep; those that
    are ``held`` by the calibration as given, since the sequence shows them little; the rig's ``yaw`` and its sigma,
    rad; the ``correction`` that the tracks ask for (else 0) of focal length and principal point, over the focal length,
    and of the yaw; and how the calibration that was given is ``corrected`` with that and those before."""

    errors: dict[str, list[float]]
    covariance: list[list[float]]
    held: list[str]
    yaw: list[float]
    correction: list[float]
    corrected: list[float]
    inverse_depth_std: NotRequired[float]
    """Of the error that all inverse depths share by the yaw of a rig that was repaired, 1/m."""


class LoopFacts(Facts):
    """Motions to a basic pair from earlier ones; ``refused`` are frames that look alike, and the ``reason``.

    Each of the ``factors`` has the numbers of two frames, ``from`` and ``to``; ``pose``, twelve numbers of T_from_to
    (left cameras, m); ``covariance``, 36 numbers of (position m, rotation rad) in the frame of the first; and
    ``source``, in words.
    """

    factors: list[dict[str, Any]]
    refused: list[dict[str, Any]]


class PlacesFacts(Facts):
    """Numbers of a block's basic ``pairs``, and for each the earlier ones that are most alike, ``candidates``."""

    pairs: list[int]
    candidates: list[list[int]]


class TrajectoryFacts(Facts):
    """Poses of all frames in the world, which is that of piece number ``main``.

    Where it was adjusted (stage ``adjust``) ``excess`` is the factor by which the chain's errors exceed the covariances
    that were stated for it, and ``priors`` tells of each other sensor whether it was used, of how many measurements
    were left out, and its clock.
    """

    frames: list[int]
    inliers: list[int]
    positions: list[list[float] | None]
    """x, y, z of each frame, m; None: lost."""
    verticals: list[str]
    """Source of the vertical of each piece."""
    pieces: list[list[int]]
    """Frames of each."""
    main: int
    causes: dict[str, str]
    """Why frames, by their numbers, are lost or begin a piece, where that is known."""
    odd_verticals: list[str]
    """Lines, among the warnings, on pieces whose vertical is not that of the ground of most pairs."""
    excess: NotRequired[float]
    priors: NotRequired[dict[str, Any]]


class MovingFacts(Facts):
    """``share`` of the left image's pixels that moved by themselves."""

    share: float
