"""A run as an RO-Crate 1.1: its files, inputs, programs and command, for archives and reruns.

https://www.researchobject.org/ro-crate/specification/1.1. The crate holds copies of the run's files, each with its
SHA-256. The run is an action, whose objects are the parameters and the digests of all files that it read, and whose
instruments are Rille and the packages that results depend on. `rille reconstruct CRATE` runs it again and compares
(:mod:`rille.pipeline.runs.crate`).
"""

from __future__ import annotations

import hashlib
import json
import mimetypes
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rille.datasets.text.reading import TABLE, read_text
from rille.pipeline.export import catalogue
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.read_dem import refuse_irregular
from rille.stages.core.errors import InputError

METADATA = "ro-crate-metadata.json"
SPECIFICATION = "https://w3id.org/ro/crate/1.1"
PROGRAM = "#rille"

Entity = dict[str, Any]


def write_run(folder: Path, run: RunArtifacts) -> str:
    """Write the run's files and ``ro-crate-metadata.json``; return the content, in words."""
    facts = json.loads(read_text(run.run / "report.json", "report", TABLE))
    if facts["command"].split()[:2] != ["rille", "reconstruct"]:
        text = "a drive cannot be run again from a crate"
        raise InputError("RIL-611", text, remedy="send its folder, which has config.toml and report.html")
    folder.mkdir()
    files = []
    for name, what, _ in catalogue.listed(run.run):
        if what and (run.run / name).exists():  # files without a description are exports, not files of the run
            refuse_irregular(run.run / name)
            copy = shutil.copytree if (run.run / name).is_dir() else shutil.copy2
            copy(run.run / name, folder / name)
            files += list(_files(folder, name, what))
    inputs = [_entity(f"#{k}", "PropertyValue", f"sha256 of {k}", value=digest) for k, digest in run.digests()]
    graph = [*_about(run.run, facts, files, inputs), *files, *inputs, *_programs(facts["versions"])]
    context = [f"{SPECIFICATION}/context", {"sha256": "https://schema.org/sha256"}]  # newer than the specification
    text = json.dumps({"@context": context, "@graph": graph}, indent=1, ensure_ascii=False)
    (folder / METADATA).write_text(text + "\n", encoding="utf-8")
    return f"{len(files)} files, {len(inputs)} inputs by their digests"


def _entity(at: str, kind: str, name: str, **more: Any) -> Entity:
    return {"@id": at, "@type": kind, "name": name, **more}


def _links(names: Iterable[str]) -> list[Entity]:
    return [{"@id": name} for name in names]


def _files(folder: Path, name: str, what: str) -> Iterator[Entity]:
    """A file, or each file of a folder, with its digest."""
    top = folder / name
    for path in sorted(p for p in top.rglob("*") if p.is_file()) if top.is_dir() else [top]:
        at, kind = path.relative_to(folder).as_posix(), mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        size = str(path.stat().st_size)
        yield _entity(at, "File", at, description=what, contentSize=size, encodingFormat=kind, sha256=sha256(path))


def _about(run: Path, facts: Mapping[str, Any], files: list[Entity], inputs: list[Entity]) -> Iterator[Entity]:
    """The crate itself, and the run as an action."""
    sequence = facts["sequence"]["name"]
    names = [entity["@id"] for entity in files]
    yield _entity(
        METADATA, "CreativeWork", "metadata of this crate", about={"@id": "./"}, conformsTo={"@id": SPECIFICATION}
    )
    yield _entity(
        "./",
        "Dataset",
        f"Stereo reconstruction of {sequence}, run {run.name}",
        description=facts["verdict"],
        datePublished=facts["started"],
        license="not stated by the run: that of the images",
        hasPart=_links(names),
        mentions={"@id": "#run"},
    )
    yield _entity(
        "#run",
        "CreateAction",
        facts["command"],
        description="Runs again by: rille reconstruct FOLDER_OF_THIS_CRATE",
        startTime=facts["started"],
        instrument={"@id": PROGRAM},
        object=_links(["config.toml", *(entity["@id"] for entity in inputs)]),
        result=_links(name for name in names if name != "config.toml"),
    )


def _programs(versions: Mapping[str, str]) -> Iterator[Entity]:
    """Rille, and the packages that its results depend on."""
    needed = {"softwareRequirements": _links(f"#{name}" for name in versions if name != "rille")}
    for name, version in versions.items():
        more = needed if name == "rille" else {}
        yield _entity(f"#{name}", "SoftwareApplication", name, version=version, **more)


def sha256(path: Path) -> str:
    """SHA-256 of a file, empty where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
