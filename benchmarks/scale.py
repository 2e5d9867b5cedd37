"""What the engine itself costs: a long sequence whose stages do nothing, laid out by the real dataflow.

``python benchmarks/scale.py [--pairs 2000] [--jobs 2]``

Every frame is basic, so that each has all the tasks of a pair. Each stage keeps its ports, arrays, parameters and code
digest; only what it computes is replaced by a few zeros, committed as ever. Each size runs in a process of its own on
an empty cache, then is planned by other processes, warm: at once, and on the next day, when files are old.
Printed are, a node or a task:

- plan: laying out and looking up when all is cached, as ``rille plan`` does
- next day: a whole warm run a day later, which marks each artifact as used
- overhead: processor time of client, scheduler and workers together, but for look-up and commit by a worker
- client: the part of it that the process with graph and scheduler took
- in task: look-up and commit by a worker, without flushing to the disk unless ``--flush``
- memory: resident memory of client and workers by tenths of the cold run

Times are of the processor, with the wall's beside where it matters; each figure with a limit says whether it is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

STAGE_MODULE = '''"""Ports and arrays of {real}, and no work."""

from dataclasses import replace

import {real} as real
from rille.stages.core.declare import declared

from idle.source import nothing

STAGE = replace(declared(real), run=nothing("{name}"), facts=None, function=None)
'''

IMAGE_MODULE = '''"""An image of a few pixels."""

from idle.source import image_stage

STAGE = image_stage()
'''

SPACING = 0.5
"""Metres from pair to pair; elevation models of 1.6 m then overlap."""

CELL = 0.004
"""Metres; a world tile of 512 cells then holds cells of about seven models."""

UNFLUSHED = "RILLE_SCALE_UNFLUSHED"

DAY = 86_400.0

PLAN, OVERHEAD, MEMORY, FLAT = 0.2, 4.0, 1e9, 1.1
"""Limits: milliseconds a node, milliseconds a task, bytes of the client, memory at the end against the middle."""


def _spent() -> float:
    """Processor time of this thread, and of those in which zarr reads for it."""
    helpers = [t.ident for t in threading.enumerate() if t.name.startswith(("zarr_io", "asyncio_"))]
    return time.thread_time() + sum(time.clock_gettime(time.pthread_getcpuclockid(i)) for i in helpers if i)


def _measured(ensure: Callable[..., Any]) -> Callable[..., Any]:
    """``ensure`` that tells its processor time as that of the stage, which does nothing."""

    def timed(*args: Any, **more: Any) -> Any:
        begin = _spent()
        outcome = ensure(*args, **more)
        return replace(outcome, took=replace(outcome.took, kernel=_spent() - begin))

    return timed


if os.environ.get(UNFLUSHED) is not None and __name__ == "idle.source":  # in a worker, as it imports its first stage
    from rille.pipeline.engine import workers

    base: Any = workers

    base.ensure = _measured(base.ensure)
    if os.environ[UNFLUSHED]:
        os.fsync = lambda _: None  # type: ignore[assignment]


def nothing(name: str) -> Any:
    """``run`` of a stage of the chain: zeros of the declared arrays, and the facts by which the graph grows."""

    def run(params: Any, args: Any, inputs: Any) -> Any:
        from rille.stages.core.declare import Bundle

        stage = _real(name)
        arrays = {
            a.name.replace("*", "0"): np.zeros((4,) * len(a.dims), dtype=a.dtype)
            for a in stage.outputs
            if not a.optional
        }
        return Bundle(arrays, {**_facts(name, args, inputs), "of": _of(args, inputs)})

    return run


def _of(args: Any, inputs: Any) -> str:
    """What tells the result of a task from those of its like: a digest of its frames, else its first input's."""
    own = [args[k] for k in ("pair", "frame", "frames", "camera", "lattice") if k in args]
    first = next(iter(inputs.values()), None)
    first = first[0] if isinstance(first, list) else first
    return (
        str(first.meta["of"])
        if not own and first is not None
        else hashlib.sha256(json.dumps(own).encode()).hexdigest()[:16]
    )


def _real(name: str) -> Any:
    from rille.pipeline.flow.config import stages

    return stages()[name]


def _facts(name: str, args: Any, inputs: Any) -> dict[str, Any]:
    if name == "frame_screening":
        return {"asks": {}, "chain": args["frames"], "lost": [], "unfit": []}
    if name == "intrinsics":
        return {}
    if name == "rig":
        return {"per_pair": [{"pair": one.meta["pair"]} for one in inputs["orientations"]]}
    if name == "keyframes":
        n = args["frames"]
        steps = {"displacement": [1.0] * (n - 1), "match_rate": [1.0] * (n - 1)}
        return {"basic": list(range(n)), "segments": [[k, k + 1] for k in range(n - 1)], **steps}
    if name == "ground_frame":
        seen = {"plane": [0.0, 0.0, -1.0], "relief": [-0.1, 0.1], "ground_share": 1.0, "ground_reach": 10.0}
        return {"T_local_left": np.eye(4)[:3].ravel().tolist(), "source": "none", "cell_size": CELL, **seen}
    if name == "trajectory":
        frames = args["frames"]
        positions = [[0.0, SPACING * k, 0.0] for k in range(len(frames))]
        return {"frames": frames, "positions": positions, "pieces": [frames], "main": 0}
    if name == "locus":
        from rille.stages.geometry.lattice import Lattice

        y = SPACING * args["pair"]
        return {"lattice": Lattice.snap((-0.8, 0.8, y, y + 1.6), CELL).to_dict(), "pair": args["pair"]}
    if name == "tile_index":
        lattice = inputs["dem"].meta["lattice"]
        return {
            "pair": inputs["dem"].meta["pair"],
            "cell": CELL,
            "box": lattice,
            "tiles": list(_tiles(lattice, args["side"])),
        }
    if name == "loops":
        return {"pairs": args["pairs"], "candidates": [[] for _ in args["pairs"]]}
    if name == "radiometry":
        return {"steps": {}}
    return {k: v for k, v in args.items() if k in ("pair", "frames")}


def _tiles(lattice: Any, side: int) -> Iterator[list[int]]:
    """World tiles that a model without a hole touches, with the box of its cells in each."""
    col, line = round(lattice["x0"] / lattice["cell"]), round(-lattice["y0"] / lattice["cell"])
    right, foot = col + lattice["cols"], line + lattice["rows"]
    for tx in range(col // side, (right - 1) // side + 1):
        for ty in range(line // side, (foot - 1) // side + 1):
            left, top = max(col, tx * side), max(line, ty * side)
            yield [tx, ty, left, top, min(right, (tx + 1) * side) - left, min(foot, (ty + 1) * side) - top]


def image_stage() -> Any:
    """Source of the images."""
    from rille.stages.core.declare import Array, Bundle, NoParams, Stage

    def run(params: Any, args: Any, inputs: Any) -> Any:
        return Bundle({"image": np.zeros((4, 4), dtype=np.uint8)}, {"of": f"{args['frame']} {args['camera']}"})

    arrays = (Array("image", ("row", "col"), "uint8", "1", "grey value"),)
    return Stage("image", "nothing", NoParams, (), arrays, run=run)


def write_stages(folder: Path) -> None:
    """The package ``idle`` of stages that do nothing."""
    from rille.pipeline.flow.config import stages

    package = folder / "idle"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text('"""Stages that do nothing."""\n')
    shutil.copyfile(__file__, package / "source.py")  # a stage's own modules lie in its package
    (package / "image.py").write_text(IMAGE_MODULE)
    for name, real in stages().items():
        (package / f"{name}.py").write_text(STAGE_MODULE.format(real=real.module, name=name))


def graph_of(pairs: int) -> Any:
    """The real dataflow over a sequence of so many pairs."""
    from rille.datasets.protocol import Sequence, Source
    from rille.pipeline.engine.graph import Graph, Handle
    from rille.pipeline.flow import config
    from rille.pipeline.flow.closed_loop import dataflow
    from rille.stages.core.declare import NoParams
    from rille.stages.geometry.geometry import Camera, Rig, RigidTransform

    class Idle(Graph):
        """Takes for each stage the one that does nothing."""

        def node(self, stage: Any, *args: Any, **more: Any) -> Handle:  # type: ignore[override]
            return super().node(stage if isinstance(stage, str) else f"idle.{stage.name}", *args, **more)

    none = NoParams()
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))

    def image(frame: int, which: str) -> Source:
        return Source("idle.image", none, {"frame": frame, "camera": which})

    sequence = Sequence("scale", rig, pairs, image, tuple(str(k) for k in range(pairs)))
    graph = Idle()
    dataflow(graph, sequence, config.build({}), tuple(range(pairs)))
    return graph


class Watch(threading.Thread):
    """Reads, each half second, the memory of this process and of its workers, and what processor time these took."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.client: list[int] = []
        self.workers: list[int] = []
        self.processor: dict[int, float] = {}
        self.own = 0.0
        """Processor time of this thread."""
        self._end = threading.Event()

    def run(self) -> None:
        """Until the end is said."""
        this = psutil.Process()
        while not self._end.wait(0.5):
            self.client.append(this.memory_info().rss)
            greatest = 0
            for child in this.children(recursive=True):
                with suppress(psutil.Error):  # it ends as we look
                    times = child.cpu_times()
                    self.processor[child.pid] = times.user + times.system
                    greatest = max(greatest, child.memory_info().rss)
            self.workers.append(greatest)
            self.own = time.thread_time()

    def stop(self) -> None:
        """Say the end."""
        self._end.set()
        self.join()


def measure(pairs: int, cache: str, executor: str, jobs: int, what: str) -> dict[str, Any]:
    """One cold run, one plan of what is cached, or one warm run a day later, in this process."""
    from rille.pipeline.engine.events import read
    from rille.pipeline.engine.keys import tree_digest
    from rille.pipeline.engine.run import RunOptions, run
    from rille.pipeline.engine.store.base import Store

    tree_digest()  # once a process, whatever its size: reading the sources, importing the flow and its stages
    graph_of(2)
    if what == "later":
        now = time.time
        time.time = lambda: now() + DAY
    watch = Watch()
    watch.start()
    cpu, wall = time.process_time(), time.perf_counter()
    graph = graph_of(pairs)
    store, ledger = Store(cache), Path(tempfile.mkdtemp()) / "ledger.jsonl"
    options = RunOptions(executor=executor, jobs=jobs, ledger=ledger, dry=what == "plan")
    result = run(graph, store, options)
    result.check()
    spent, cpu = time.perf_counter() - wall, time.process_time() - cpu
    watch.stop()
    cpu -= watch.own
    n = len(graph.nodes)
    processor = sum(row.get("kernel", 0.0) for row in read(ledger))
    return {
        "nodes": n,
        "computed": result.counts["computed"],
        "wall": 1e3 * spent / n,
        "client": 1e3 * cpu / n,
        "overhead": 1e3 * (cpu + sum(watch.processor.values()) - processor) / n,
        "in task": 1e3 * processor / n,
        "memory": {"client": watch.client, "worker": watch.workers},
    }


def entries(folder: Path) -> tuple[int, Path]:
    """The greatest number of entries of any folder, and which."""
    counts: Counter[Path] = Counter()
    for at, folders, files in os.walk(folder):
        counts[Path(at)] = len(folders) + len(files)
    path, most = counts.most_common(1)[0]
    return most, path.relative_to(folder)


def child(pairs: int, folder: Path, how: list[str], what: str, environment: Mapping[str, str]) -> dict[str, Any]:
    """:func:`measure` in a process of its own."""
    here = Path(__file__).resolve().parent.parent
    path = os.pathsep.join([str(folder / "stages"), str(here), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(Path(__file__).resolve()), "--pairs", str(pairs), *how]
    done = subprocess.run(
        [*command, "--folder", str(folder), "--what", what],
        env={**os.environ, "PYTHONPATH": path, **environment},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def verdict(kept: bool) -> str:
    """Word of a line with a limit."""
    return "kept" if kept else "NOT KEPT"


def planned(name: str, found: dict[str, Any]) -> str:
    """Line of a warm plan or run."""
    times = f"{found['client']:.3f} ms of processor a node, {found['wall']:.3f} ms by the clock"
    return f"  {name}: {times}; limit {PLAN}: {verdict(found['client'] <= PLAN)}"


def over_time(who: str, samples: list[int], limit: float) -> str:
    """Line of the memory of a process over a run: the median of each tenth."""
    tenths = [part for part in np.array_split(np.array(samples) / 1e6, 10) if part.size]
    medians = [float(np.median(part)) for part in tenths]
    ratio, most = medians[-1] / medians[len(medians) // 2], max(samples)
    amount = f"greatest {most / 1e6:.0f}" + (f", limit {limit / 1e6:.0f}: {verdict(most <= limit)}" if limit else "")
    flat = f"end / middle {ratio:.2f}, limit {FLAT}: {verdict(ratio <= FLAT)}"
    return f"  {who}, MB by tenths of the run: {' '.join(f'{m:.0f}' for m in medians)}; {amount}; {flat}"


def figures(pairs: int, how: list[str], folder: Path, environment: Mapping[str, str]) -> Iterator[str]:
    """Lines of one size, each as soon as it is known."""
    write_stages(folder / "stages")
    cold = child(pairs, folder, how, "run", environment)
    assert cold["computed"] == cold["nodes"]
    yield f"{pairs} pairs, {cold['nodes']} nodes"
    kept = verdict(cold["overhead"] <= OVERHEAD)
    yield f"  overhead: {cold['overhead']:.2f} ms of processor a task; limit {OVERHEAD}: {kept}"
    yield f"  of it client and scheduler {cold['client']:.2f} ms; look-up and commit besides {cold['in task']:.2f} ms"
    yield f"  cold run by the clock: {cold['wall']:.2f} ms a task"
    for who, limit in (("client", MEMORY), ("worker", 0.0)):
        if any(cold["memory"][who]):
            yield over_time(who, cold["memory"][who], limit)
    for what, name in (("plan", "plan when all is cached"), ("later", "run that computes nothing, the next day")):
        warm = child(pairs, folder, how, what, environment)
        assert (warm["computed"], warm["nodes"]) == (0, cold["nodes"])
        yield planned(name, warm)
    most, where = entries(folder)
    yield f"  entries of the fullest folder: {most}, {where}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=2000, help="of the largest size; a quarter of it comes first")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--executor", choices=("dask", "inline"), default="dask")
    parser.add_argument("--folder", type=Path, help="where to work (kept); a temporary one by default")
    parser.add_argument("--cache", default="", help="where artifacts are; in the folder by default")
    parser.add_argument("--flush", action="store_true", help="flush to the disk, as a real run does")
    parser.add_argument("--what", choices=("all", "run", "plan", "later"), default="all", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.what != "all":
        from rille.pipeline.engine.runtime.environment import prepare_environment

        prepare_environment()
        cache = given.cache or str(given.folder / "cache")
        print(json.dumps(measure(given.pairs, cache, given.executor, given.jobs, given.what)))
        return
    how, environment = (
        ["--executor", given.executor, "--jobs", str(given.jobs)],
        {UNFLUSHED: "" if given.flush else "1"},
    )
    with tempfile.TemporaryDirectory() as temporary:
        within = given.folder or Path(temporary)
        for pairs in sorted({max(2, given.pairs // 4), given.pairs}):
            for line in figures(pairs, how, within / str(pairs), environment):
                print(line, flush=True)


if __name__ == "__main__":
    main()
