"""The synthetic chain of the torture: sources, an expansion, sums of sums; with sleepers or saboteurs at will."""

from __future__ import annotations

import json
import random
import resource
import sys
import time
from pathlib import Path

FRAMES = 8


def build(graph, *, frames=FRAMES, size=150, shuffle=None, sleepers=0, sabotage=(), tally=None):
    """Lay the graph out; ``shuffle`` is the seed of another order of creation, which is the order of work."""
    from toys.numbers import NumbersParams
    from toys.scale import ScaleParams

    from rille.stages.core.declare import NoParams

    def shuffled(items):
        items = list(items)
        if shuffle is not None:
            random.Random(shuffle).shuffle(items)
        return items

    first, scaled = {}, {}
    for f in shuffled(range(frames)):
        first[f] = graph.node("toys.numbers", f"numbers/{f}", NumbersParams(size=size), {"frame": f})

    def rest():
        yield [first[f] for f in range(frames)]
        for f in shuffled(range(frames)):
            scaled[f] = graph.node("toys.scale", f"scale/{f}", ScaleParams(), inputs={"values": first[f]})
        halves = [[scaled[f] for f in range(frames) if f % 2 == k] for k in (0, 1)]
        for k in shuffled((0, 1)):
            graph.node("toys.total", f"total/{k}", NoParams(), inputs={"parts": halves[k]})

    graph.flow(rest())
    for what in sabotage:
        hints = {"tally": str(Path(tally) / what.replace(":", "-"))}
        graph.node("torn.saboteur", f"saboteur/{what}", NoParams(), {"what": what.partition("#")[0], "n": what}, hints)
    for i in range(sleepers):
        graph.node("toys.mischief", f"sleep/{i}", NoParams(), {"what": "sleep", "seconds": 60, "i": i})


def run(cache, executor="inline", ledger=None, jobs=2, memory=None, **options):
    """One run; what became of it, as plain values. ``memory`` is what all workers together may have, bytes."""
    if memory is not None:
        resource.setrlimit(resource.RLIMIT_RSS, (memory, memory))  # the engine heeds it, the kernel does not
    from rille.pipeline.engine import run as driver
    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.store.base import Store

    graph = Graph()
    build(graph, **options)
    made = driver.run(
        graph,
        Store(cache),
        driver.RunOptions(executor=executor, jobs=jobs, keep_going=True, ledger=Path(ledger) if ledger else None),
    )
    nodes = {
        h.label: {
            "status": h.status,
            "key": h.key,
            "digest": h.ref.digest if h.ref else None,
            "why": f"{type(h.error).__name__}: {h.error}" if h.error else h.reason,
        }
        for h in graph.nodes
    }
    return {"ok": made.ok, "nodes": nodes}


def clear(cache, runs, until, grace):
    """Clear the cache again and again beside the runs, as ``rille cache gc`` does; how often, and what went."""
    from rille.pipeline.engine import events as ledger
    from rille.pipeline.engine.store import maintenance
    from rille.pipeline.engine.store.base import Store

    times = removed = 0
    while not Path(until).exists():
        kept = set()
        for path in Path(runs).glob("*/*/ledger.jsonl"):
            kept |= {row["key"] for row in ledger.read(path) if row["status"] in ("computed", "cached")}
        cleared = maintenance.gc(Store(cache), kept, grace=grace)
        removed += sum(len(sizes) for stage, sizes in cleared.items() if stage)
        times += 1
        time.sleep(0.002)
    return {"times": times, "removed": removed}


def main(task):
    """Do what a JSON object says, and leave what became of it as a file; the exit code is that of the program."""
    out = Path(task.pop("out"))
    try:
        found = {"run": run, "clear": clear}[task.pop("do")](**task)
    except KeyboardInterrupt:
        return 130
    temporary = out.with_suffix(".tmp")
    temporary.write_text(json.dumps(found))
    temporary.replace(out)
    return 0


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
