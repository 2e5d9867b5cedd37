"""Sequences that Rille knows: list them, or export one for other tools."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from rille.datasets import registry
from rille.datasets.export import export
from rille.datasets.protocol import Source
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.task import Spec, ensure
from rille.pipeline.export.writers import check_folder
from rille.pipeline.flow import config
from rille.pipeline.runs.options import Assignments, CacheFolder, cache_folder

app = App(name="datasets", help=__doc__)


@app.default
@app.command(name="list")
def list_datasets() -> None:
    """List the built-in sequences and the folder layouts that are recognised."""
    for name, words in registry.catalogue():
        print(f"{name:16s} {words}")


@app.command(name="export")
def export_dataset(seq: str, directory: Path, *, assignments: Assignments = (), cache: CacheFolder = None) -> None:
    """Write a built-in sequence as plain files (PNG, rig, poses, disparity, DEM, times), for use by other tools.

    Parameters
    ----------
    seq
        Name of a built-in sequence.
    directory
        Folder to make; it must not exist yet or be empty.
    """
    for_dataset = config.parse_assignments(assignments)
    config.refuse_other_sections(for_dataset, config.DATASET_SECTIONS, "datasets export")
    store = Store(cache_folder(cache))
    # Before minutes of rendering.
    store.writable()
    check_folder(directory)

    def artifact(source: Source) -> Ref:  # rendering is cached like any other work
        refs = {port: artifact(upstream) for port, upstream in source.inputs.items()}
        label = source.module.rsplit(".", 1)[-1]
        return ensure(store.root, Spec(source.module, label, source.params, source.args, source.hints), refs).ref

    sequence = registry.open_sequence(seq, for_dataset)
    with atomic.replacing(directory) as folder:
        export(sequence, folder, lambda source: store.open(artifact(source)))
    print(directory)
