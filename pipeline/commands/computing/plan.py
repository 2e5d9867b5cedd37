"""``rille plan``: tasks that a run would compute or take from the cache, and why; ``rille graph``: its stages.

Nothing is computed.

Tasks that depend on results still to come (choice of basic pairs, extent of the world) are laid out by these results of
the last run. A task that depends on one to be computed counts as to be computed, although the run will find it in the
cache if its input is the same as before, to the bit. The plan is thus an upper bound.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from itertools import chain
from typing import Annotated

from cyclopts import Parameter

from rille.pipeline.engine import memory
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.memory import words
from rille.pipeline.engine.plain import brief
from rille.pipeline.engine.run import Result, RunOptions, run
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.view import RunView
from rille.pipeline.flow import unread
from rille.pipeline.flow.closed_loop import dataflow
from rille.pipeline.runs import part_of_run, run_files
from rille.pipeline.runs.crate import resolved
from rille.pipeline.runs.options import FLAG, Options, Settings, cache_folder
from rille.pipeline.runs.session import late, memory_limit, settings, settings_of_run
from rille.stages.core.quantities import count, some


def plan(
    seq: str = "mockup",
    *,
    options: Options = Options(),
    verbose: Annotated[bool, FLAG, Parameter(name=["--verbose", "-v"])] = False,
) -> None:
    """Show what `reconstruct` would compute and why, and what is cached; nothing is computed.

    Parameters
    ----------
    seq
        As for reconstruct.
    verbose
        Each task with its reason.
    """
    seq, options, _ = resolved(seq, options)
    settled = settings_of_run(seq, options)
    graph, config = Graph(cut=part_of_run.cut(options.until, options.only)), settled.config
    store = Store(cache_folder(options.cache))
    products, drive = dataflow(graph, settled.sequence, config, settled.frames)

    def outputs() -> None:
        view = late(RunView(**vars(settled), products=products, only=options.only), drive)
        if graph.cut is not None:
            run_files.lay_out(graph, view, {})
        elif not graph.waiting:  # else some inputs are unknown, so they belong to the unknown tasks
            run_files.plan(graph, view)

    graph.last = outputs
    result = run(graph, store, RunOptions(dry=True, force=options.force))
    result.check()
    # Unknown tasks may read a parameter, or those outside of the part that is made.
    if not (result.unknown or graph.cut) and (lost := unread.unread(settled.given, config, graph)):
        raise unread.error(lost, config)
    budget = memory.budget(options.executor, memory_limit(options), options.jobs)
    planned = memory.Estimates().planned(graph)
    workers = budget.workers(max((needs for _, needs in planned), default=0.0))
    # The refusal comes last, after the table with its task.
    for line in chain(describe(graph, result, workers, verbose=verbose), needs(planned, budget)):
        print(line)


def needs(planned: list[tuple[Handle, float]], budget: memory.Budget) -> Iterable[str]:
    """A line on the memory [bytes] of the tasks to be computed, if there are any.

    Raises
    ------
    ConfigError
        A task does not fit into memory, even alone.
    """
    if planned:
        handle, largest = max(planned, key=lambda task: task[1])
        room = f"room for {count(budget.workers(largest), 'worker')} in {words(budget.limit)}"
        yield f"memory: the largest task, {handle.label}, is estimated to need {words(largest)}; {room}"
        if (refused := budget.refusal(handle, largest)) is not None:
            raise refused.at(handle.label)


def describe(graph: Graph, result: Result, workers: int, *, verbose: bool = False) -> Iterable[str]:
    """Lines of the plan: a table by stage with reasons, totals, and assumptions."""
    by_stage: dict[str, list[Handle]] = defaultdict(list)
    for handle in graph.nodes:
        by_stage[handle.stage].append(handle)
    yield f"{'stage':19s} {'cached':>7s} {'to do':>7s}  why"
    for stage, handles in by_stage.items():
        planned = [h for h in handles if h.status == "planned"]
        reasons = [] if verbose else _reasons(planned)
        yield f"{stage:19s} {len(handles) - len(planned):7d} {len(planned):7d}  {'; '.join(reasons)}".rstrip()
        if verbose:
            yield from (f"    {h.label}: {h.reason}" for h in planned)
    yield from _totals(graph, result, workers)


def _reasons(planned: list[Handle]) -> list[str]:
    """The reasons of a stage's tasks with their numbers, own ones first, the most frequent first."""
    own = Counter(h.reason for h in planned if not h.cause)
    listed = [f"{brief(reason, 80)} ({n})" for reason, n in own.most_common(3)]
    if len(own) > len(listed):
        listed.append(f"{len(own) - len(listed)} other reasons")
    follow = len(planned) - own.total()
    return listed + ([f"an input is to be computed ({follow})"] if follow else [])


def _totals(graph: Graph, result: Result, workers: int) -> Iterable[str]:
    planned = [h for h in graph.nodes if h.status == "planned"]
    cached = len(graph.nodes) - len(planned)
    line = f"{len(graph.nodes)} tasks known: {cached} cached, {len(planned)} to do"
    timed = [h.earlier.seconds for h in planned if h.earlier is not None]
    untimed = sorted({h.stage for h in planned if h.earlier is None})
    if timed:
        line += f", about {sum(timed) / workers:.0f} s with {count(workers, 'worker')} by earlier runs"
        line += f" (never timed: {', '.join(untimed)})" if untimed else ""
    yield line
    if result.assumed:
        names = some(list(dict.fromkeys(result.assumed)), 3)
        yield f"laid out by the last run's {names}, which will be computed anew: the layout may change"
    yield from _unknown(result)


def _unknown(result: Result) -> Iterable[str]:
    if result.unknown:
        yield f"more tasks follow, known only after {some(list(dict.fromkeys(result.unknown)), 3)}"


def graph(seq: str = "mockup", *, options: Settings = Settings()) -> None:
    """Draw the stages of a run, the number of their tasks, and what each reads.

    What depends on results that are still to come is drawn as the last run had it; where there was none, the title says
    after what more tasks follow.
    Prints text for Graphviz: rille graph SEQ | dot -Tsvg > graph.svg.

    Parameters
    ----------
    seq
        As for reconstruct.
    """
    seq, options, _ = resolved(seq, options)
    settled = settings(seq, options)
    laid_out = Graph()
    dataflow(laid_out, settled.sequence, settled.config, settled.frames)
    result = run(laid_out, Store(cache_folder(options.cache)), RunOptions(dry=True))
    result.check()
    print(dot(laid_out, result))


def dot(graph: Graph, result: Result) -> str:
    """Graphviz text: a box for each stage with the number of its tasks, an arrow for each stage that it reads, and a
    title if there are unknown tasks."""
    tasks = Counter(handle.stage for handle in graph.nodes)
    arrows = dict.fromkeys((source.stage, handle.stage) for handle in graph.nodes for source in handle.upstream())
    boxes = (f'  "{stage}" [label="{stage} x {count}"];' for stage, count in tasks.items())
    title = (f'  label="{text}";' for text in _unknown(result))
    return "\n".join(["digraph {", *title, *boxes, *(f'  "{a}" -> "{b}";' for a, b in arrows if a != b), "}"])
