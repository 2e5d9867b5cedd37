"""A small run as a program of its own: ``python -m toys.chain CACHE [executor] [what] [ledger]``; prints JSON."""

import json
import signal
import sys
from pathlib import Path


def build(graph, frames=4, seed=0, size=40, offset=0.0):
    """Numbers -> scale (per frame) -> total, the parts by expansion."""
    from rille.stages.core.declare import NoParams
    from toys.numbers import NumbersParams
    from toys.scale import ScaleParams

    first = [
        graph.node("toys.numbers", f"numbers/{f}", NumbersParams(seed=seed, size=size), {"frame": f})
        for f in range(frames)
    ]

    def rest():
        yield first
        parts = [
            graph.node("toys.scale", f"scale/{f}", ScaleParams(offset=offset), inputs={"values": h})
            for f, h in enumerate(first)
        ]
        graph.node("toys.total", "total", NoParams(), inputs={"parts": parts})

    graph.flow(rest())


def run(folder, name, sequence="toy", **kw):
    """Run it in this process, with the ledger of a run of that name below ``folder / "runs"``; the run's folder."""
    from rille.pipeline.engine import run as driver
    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.store.base import Store

    graph = Graph(sequence)
    build(graph, **kw)
    at = folder / "runs" / sequence / name
    options = driver.RunOptions(executor="inline", ledger=at / "ledger.jsonl")
    driver.run(graph, Store(folder / "cache"), options).check()
    return at


def main(cache, executor="inline", what="", ledger=""):
    """Run it, and say what became of it."""
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    from rille.pipeline.engine import run as driver
    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.store.base import Store
    from rille.stages.core.declare import NoParams

    graph = Graph()
    build(graph, frames=12 if what == "many" else 4, size=400 if what == "many" else 40)
    if what == "sleep":
        for i in range(3):
            graph.node("toys.mischief", f"sleep/{i}", NoParams(), {"what": "sleep", "seconds": 60, "i": i})
    print("begun", flush=True)
    result = driver.run(
        graph, Store(cache), driver.RunOptions(executor=executor, jobs=2, ledger=Path(ledger) if ledger else None)
    )
    nodes = {h.label: [h.status, h.ref.digest if h.ref else None, h.reason] for h in graph.nodes}
    print(json.dumps({"ok": result.ok, "nodes": nodes}), flush=True)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets its background jobs ignore it
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit(130)
