"""Typed access to the entries of a calibration file, with errors that name the file and the key."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.cameras.model import UNKNOWN_SIZE
from rille.datasets.cameras.text import entries, parse_nested
from rille.datasets.text.reading import GREATEST, read_text
from rille.datasets.text.units import LENGTHS, unit_of, unitless
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError, within
from rille.stages.geometry.geometry import Camera, RigidTransform
from rille.stages.geometry.lens import COEFFICIENTS, Lens

CORRECT = "correct the calibration file"

MODELS: Mapping[str, str] = {
    name: model
    for model, names in {
        "": "pinhole perspective rectified",
        "none": "none nodistortion",
        "radtan": "radtan radialtangential plumbbob brown brownconrady opencv",
        "rational": "rational rationalpolynomial fullopencv radialtangential8 radtan8",
        "fisheye": "equidistant equi fisheye opencvfisheye kannalabrandt kannalabrandt4 kannalabrandt8 kb kb4 kb8",
        "realsense": "inversebrownconrady modifiedbrownconrady ftheta",
        "unread": "omni omnidirectional mei ucm eucm ds doublesphere fov atan scaramuzza fisheye62 fisheye624",
    }.items()
    for name in names.split()
}
"""Names of the lens models of :mod:`rille.stages.geometry.lens` in other programs, in small letters and digits alone.

Names of "" do not tell the distortion; those of "unread" are unsupported models, and so are those of "realsense",
unless all coefficients are 0 (its inverse model takes off by the formula that puts on elsewhere).
"""

LENS = re.compile(
    r"dist(?!an[ct]|rib|inc)|fish|lens_?(model|type|dist|par|coef|$)|cam(era)?_?\d?[._]?(model|type)"
    r"|proj(ection)?_?(model|type)|radial|tangential|prism|coef|(^|[._ ])d\d?$",
    re.I,
)
"""Keys of a lens: their value is the name of its model, or its coefficients."""

COEFFICIENT = re.compile(
    r"(^|[._ ])(k\d|p[12]|s[1-4]|xi(_?(\d|[lr]|left|right))?|tau_?[xy])$|distor|radial|tangential|coef", re.I
)
"""Keys of single coefficients: K1 and P1 may be matrices, and a single ``dist`` is a distance."""

TURN = re.compile(
    r"(?:left_|right_)?"
    r"(R|om|r_?vec|rot(ation)?_?\w*|euler\w*|rpy\w*|q|quat(ernion)?|extrinsics?|(?-i:[RT]_\w+)|toe_?in\w*|stereo_?transform\w*)",
    re.I,
)
"""Keys that say how a camera is turned."""

SENSOR = re.compile(r"imu|body|base|lidar|velo|gps|t_?b_?c", re.I)
"""Part of keys that place a camera among other sensors, which tells nothing of two cameras."""

OTHER = re.compile(r"std|deviat|sigma|err|covar|uncert|mask|file|path|name|topic|frame|unit|comment", re.I)
"""Part of keys that only look like those of a lens: of its errors, or of names."""


class Fields:
    """Entries of a calibration file by key; ``file`` is its name for errors, ``at`` the full key of a nested part.

    Attributes
    ----------
    used : full keys that a reader has read, nested ones included.
    """

    def __init__(self, values: Mapping[Any, Any], file: str, at: str = "", used: set[str] | None = None) -> None:
        self.values, self.file, self.at = {str(k): v for k, v in values.items()}, file, at
        self.used = set[str]() if used is None else used

    @staticmethod
    def read(path: Path) -> Fields:
        """Entries of a file of its own beside a calibration."""
        return Fields(parse_nested(read_text(path, "calibration"), str(path)), str(path))

    @staticmethod
    def of_lines(lines: Iterable[tuple[str, str]], file: str, at: str = "") -> Fields:
        """Entries of lines of key and value, which is a list if it has several words, perhaps in brackets."""
        rows = ((key, value.partition("//")[0].strip(" []").replace(";", " ").split()) for key, value in lines if key)
        return Fields(entries(((key, row if row[1:] else "".join(row)) for key, row in rows), file), file, at)

    def __contains__(self, key: str) -> bool:
        return self.values.get(key) is not None

    def has(self, *keys: str) -> bool:
        """Whether one of the keys is an entry."""
        return any(key in self for key in keys)

    def spelt(self, keys: Sequence[str]) -> str:
        """The first of several spellings of a key that is an entry; the first of all if none is."""
        return next((key for key in keys if key in self), keys[0])

    def error(self, code: str, key: str, what: str, remedy: str = CORRECT) -> InputError:
        """One line with the file and the full key."""
        return InputError(code, f"{self.file}: {self.at}{key} {what}", remedy=remedy)

    def get(self, key: str) -> Any:
        """A required entry."""
        if key not in self:
            raise self.error("RIL-113", key, "is missing")
        self.used.add(self.at + key)
        return self.values[key]

    def sub(self, key: str) -> Fields:
        """A nested part."""
        value = self.get(key)
        if not isinstance(value, Mapping):
            raise self.error("RIL-114", key, f"is {_shown(value)}, it should hold entries of its own")
        return Fields(value, self.file, f"{self.at}{key}.", self.used)

    def with_parts(self, prefixes: Mapping[str, str]) -> Fields:
        """Entries with those of some nested parts among them, each behind the part's prefix."""
        parts = {key: part for key in prefixes if isinstance(part := self.values.get(key), Mapping)}
        flat = {f"{prefixes[key]}{name}": value for key, part in parts.items() for name, value in part.items()}
        whole = {key: value for key, value in self.values.items() if key not in parts}
        return Fields(whole | flat, self.file, self.at, self.used)

    def text(self, key: str, default: str | None = None) -> str:
        """A word; ``default`` if the key is missing."""
        if key not in self and default is not None:
            return default
        return str(self.get(key)).strip()

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number; ``default`` if the key is missing."""
        if key not in self and default is not None:
            return default
        return self._number(key, self.get(key))

    def numbers(self, key: str, count: int | None = None) -> tuple[float, ...]:
        """A list of ``count`` finite numbers; a matrix row by row."""
        flat = flattened(self.get(key))
        if flat is None:
            raise self.error("RIL-115", key, f"is {_shown(self.values[key])}, it should be a list of numbers")
        if count is not None and len(flat) != count:
            raise self.error("RIL-116", key, f"has {len(flat)} numbers, it takes {count}")
        return tuple(self._number(key, v) for v in flat)

    def matrix(self, key: str, rows: int, columns: int) -> Floats:
        """A matrix of finite numbers."""
        return np.array(self.numbers(key, rows * columns)).reshape(rows, columns)

    def size(self, *keys: str) -> tuple[int, int]:
        """Image size, pixels, from keys of width and height, or from one of both; ``UNKNOWN_SIZE`` if none is there."""
        if not self.has(*keys):
            return UNKNOWN_SIZE
        width, height = map(self.number, keys) if keys[1:] else self.numbers(keys[0], 2)
        for key, value in (keys[0], width), (keys[-1], height):
            if value < 2 or value != int(value):
                raise self.error("RIL-122", key, f"= {value:g} is no image size in pixels")
        return int(width), int(height)

    def transform(self, rotation: str, translation: str) -> RigidTransform:
        """Rigid transform from a 3 x 3 matrix and three numbers."""
        if rotation not in self:
            self.check_turn()  # it may stand there in another form
        return self.rigid(rotation, self.matrix(rotation, 3, 3), np.array(self.numbers(translation, 3)))

    def by_quaternion(self, key: str, wxyz: Sequence[float], translation: Sequence[float]) -> RigidTransform:
        """Rigid transform of a quaternion, the scalar first, and three numbers; ``key``: of these, for errors."""
        from scipy.spatial.transform import Rotation

        if abs(np.linalg.norm(wxyz) - 1) > 0.01:
            raise self.error("RIL-767", key, f"have length {np.linalg.norm(wxyz):.4g}, it should be 1")
        # SciPy has the scalar last.
        return self.rigid(key, Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), np.array(translation))

    @property
    def unit(self) -> float:
        """Metres of the unit of length that an entry states, as ``unit: mm``; 1 if none does."""
        return LENGTHS.get(unit_of(f"[{self.text(self.spelt(('unit', 'units', 'length_unit')), '')}]"), 1.0)

    def pose(self, key: str) -> RigidTransform:
        """Rigid transform from a 4 x 4 or 3 x 4 matrix."""
        numbers = self.numbers(key)
        if len(numbers) not in (12, 16):
            raise self.error("RIL-117", key, f"has {len(numbers)} numbers, it takes a 4 x 4 matrix")
        m = np.array(numbers).reshape(-1, 4)
        if len(m) == 4 and np.abs(m[3] - [0, 0, 0, 1]).max() > 1e-9:
            raise self.error("RIL-118", key, f"has the last row {m[3].tolist()}, it should be 0 0 0 1")
        return self.rigid(key, m[:3, :3], m[:3, 3])

    def pinhole(self, key: str, size: tuple[int, int]) -> Camera:
        """Camera from a 3 x 3 matrix K."""
        k = self.matrix(key, 3, 3)
        if abs(k[0, 1]) > 1e-6 * abs(k[0, 0]) or abs(k[1, 0]) > 0 or np.abs(k[2] - [0, 0, 1]).max() > 1e-9:
            matlab = k[2, 0] and not np.triu(k, 1).any()
            remedy = "transpose it, and R: MATLAB's multiply rows" if matlab else "calibrate without skew"
            raise self.error("RIL-119", key, f"is {k.tolist()}, no matrix fx 0 cx, 0 fy cy, 0 0 1", remedy)
        return self.camera(key, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), size)

    def camera(self, key: str, values: tuple[float, float, float, float], size: tuple[int, int]) -> Camera:
        """Camera from fx, fy, cx, cy, pixels; ``key``: of these, for errors."""
        fx, fy, cx, cy = map(float, values)
        with self._within(key):
            return Camera(fx, fy, cx, cy, *size)

    def lens(self, key: str, camera: Camera, model: str, coefficients: tuple[float, ...]) -> Lens:
        """Lens with a model of :mod:`rille.stages.geometry.lens`; ``key``: of the coefficients, for errors."""
        with self._within(key):
            return Lens(camera, model, coefficients)

    def optics(
        self, pinhole: str, size: tuple[int, int], model: str = "", corner: float = 0.0, prefix: str = ""
    ) -> Lens:
        """Lens of numbers with a key each, those of the coefficients named as usual.

        Missing coefficients are 0, except for a fisheye, and if all are missing, there is no distortion.

        Parameters
        ----------
        pinhole : keys of fx, fy, cx and cy (``"f f cx cy"``), pixels.
        model : of :mod:`rille.stages.geometry.lens`; empty: radial-tangential, unless an entry names a fisheye.
        corner : pixels; 0.5 if the corner of the first pixel is at 0 in the program, 0 if its centre is.
        prefix : of all keys.
        """
        keys = [prefix + key for key in pinhole.split()]
        model = model or ("fisheye" if self.model(f"{prefix}k1") == "fisheye" else "radtan")
        fx, fy, cx, cy = (self.number(key) for key in keys)
        camera = self.camera(keys[0], (fx, fy, cx - corner, cy - corner), size)
        keys = [prefix + key for key in COEFFICIENTS[model]]
        if not self.has(*keys):
            return Lens(camera)
        values = tuple(self.number(key, None if model == "fisheye" else 0.0) for key in keys)
        return self.lens(keys[0], camera, model, values[:4] if model == "radtan" and not any(values[4:]) else values)

    def distorted(self, key: str, camera: Camera) -> Lens:
        """Lens with the coefficients listed at ``key``, if any, and the model that another key may name."""
        model, coefficients = by_count(self.numbers(key) if key in self else ())
        stated = self.model(key)
        # ROS writes five zeros for cameras without distortion, whatever the model.
        if stated == "fisheye" or (stated and any(coefficients)):
            model = stated
        if stated == "none" and not coefficients:
            model, coefficients = "radtan", (0.0,) * 4  # it is said to have none
        if model == "fisheye" and not any(coefficients[4:]):
            coefficients = coefficients[:4]  # RealSense lists five
        return self.lens(key, camera, model, coefficients)

    def model(self, coefficients: str) -> str:
        """Lens model of :mod:`rille.stages.geometry.lens` that any key names; empty if none does.

        Parameters
        ----------
        coefficients : key of their list, which is required with a model.

        Raises
        ------
        InputError
            The model is unsupported, two keys name two, or there are no coefficients.
        """
        named = {key: model for key, value in self.values.items() if (model := _named(key, value))}
        self.used |= {self.at + key for key in named}
        keys = {model: key for key, model in named.items()}
        if not _any_but_zero(flattened(self.values.get(coefficients)) or [1]):
            keys.pop("realsense", None)
        if unread := keys.get("unread", keys.get("realsense")):
            text = f"= {_shown(self.values[unread])} is a lens model that is not read"
            raise self.error("RIL-120", unread, text, "calibrate as radial-tangential or equidistant")
        if len(keys) > 1:
            text = f"name two lens models, {' and '.join(keys)}"
            raise self.error("RIL-811", " and ".join(keys.values()), text, "keep the one that was calibrated")
        model = next(iter(keys), "")
        if model not in ("", "none") and coefficients not in self:
            remedy = "check its spelling, or give zeros where there is no distortion"
            raise self.error("RIL-812", coefficients, f"is missing beside a {model} lens", remedy)
        return model

    def check_lens(self) -> None:
        """Refuse entries of a lens that were not read, without which the images would get another lens."""
        for key, value in _untaken(self.values, self.at, self.used):
            text = f"= {_shown(value)} seems to describe the lens, and is not read there"
            remedy = "state the lens by the keys of its format (e.g. distortion_model), or remove the entry"
            raise InputError("RIL-810", f"{self.file}: {key} {text}", remedy=remedy)

    def check_turn(self) -> None:
        """Refuse entries that turn a camera and were not read, without which the cameras would be parallel."""
        for key, value in self.values.items():
            numbers = flattened(value) or [value]
            # 16: of a 4 x 4 matrix; more are of the views of a chessboard.
            turns = isinstance(value, Mapping) or (len(numbers) <= 16 and _any_but_zero(numbers))
            of_camera = (turns and TURN.fullmatch(unitless(key))) or (_is_rotation(numbers) and not SENSOR.search(key))
            if of_camera and self.at + key not in self.used:
                remedy = "state it as R, a 3 x 3 matrix, with T (m), x_right = R x_left + T; or remove it"
                raise self.error("RIL-766", key, "seems to turn a camera, and is not read there", remedy)

    def _number(self, key: str, value: Any) -> float:
        try:
            # float(True) would be 1.0.
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not abs(number) < GREATEST:
            raise self.error("RIL-121", key, f"is {_shown(value)}, it should be a number below {GREATEST:g}")
        return number

    def rigid(self, key: str, rotation: Floats, translation: Floats) -> RigidTransform:
        """Rigid transform of the numbers at ``key``."""
        with self._within(key):
            return RigidTransform(rotation, translation)

    def _within(self, key: str) -> AbstractContextManager[None]:
        """Put the file and the key in front of errors raised inside."""
        return within(f"{self.file}: {self.at}{key}")


def _is_rotation(numbers: Sequence[Any]) -> bool:
    """Whether numbers, perhaps as text, are R or [R | t], rows of 3 or 4, with another R than that of equal axes."""
    try:
        m = np.array(numbers, dtype=np.float64).reshape({9: (3, 3), 12: (3, 4), 16: (4, 4)}[len(numbers)])[:3, :3]
    except (KeyError, TypeError, ValueError):
        return False
    return bool(np.allclose(m @ m.T, np.eye(3), atol=1e-3) and not np.array_equal(m, np.eye(3)))


def by_count(coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Model that OpenCV uses for a number of coefficients, and the coefficients without trailing zeros."""
    k = coefficients
    # OpenCV writes all coefficients of its largest model, with zeros for the terms that were not estimated.
    for count, fewer in ((14, 12), (12, 8)):
        if len(k) == count and not any(k[fewer:]):
            k = k[:fewer]
    if not k:
        return "none", k
    return ("radtan", k) if len(k) <= 5 else ("rational", k)


def _named(key: str, value: Any) -> str:
    """Lens model that an entry names; "unread" if it is unsupported, empty if it names none."""
    if OTHER.search(key) or isinstance(value, Mapping | list) or value is None:
        return ""
    word = re.sub(r"[^a-z0-9]|^(rs2_)?distortion[._]", "", str(value).lower())
    if "fish" in key.lower() and word in ("1", "true", "yes"):
        return "fisheye"
    if word in ("", "false", "no") or word[0].isdigit():
        return ""
    # Kalibr's command line has pinhole-equi.
    # A plain "model" may be that of the camera.
    of_lens = LENS.search(key) or (key.lower() == "model" and (word in MODELS or LENS.search(str(value))))
    model = MODELS.get(word.removeprefix("pinhole") or word, "unread")
    # With any other key only unambiguous words; short ones may mean something else.
    return model if of_lens or (word in MODELS and len(word) > 3 and model in ("fisheye", "unread")) else ""


def _any_but_zero(values: Iterable[Any]) -> bool:
    """Whether any value, perhaps as text, is a number other than 0."""
    return any(re.match(r"[-+]?[0.]*[1-9]", str(value)) for value in values)


def _untaken(values: Mapping[Any, Any], at: str, used: set[str]) -> Iterator[tuple[str, Any]]:
    """Full key and value of entries of a lens that no reader has read, except coefficients of zero."""
    for key, value in ((str(k), v) for k, v in values.items()):
        path, flat = at + key, flattened(value)
        if isinstance(value, Mapping) and flat is None:
            yield from _untaken(value, f"{path}.", used)
        elif path not in used and not OTHER.search(path):
            of_lens = (LENS if flat is not None and len(flat) > 1 else COEFFICIENT).search(key)
            if _named(key, value) or (of_lens and _any_but_zero(flat or [value])):
                yield path, value


def flattened(value: Any) -> list[Any] | None:
    """Numbers of a list, of lists in a list, or of a matrix that has ``data``; None for anything else."""
    if isinstance(value, Mapping) and "data" in value:
        return _matrix_data(value)
    if isinstance(value, np.ndarray):
        return list(value.reshape(-1).tolist())
    if not isinstance(value, list | tuple):
        return None
    parts = (flattened(one) if isinstance(one, list | tuple) else [one] for one in value)
    return [one for part in parts for one in part or []]


def _matrix_data(value: Mapping[Any, Any]) -> list[Any] | None:
    data, rows, columns = flattened(value["data"]), str(value.get("rows")), str(value.get("cols"))
    # Nine digits are enough; int() raises another error for thousands of them.
    if data is not None and rows.isdecimal() and columns.isdecimal() and int(rows[:9]) * int(columns[:9]) != len(data):
        return None
    return data


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
