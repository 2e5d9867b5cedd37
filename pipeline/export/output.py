"""Outputs: the row that describes a file of a run, and the stage that makes the file.

A row has the name of the file, its writer and the writer's inputs, the frame of its values, and programs that open it.
Writer, report, ``frames.json`` and the table in the docs read nothing else.

A file is a cached task like all others: its artifact holds its bytes, keyed by the artifacts and facts that its writer
takes and by the code of the module that declares it. A run's folder gets a copy, so that a user's changes do not damage
the cache. Facts of a single run (its time, which tasks it computed) are in none of these files: the page and
``report.json`` are rendered by each run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rille.datasets.georeference import Georeference
from rille.pipeline.export.view import Names, Part, RunView
from rille.stages.core.declare import AnyArray, Array, Bundle, Memory, NoParams, Stage
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.hazard.vehicle import Vehicle

CONTENT = Array("content", ("block", "byte"), "uint8", "1", "bytes of the files, one behind another")


Writer = Callable[[Path, RunView], None]


@dataclass(frozen=True)
class Output:
    """One file (or folder) of a run.

    Attributes
    ----------
    name : of the file.
    what : its content, in words.
    opens : free programs that open it.
    write : ``write(path, run)`` writes it; ``run`` has the attributes named by ``needs`` and ``reads``, with artifacts
        for handles. It may write nothing, or for a name with a ``*`` several files beside ``path``. None: each run
        renders the file.
    frame : frame of reference of its values, a key of :data:`rille.pipeline.export.catalogue.FRAMES`; empty: none.
    needs : products that it is made of; if any part of them is missing, the file is not made.
    reads : other products and plain facts that it takes; missing products are None.
    """

    name: str
    what: str
    opens: str
    write: Writer | None = None
    frame: str = ""
    needs: Names = ()
    reads: Names = ()

    @property
    def names(self) -> Names:
        """All products and facts that it takes of a run."""
        return *self.needs, *self.reads


def stage(name: str, summary: str, outputs: Sequence[Output]) -> Stage:
    """Stage of some outputs; their module declares it as ``STAGE``, so that the stage's code is that of the module."""
    writers = {output.name: output.write for output in outputs if output.write is not None}

    def run(params: NoParams, args: Mapping[str, Any], inputs: Mapping[str, Any]) -> Bundle:
        bundles = [Bundle(_Unkept(b), b.meta) for b in inputs["read"]]
        with TemporaryDirectory() as folder:
            writers[args["file"]](Path(folder) / args["file"], _restored(args["run"], bundles))
            return pack(Path(folder))

    return Stage(name, summary, NoParams, ("read*",), (CONTENT,), run, Memory(fixed=300e6, factor=1.0, result=0.1))


class _Unkept(Mapping[str, AnyArray]):
    """Arrays of an artifact, read anew at each access, since a figure of all pairs cannot hold all of them."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle

    def __getitem__(self, name: str) -> AnyArray:
        return np.asarray(self._bundle.raster(name)[()])

    def __contains__(self, name: object) -> bool:
        return name in self._bundle.arrays

    def __iter__(self) -> Iterator[str]:
        return iter(self._bundle.arrays)

    def __len__(self) -> int:
        return len(self._bundle.arrays)


# -- what a writer gets, out of the arguments of its task --------------------------------------------------------


class Form(NamedTuple):
    """Functions that convert values of a class to plain JSON and back."""

    write: Callable[[Any], Any]
    read: Callable[[Any], Any]


FORMS = {
    "Rig": Form(Rig.to_dict, Rig.from_dict),
    "RigidTransform": Form(RigidTransform.to_list, RigidTransform.from_matrix),
    "Georeference": Form(Georeference.to_dict, Georeference.from_dict),
    "Vehicle": Form(methodcaller("model_dump", mode="json"), Vehicle.model_validate),
}
"""Forms of facts that are not plain JSON, by the names of their classes."""


def _restored(form: Any, bundles: Sequence[Bundle]) -> Any:
    """The value of a plain form, with artifacts for handles."""
    if isinstance(form, list):
        return tuple(_restored(item, bundles) for item in form)
    if not isinstance(form, dict):
        return form
    ((kind, content),) = form.items()
    if kind == "artifact":
        return bundles[content]
    if kind == "by":
        return {key: _restored(item, bundles) for key, item in content}
    if kind == "part":
        return Part(**{name: _restored(item, bundles) for name, item in content.items()})
    return FORMS[kind].read(content)


# -- files as an artifact ---------------------------------------------------------------------------------------


def pack(folder: Path) -> Bundle:
    """Artifact of all files below a folder: names, sizes and bytes."""
    # Sorted, since file systems list folders in any order, and equal files must make equal artifacts.
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    data = np.frombuffer(b"".join(files.values()), dtype=np.uint8)
    # Rows of 1024 bytes make chunks of 1024 x 1024.
    blocks = np.zeros((-(-len(data) // 1024), 1024), dtype=np.uint8)
    blocks.reshape(-1)[: len(data)] = data
    return Bundle({"content": blocks}, {"files": [[name, len(content)] for name, content in files.items()]})


def unpack(bundle: Bundle) -> dict[str, bytes]:
    """Content of each file of an artifact, by its name.

    Raises
    ------
    InputError
        It holds no files, or a name leads out of the run's folder, as others may write it to a shared cache.
    """
    data, at, files = np.asarray(bundle["content"]).tobytes(), 0, {}
    try:
        for name, size in bundle.meta["files"]:
            path = PurePath(name)
            if path.is_absolute() or ".." in path.parts:
                raise ValueError(f"{name!r} lies outside of a run")
            files[name] = data[at : at + size]
            at += size
    except (ValueError, TypeError, KeyError) as error:
        text = f"an artifact of the cache holds no files of a run ({error})"
        raise InputError("RIL-983", text, remedy="somebody forged it: use another cache") from error
    return files
