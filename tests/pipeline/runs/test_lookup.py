from __future__ import annotations

from toys import chain

from rille.pipeline.engine import events, scheduler
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import lookup


def test_a_run_is_complete_once_its_files_are_written(tmp_path):
    run, graph = tmp_path / "runs" / "toy" / "1", Graph()
    run.mkdir(parents=True)
    chain.build(graph)
    options = scheduler.RunOptions(executor="inline", ledger=run / lookup.LEDGER)
    scheduler.run(graph, Store(tmp_path / "cache"), options)
    assert [line.split()[1] for line in lookup.describe([run])] == ["state", "interrupted"]
    events.add_facts(run / lookup.LEDGER, total=1.0)
    assert [line.split()[1] for line in lookup.describe([run])] == ["state", "complete"]
