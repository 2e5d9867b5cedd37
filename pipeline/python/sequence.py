"""A stereo sequence, its pairs and their images, read or rendered in this process."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from rille.datasets import registry
from rille.datasets.images.files import sound
from rille.datasets.protocol import CAMERAS, Sequence
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.runtime.environment import prepare_environment
from rille.pipeline.engine.task import map_ports
from rille.pipeline.flow import config
from rille.pipeline.python.arguments import Settings, assignments, place_of
from rille.pipeline.python.datasets import carried
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import ConfigError, InputError
from rille.stages.geometry.geometry import Rig

if TYPE_CHECKING:
    import xarray

    from rille.pipeline.flow.builders import Builder

Known = dict[Handle, Bundle]


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
        image = computed(builder(self, self.settings).raw_image(self.frame, camera), {}, self.sequence.drawn)
        return np.array(image["image"])

    @property
    def settings(self) -> dict[str, Any]:
        """Parameters that suit the sequence, by section; those given to a function come before them."""
        return config.suited(self.sequence.source)

    def _image(self, camera: str) -> xarray.DataArray:
        import xarray

        image = image_of(self, camera)
        valid = image.arrays.get("valid")
        return xarray.DataArray(
            np.array(image["image"]),  # a copy: what a user draws into it must not reach the next step
            dims=("row", "col"),
            coords={} if valid is None else {"valid": (("row", "col"), np.asarray(valid))},
            name=f"{camera}_image",
            attrs={
                "units": "1",
                "long_name": f"{camera} image of pair {self.frame}",
                **carried({}, self.settings, [checksum(self, camera)]),
            },
        )


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


def image_of(pair: StereoPair, camera: str) -> Bundle:
    """Result of the stage that makes an image."""
    return computed(builder(pair, pair.settings).image(pair.frame, camera), {}, pair.sequence.drawn)


def checksum(pair: StereoPair, camera: str) -> int:
    """Checksum of an image, by which a disparity of others is known."""
    return zlib.crc32(np.asarray(image_of(pair, camera)["image"]).tobytes())


def builder(pair: StereoPair, settings: Settings) -> Builder:
    """Lays out the tasks of a pair."""
    prepare_environment()
    from rille.pipeline.flow.builders import Builder

    return Builder(Graph(), pair.sequence.source, config.build(settings))


def computed(handle: Handle, known: Known, drawn: dict[str, Bundle]) -> Bundle:
    """Result of a task; of those that it needs what is ``known``, or an image that was ``drawn`` before, is taken."""
    if handle in known:
        return known[handle]
    # Images are kept: left and right of one pair, and every step of it, ask for them again.
    spec, recorded = handle.spec, handle.spec.module.startswith("rille.datasets.")
    if recorded and handle.label in drawn:
        return drawn[handle.label]
    inputs = map_ports(lambda source: computed(source, known, drawn), handle.inputs)
    result = known[handle] = spec.stage.run(spec.params, {**spec.args, **spec.hints}, inputs)
    if recorded:
        drawn[handle.label] = sound(result, handle.spec.hints.get("path", ""))
    return result
