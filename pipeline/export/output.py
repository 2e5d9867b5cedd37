"""Outputs: every file of a run by one record, and the task that makes it of artifacts.

A record says what the file is called, what writes it and of what, in which frame and unit its values are, and what
opens it. Writer, report, ``frames.json`` and the table in the docs read nothing else.

A file is a cached task like all others: its artifact holds its bytes, keyed by the artifacts and facts that the record
names and by the code of the module that declares it. A run's folder gets a copy: what a user does to it cannot damage
the cache, also where both are on one disk. What no input determines (times, what was computed anew) is in none of
these files: the page and ``report.json`` are rendered by each run around what is cached.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
from pydantic import BaseModel

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.runtime import atomic
from rille.stages.core.declare import Array, Bundle, Memory, NoParams, Stage
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.hazard.vehicle import Vehicle

BLOCK = 1024
"""Bytes a row of the array that holds a file: a chunk of an artifact is 1024 x 1024 then."""

CONTENT = Array("content", ("block", "byte"), "uint8", "1", "bytes of the files, one behind another")

RESTORE: Mapping[str, Callable[[Any], Any]] = {
    "frames": tuple,
    "sequence.rig": Rig.from_dict,
    "sequence.simulation.T_vehicle_left": RigidTransform.from_matrix,
    "sequence.georeference": lambda d: Georeference(d["crs"], tuple(d["origin"]), d["azimuth"]),
    "sequence.truth": lambda poses: [None if pose is None else RigidTransform.from_matrix(pose) for pose in poses],
    "config.vehicle": Vehicle.model_validate,
}
"""How facts of a view come back from their plain form; others are plain."""


@dataclass(frozen=True)
class Output:
    """One file (or folder) of a run.

    Attributes
    ----------
    name : of the file.
    what : what it is, in words.
    opens : free programs that open it.
    write : ``write(path, view)`` writes it; None for what each run renders. It may write nothing, or for a name with
        a ``*`` several files beside ``path``.
    needs : fields of :class:`rille.pipeline.flow.products.Products` whose artifacts must all be there.
    reads : further ones, which may lack some.
    knows : facts of the view that it uses, such as ``sequence.georeference``; others it cannot reach.
    frame : frame of reference of its values, a key of :data:`rille.pipeline.export.frames_json.FRAMES`; empty: none.
    facts : what else a program has to know to read it, for ``frames.json``: units, columns, what is missing.
    """

    name: str
    what: str
    opens: str
    write: Callable[[Path, Any], None] | None = None
    needs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    knows: tuple[str, ...] = ()
    frame: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)


def stage(name: str, summary: str, outputs: Sequence[Output]) -> Stage:
    """Declare the stage behind outputs: its module declares it as ``STAGE``, so that the module's code is its own."""
    by_name = {output.name: output for output in outputs}

    def run(params: NoParams, args: Mapping[str, Any], inputs: Mapping[str, Any]) -> Bundle:
        write = by_name[args["file"]].write
        assert write is not None
        with TemporaryDirectory() as folder:
            write(Path(folder) / args["file"], restore(args, inputs["read"]))
            return pack(Path(folder))

    # artifacts are opened one by one, and only a few at once are held
    return Stage(name, 1, summary, NoParams, ("read*",), (CONTENT,), run, Memory(fixed=300e6, factor=1.0, result=0.1))


# -- a view of a run as arguments and inputs of a task ----------------------------------------------------------


def handles(output: Output, products: Any) -> list[Any]:
    """Handles of all artifacts that an output reads, each once."""
    there: There = {}
    for name in (*output.needs, *output.reads):
        _layout(getattr(products, name), there, lambda _: True)
    return [handle for _, handle in there.values()]


def task(output: Output, view: Any) -> tuple[dict[str, Any], list[Any]] | None:
    """Arguments and inputs of the task that makes an output; None where what it needs is not there."""
    for name in output.needs:
        needed = handles(Output(name, "", "", needs=(name,)), view.products)
        if not needed or not all(map(_due, needed)):
            return None
    there: There = {}
    # Sorted: the arguments enter the task's key, and a set's order differs from process to process.
    names = sorted({*output.needs, *output.reads})
    layout = {name: _layout(getattr(view.products, name), there, _due) for name in names}
    facts = {name: plain(_get(view, name)) for name in output.knows}
    return {"file": output.name, "products": layout, "facts": facts}, [handle for _, handle in there.values()]


def _due(handle: Any) -> bool:
    """Whether there is an artifact; a plan counts on those that are to be computed."""
    return handle.ref is not None or handle.status == "planned"


def restore(args: Mapping[str, Any], bundles: Sequence[Bundle]) -> Any:
    """The view of :func:`task`, with bundles for handles; what was not named is no attribute of it."""

    @lru_cache(maxsize=16)
    def opened(at: int) -> Bundle:
        # A lazy artifact keeps what was read of it: a copy's is freed when this cache drops the copy.
        anew = getattr(bundles[at].arrays, "anew", None)
        return bundles[at] if anew is None else Bundle(anew(), bundles[at].meta)

    place = {id(bundle): at for at, bundle in enumerate(bundles)}
    products = SimpleNamespace(**{name: _filled(layout, bundles) for name, layout in args["products"].items()})
    view = SimpleNamespace(products=products, bundle=lambda b: None if b is None else opened(place[id(b)]), tasks=())
    for name, value in args["facts"].items():
        *path, last = name.split(".")
        at = view
        for part in path:
            at.__dict__.setdefault(part, SimpleNamespace())
            at = getattr(at, part)
        setattr(at, last, None if value is None else RESTORE.get(name, lambda given: given)(value))
    return view


def _get(view: Any, name: str) -> Any:
    for part in name.split("."):
        view = getattr(view, part, None)
    return view


def plain(value: Any) -> Any:
    """JSON form of a fact."""
    for method in ("to_dict", "to_list"):
        if hasattr(value, method):
            return getattr(value, method)()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


There = dict[int, tuple[int, Any]]
"""Handles with their numbers, by their ids."""


def _layout(value: Any, there: There, wanted: Callable[[Any], bool]) -> Any:
    """Plain form of what holds handles; wanted ones are collected in ``there`` and replaced by their number.

    A dictionary is sorted: tasks are laid out in the order in which results come, which is not always the same.
    """
    if hasattr(value, "spec") and hasattr(value, "ref"):
        if not wanted(value):
            return None
        return {"read": there.setdefault(id(value), (len(there), value))[0]}
    if isinstance(value, Mapping):
        return {"by": [[key, _layout(value[key], there, wanted)] for key in sorted(value)]}
    if isinstance(value, list | tuple):
        return [_layout(item, there, wanted) for item in value]
    if is_dataclass(value):
        return {"of": {f.name: _layout(getattr(value, f.name), there, wanted) for f in fields(value)}}
    return value


def _filled(layout: Any, bundles: Sequence[Bundle]) -> Any:
    if isinstance(layout, list):
        return [_filled(item, bundles) for item in layout]
    if not isinstance(layout, dict):
        return layout
    if "read" in layout:
        return bundles[layout["read"]]
    if "by" in layout:
        return {key: _filled(item, bundles) for key, item in layout["by"]}
    return SimpleNamespace(**{name: _filled(item, bundles) for name, item in layout["of"].items()})


# -- files as an artifact ---------------------------------------------------------------------------------------


def pack(folder: Path) -> Bundle:
    """All files below a folder as an artifact: names and sizes, and their bytes."""
    # Sorted: file systems list a folder in any order, and equal files must make equal artifacts.
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    data = np.frombuffer(b"".join(files.values()), dtype=np.uint8)
    blocks = np.zeros((-(-len(data) // BLOCK), BLOCK), dtype=np.uint8)
    blocks.reshape(-1)[: len(data)] = data
    return Bundle({"content": blocks}, {"files": [[name, len(content)] for name, content in files.items()]})


def unpack(bundle: Bundle) -> dict[str, bytes]:
    """Content of each file of an artifact, by its name.

    Raises
    ------
    InputError
        It holds no such files, or a name leads out of the folder of the run: others may write to a shared cache.
    """
    data, at, found = np.asarray(bundle["content"]).tobytes(), 0, {}
    try:
        for name, size in bundle.meta["files"]:
            path = PurePath(name)
            if path.is_absolute() or ".." in path.parts:
                raise ValueError(f"{name!r} lies outside of a run")
            found[name] = data[at : at + size]
            at += size
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            "RIL-983",
            f"an artifact of the cache holds no files of a run ({error})",
            remedy="somebody forged it: use another cache",
        ) from error
    return found


def place(bundle: Bundle, folder: Path) -> None:
    """Write copies of an artifact's files into the folder of a run."""
    for name, content in unpack(bundle).items():
        atomic.write(folder / name, content)
