"""What the engine itself costs: a long sequence whose stages do nothing, laid out by the real dataflow.

``python benchmarks/scale.py [--pairs 2000] [--jobs 2]``

Every frame is basic, so that each has all the tasks of a pair. Each stage keeps its ports, arrays, parameters and code
digest; only what it computes is replaced by a few zeros, committed as ever. Each size runs in a process of its own on
an empty cache, then is planned by another process, warm. Printed are, a node or a task:

- plan: laying out and looking up when all is cached, as ``rille plan`` does; wall and processor time
- overhead: wall time of the cold run in which no worker was in a task, ``(wall - in tasks / workers) / tasks``
- client: processor time of the process that holds graph and scheduler
- in task: look-up and commit by a worker, without flushing to the disk unless ``--flush``
- memory: resident memory of the client, and of a worker, at the end

Wall times are those of the machine as it is: on one that others use too, look at the processor times.
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
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

STAGE_MODULE = '''"""Ports and arrays of {real}, and no work."""

from dataclasses import replace

from {real} import STAGE as REAL

from idle.source import nothing

STAGE = replace(REAL, run=nothing("{name}"))
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


if os.environ.get(UNFLUSHED):  # in the workers, as they import their first stage
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
    own = [args[k] for k in ("pair", "frame", "frames", "camera", "lattice", "use") if k in args]
    first = next(iter(inputs.values()), None)
    first = first[0] if isinstance(first, list) else first
    return (
        str(first.meta["of"])
        if not own and first is not None
        else hashlib.sha256(json.dumps(own).encode()).hexdigest()[:16]
    )


def _real(name: str) -> Any:
    from rille.pipeline.flow.config import stage

    return stage(name)


def _facts(name: str, args: Any, inputs: Any) -> dict[str, Any]:
    if name == "frame_screening":
        return {"asks": {}, "chain": args["frames"], "lost": [], "unfit": []}
    if name == "common_tilt":
        return {"undone": False}
    if name == "keyframes":
        n = args["frames"]
        steps = {"displacement": [1.0] * (n - 1), "match_rate": [1.0] * (n - 1)}
        return {"basic": list(range(n)), "segments": [[k, k + 1] for k in range(n - 1)], **steps}
    if name == "ground_frame":
        return {"T_local_left": np.eye(4)[:3].tolist(), "pair": args["pair"]}
    if name == "trajectory":
        frames = args["frames"]
        positions = [[0.0, SPACING * k, 0.0] for k in range(len(frames))]
        return {"frames": frames, "positions": positions, "pieces": [[frames[0], frames[-1]]], "main": 0}
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
    return Stage("image", 1, "nothing", NoParams, (), arrays, run=run)


def write_stages(folder: Path) -> None:
    """The package ``idle`` of stages that do nothing."""
    from rille.pipeline.flow.config import modules

    package = folder / "idle"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text('"""Stages that do nothing."""\n')
    shutil.copyfile(__file__, package / "source.py")  # a stage's own modules lie in its package
    (package / "image.py").write_text(IMAGE_MODULE)
    for name, real in modules().items():
        (package / f"{name}.py").write_text(STAGE_MODULE.format(real=real.__name__, name=name))


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

        def node(self, stage: Any, *args: Any, **more: Any) -> Handle:
            return super().node(stage if isinstance(stage, str) else f"idle.{stage.STAGE.name}", *args, **more)

    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))

    def image(frame: int, which: str) -> Source:
        return Source("idle.image", NoParams(), {"frame": frame, "camera": which})

    sequence = Sequence("scale", rig, pairs, image, tuple(str(k) for k in range(pairs)))
    graph = Idle()
    dataflow(graph, sequence, config.build({}), tuple(range(pairs)))
    return graph


def measure(pairs: int, cache: Path, executor: str, jobs: int, what: str) -> dict[str, float]:
    """One cold run, or one plan of what is cached, in this process."""
    from rille.pipeline.engine import scheduler
    from rille.pipeline.engine.memory.limits import resident
    from rille.pipeline.engine.store.base import Store

    before = resident()
    from rille.pipeline.engine.code_digest import tree_digest

    tree_digest()  # once a process, whatever its size: reading the sources
    cpu, wall = time.process_time(), time.perf_counter()
    graph = graph_of(pairs)
    laid = time.perf_counter() - wall
    if what == "plan":
        result = scheduler.run(graph, Store(cache), scheduler.RunOptions(dry=True))
    else:
        ledger = cache.parent / "run" / "ledger.jsonl"
        result = scheduler.run(graph, Store(cache), scheduler.RunOptions(executor=executor, jobs=jobs, ledger=ledger))
    result.check()
    spent = time.perf_counter() - wall
    n = len(graph.nodes)
    inside = sum(h.seconds for h in graph.nodes)
    rests = [h.rest for h in graph.nodes[-50:] if h.rest]
    return {
        "nodes": n,
        "computed": result.total().computed,
        "lay out": 1e3 * laid / n,
        "wall": 1e3 * spent / n,
        "cpu": 1e3 * (time.process_time() - cpu) / n,
        "overhead": 1e3 * (spent - inside / jobs) / n,
        "inside": 1e3 * inside / n,
        "client": resident(),
        "grown": (resident() - before) / n,
        "worker": max(rests, default=0),
    }


def entries(folder: Path) -> tuple[int, Path]:
    """The greatest number of entries of any folder, and which."""
    counts: Counter[Path] = Counter()
    for at, folders, files in os.walk(folder):
        counts[Path(at)] = len(folders) + len(files)
    path, most = counts.most_common(1)[0]
    return most, path.relative_to(folder)


def child(pairs: int, folder: Path, how: list[str], what: str, *, flush: bool) -> dict[str, float]:
    """:func:`measure` in a process of its own."""
    here = Path(__file__).resolve().parent.parent
    path = os.pathsep.join([str(folder / "stages"), str(here), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(Path(__file__).resolve()), "--pairs", str(pairs), *how]
    done = subprocess.run(
        [*command, "--folder", str(folder), "--what", what],
        env={**os.environ, "PYTHONPATH": path, UNFLUSHED: "" if flush else "1"},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    found: dict[str, float] = json.loads(done.stdout)
    return found


def table(sizes: list[int], how: list[str], within: Path, *, flush: bool) -> Iterator[str]:
    """Lines of the figures of several sizes, each as soon as it is known."""
    yield (
        f"{'pairs':>6s} {'nodes':>7s} {'plan':>9s} {'its cpu':>9s} {'overhead':>9s} {'client':>9s} {'in task':>9s} "
        f"{'client memory':>20s} {'worker':>8s} {'most entries of a folder':>26s}"
    )
    for pairs in sizes:
        folder = within / str(pairs)
        write_stages(folder / "stages")
        cold = child(pairs, folder, how, "run", flush=flush)
        assert cold["computed"] == cold["nodes"]
        warm = child(pairs, folder, how, "plan", flush=flush)
        assert (warm["computed"], warm["nodes"]) == (0, cold["nodes"])
        most, where = entries(folder)
        yield (
            f"{pairs:6d} {cold['nodes']:7.0f} {warm['wall']:6.3f} ms {warm['cpu']:6.3f} ms "
            f"{cold['overhead']:6.2f} ms {cold['cpu']:6.2f} ms {cold['inside']:6.2f} ms "
            f"{cold['client'] / 1e6:6.0f} MB ({cold['grown'] / 1e3:4.1f} kB/n) {cold['worker'] / 1e6:5.0f} MB "
            f"{most:6d} {where}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=2000, help="of the largest size; a quarter of it comes first")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--executor", choices=("dask", "inline"), default="dask")
    parser.add_argument("--folder", type=Path, help="where to work (kept); a temporary one by default")
    parser.add_argument("--flush", action="store_true", help="flush to the disk, as a real run does")
    parser.add_argument("--what", choices=("all", "run", "plan"), default="all", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.what != "all":
        from rille.pipeline.engine.runtime.environment import prepare_environment

        prepare_environment()
        print(json.dumps(measure(given.pairs, given.folder / "cache", given.executor, given.jobs, given.what)))
        return
    sizes = [max(2, given.pairs // 4), given.pairs]
    with tempfile.TemporaryDirectory() as temporary:
        how = ["--executor", given.executor, "--jobs", str(given.jobs)]
        for line in table(sizes, how, given.folder or Path(temporary), flush=given.flush):
            print(line, flush=True)


if __name__ == "__main__":
    main()
