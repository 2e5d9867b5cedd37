"""Reconstruct from Python: the same tasks, cache and files as ``rille reconstruct``.

A program that starts workers needs the usual ``if __name__ == "__main__":`` around what it does.
"""

from __future__ import annotations

import json
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from rille.datasets.text.reading import TABLE, read_lines, read_text
from rille.pipeline.engine.failures import translated
from rille.pipeline.engine.runtime.environment import prepare_environment
from rille.pipeline.python.arguments import Settings, assignments, place_of
from rille.pipeline.python.sequence import StereoSequence
from rille.pipeline.runs import lookup
from rille.stages.core.errors import InputError, RilleError

if TYPE_CHECKING:
    import xarray

AXES = ("x", "y", "z")
T = TypeVar("T")


def reconstruct(
    seq: StereoSequence | str | Path,
    client: Any = None,
    *,
    frames: str | None = None,
    runs: str | Path = "runs",
    cache: str | Path | None = None,
    executor: str = "dask",
    quiet: bool = False,
    **settings: Settings,
) -> Run:
    """Run the whole chain, or what of it is not cached yet, and write its files and its report.

    Parameters
    ----------
    seq
        An open sequence, or what :func:`rille.open` takes.
    client
        ``distributed.Client`` of the cluster that computes; None: workers of this machine, one a core.
    frames
        ``START:STOP[:STEP]``, numbers from 0, without STOP; all by default.
    runs
        Folder of the results.
    cache
        Folder of the artifacts; ``RILLE_CACHE`` or ``.rille/cache`` by default.
    executor
        ``"dask"``, ``"inline"`` (in this process) or the address of a dask scheduler, where there is no client.
    quiet
        Show no progress; the closing line and what is missing are printed all the same.
    settings
        Parameters by section, e.g. ``locus={"cell_size": 0.002}``.

    Returns
    -------
    Run
        The results. If something could not be delivered, ``run.complete`` is false, and ``run.missing`` says what.

    Raises
    ------
    RilleError
        The input, a parameter or the machine does not permit it; the message says what, where, and what to do.

    Examples
    --------
    >>> import rille, tempfile
    >>> small = {"frames": 2, "image_width": 190, "image_height": 174, "focal_length": 200.0}
    >>> sequence, locus = rille.open("mockup-short", mockup=small), {"cell_size": 0.005}
    >>> with tempfile.TemporaryDirectory() as runs:  # doctest: +ELLIPSIS
    ...     run = rille.reconstruct(sequence, runs=runs, cache=f"{runs}/cache", executor="inline", locus=locus)
    ...     again = rille.open_run(run.folder)
    ...     print(again.trajectory.sizes["frame"], again.terrain.elevation.units)
    /...computed..., cached 0, missing ...
    2 m
    """
    prepare_environment()
    from rille.pipeline.runs import session
    from rille.pipeline.runs.options import Options

    given = seq.source if isinstance(seq, StereoSequence) else place_of(seq, "seq")
    options = Options(
        assignments=tuple(assignments(settings)),
        frames=frames,
        executor=executor if client is None else client,
        runs=Path(place_of(runs, "runs")),  # no shell has seen a ~ of a notebook
        cache=None if cache is None else place_of(cache, "cache"),
        quiet=quiet,
    )
    with _translating():
        result = session.perform(given, options)
    result.print()
    # Absolute: the program may change its folder, or send the run to another.
    return Run(result.folder.resolve())


def reconstruct_many(
    seqs: Iterable[StereoSequence | str | Path], client: Any = None, **same: Any
) -> list[Run | RilleError]:
    """Reconstruct sequences one after another; of each the run, or the error that ended it.

    Parameters
    ----------
    seqs
        Each as for :func:`reconstruct`.
    client
        ``distributed.Client`` of the cluster that computes all of them.
    same
        What :func:`reconstruct` takes, for all of them.

    Returns
    -------
    list
        Of each sequence, in their order, the :class:`Run`, or the ``RilleError`` that ended it; none is raised.

    Examples
    --------
    >>> import rille
    >>> [type(one).__name__ for one in rille.reconstruct_many(["no/such/folder", "none"])]
    ['InputError', 'InputError']
    """
    ended: list[Run | RilleError] = []
    for seq in [seqs] if isinstance(seqs, str | StereoSequence) or not isinstance(seqs, Iterable) else seqs:
        try:
            ended.append(reconstruct(seq, client, **same))
        except RilleError as error:
            ended.append(error)
    return ended


def open_run(path: str | Path, runs: str | Path = "runs") -> Run:
    """Open the results of a run.

    Parameters
    ----------
    path
        Its folder, or as a command takes it: ``SEQUENCE`` (the latest of it), ``SEQUENCE/ID``, ``ID``, ``latest``.
    runs
        Folder of all runs.

    Returns
    -------
    Run
        The results; files are read when they are asked for.

    Raises
    ------
    ConfigError
        There is no such run.

    Examples
    --------
    >>> import rille
    >>> rille.open_run("mockup-shrot", runs="no/such/folder")
    Traceback (most recent call last):
    rille.stages.core.errors.ConfigError: no run 'mockup-shrot': no/such/folder holds none
    """
    with _translating():
        return Run(lookup.find(place_of(path, "path"), Path(place_of(runs, "runs"))))


@contextmanager
def _translating() -> Iterator[None]:
    """Turn errors of the system, such as a full disk, into those of Rille: `except RilleError` shall catch them."""
    try:
        yield
    except Exception as error:
        if (known := translated(error)) is None or known is error:
            raise
        raise known from error


@dataclass(frozen=True)
class Run:
    """The results of a run, in its ``folder``; each is read when it is asked for."""

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(place_of(self.folder, "folder")))

    @cached_property
    def report(self) -> Mapping[str, Any]:
        """All facts of the report (``report.json``)."""
        with self._reading():
            return dict(self._json("report.json"))

    @property
    def complete(self) -> bool:
        """Whether nothing of the reconstruction is missing; that there is no path, say, is an answer.

        A drive is complete where it reached its goal.
        """
        return self._fact("complete", bool)

    @property
    def missing(self) -> list[Mapping[str, str]]:
        """What could not be delivered: of each ``what`` it is, ``why``, and its ``kind``, a word for programs."""
        return self._fact("missing", list)

    @property
    def tasks(self) -> list[Mapping[str, Any]]:
        """Rows of the ledger, one a task: ``label``, ``stage``, ``status``; ``key`` and ``digest`` of its result.

        A task that this run computed has ``seconds`` and more of what it took, and ``reason``: why it was not cached.
        """
        with self._reading():
            return list(lookup.tasks(self.folder).values())

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Figures by name: each has ``value``, ``unit``, ``label`` and ``how`` it is found, some the ``truth``, too."""
        return self._fact("metrics", dict)

    @property
    def terrain(self) -> xarray.Dataset:
        """The merged terrain on (y, x), m in the world frame (x right, y ahead, z up): ``elevation``, NaN unknown, ...

        ``elevation_std`` is its standard deviation, ``relief_std`` that against the ground around, ``spread`` that of
        the merged models (m); ``slope`` is in degrees, ``ortho`` a grey value 0..255, ``count`` the number of models,
        ``source`` the pair of the greatest weight. y falls: ``terrain.sel(y=slice(0.6, 0.4))``.
        ``terrain.to_netcdf(path)`` and ``terrain.to_zarr(path)`` save it.
        An array is read where it is used; ``terrain.chunk()`` makes them dask's, for terrains larger than the memory.

        Raises
        ------
        InputError
            The run has none.
        ConfigError
            It is not as Rille writes it.
        """
        import xarray

        from rille.pipeline.export.read_dem import check_group

        with self._reading():
            check_group(self.file("terrain.zarr"))
            terrain: xarray.Dataset = xarray.open_zarr(self.file("terrain.zarr"), chunks=None)
        for variable in terrain.variables.values():
            variable.attrs.pop("_CRS", None)  # GDAL's own, a mapping: NetCDF stores none; `spatial_ref` says the same
            for codec in ("compressors", "filters"):  # those of zarr 2, which `to_zarr` refuses in its own format 3
                variable.encoding.pop(codec, None)
        return terrain

    @property
    def trajectory(self) -> xarray.Dataset:
        """Poses of the left camera: ``position`` (frame, axis), metres, and ``rotation`` (frame, axis, camera_axis).

        ``rotation`` turns optical axes (x right, y down, z forward) to the world (x right, y ahead, z up); NaN where a
        frame has no pose. Coordinates are the frame's number, its ``name`` and its ``time``, seconds.

        Raises
        ------
        InputError
            The run has none.
        ConfigError
            It is not as Rille writes it.
        """
        import xarray

        with self._reading():
            lines = read_lines(self.file("trajectory.kitti"), "trajectory")
            poses = np.loadtxt(lines, ndmin=2).reshape(-1, 3, 4)
            facts = self._json("frames.json")
            frames, about = facts["frames"], facts["frames_of_reference"]["world"]
            return xarray.Dataset(
                {
                    "position": (
                        ("frame", "axis"),
                        poses[:, :, 3],
                        {"units": "m", "long_name": "centre of the left camera"},
                    ),
                    "rotation": (("frame", "axis", "camera_axis"), poses[:, :, :3], {"units": "1"}),
                },
                {
                    "frame": [frame["frame"] for frame in frames],
                    "name": ("frame", [frame["name"] for frame in frames]),
                    "time": ("frame", [frame["time"] for frame in frames], {"units": facts["units"]["time"]}),
                    "axis": list(AXES),
                    "camera_axis": list(AXES),
                },
                {"frame": about["definition"]},
            )

    def show(self) -> None:
        """Open the report in the web browser."""
        webbrowser.open(self.file("report.html").resolve().as_uri())

    def _fact(self, name: str, kind: Callable[[Any], T]) -> T:
        with self._reading():
            return kind(self.report[name])

    def _reading(self) -> AbstractContextManager[None]:
        return lookup.reading(self.folder)

    def _json(self, name: str) -> Any:
        return json.loads(read_text(self.file(name), name, TABLE))

    def file(self, name: str) -> Path:
        """Path of one of its files.

        Raises
        ------
        InputError
            The run has none of this name.
        """
        path = self.folder / name
        if not path.exists():
            text = f"{self.folder} has no {name}"
            ended = (self.folder / "report.html").exists()
            remedy = "its report says what is missing" if ended else "it did not come to its end: run its command again"
            raise InputError("RIL-862", text, remedy=remedy)
        return path
