"""Runs a graph: looks everything up on the client, submits only what is missing, expands as results arrive.

>>> result = run(graph, Store("cache"), RunOptions(jobs=2, progress=progress.make("auto")))
>>> result.check()                       # raises the first failure, with its stage and label
>>> result.counts["locus"].cached
8

What is known of the graph is submitted ahead: a task whose inputs are with the executor, too, waits there for them, so
that workers need not wait for this process. A run that finds everything starts no worker. With ``dry=True`` nothing is
computed: ``status`` of the handles is ``cached`` or ``planned``, and ``reason`` says why (``rille plan``). What depends
on results still to come is laid out by those of an earlier run where there was one (``Result.assumed``), else it is not
known (``Result.unknown``).

What a stage raises is not tried again (but for ``OSError``: :mod:`rille.pipeline.engine.task`), and what depends on it
is skipped. Where the data do not determine an answer (:class:`~rille.stages.core.errors.DegenerateError`) everything
else finishes: the run has a hole. After any other error nothing new is begun, unless with ``keep_going``. An artifact
that is found damaged, or gone, when a task reads it is computed again, and the task after it. A task that kills its
worker process is tried three times. In every case the ledger has one line for each node that is missing, with the
reason.
"""

from __future__ import annotations

import gc
import heapq
import math
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from rille.pipeline.engine import estimate, provenance
from rille.pipeline.engine.events import Ledger
from rille.pipeline.engine.executors.base import Executor, Failed, Given, NotBegun, Task, light, make
from rille.pipeline.engine.executors.base import known as check
from rille.pipeline.engine.failures import translated
from rille.pipeline.engine.graph import Expansion, Graph, Handle
from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.memory import cost_model
from rille.pipeline.engine.memory.admission import Admission, Waiting, account, largest
from rille.pipeline.engine.memory.cost_model import input_bytes
from rille.pipeline.engine.plain import some
from rille.pipeline.engine.progress import Progress
from rille.pipeline.engine.runtime.environment import cores
from rille.pipeline.engine.runtime.interrupts import Interrupts
from rille.pipeline.engine.spec import Refs, each, key_of, recipe
from rille.pipeline.engine.store.base import GoneError, NonDeterministicError, Store
from rille.pipeline.engine.store.lazy_arrays import DamagedError
from rille.pipeline.engine.task import CodeChangedError, Outcome
from rille.stages.core.errors import DegenerateError, RilleError

MOST_PUT_BACKS = 3
"""Times that a task is put back because its input has gone."""


class TaskError(RilleError):
    """A task failed; its own error is the cause (``__cause__``)."""


@dataclass
class Counts:
    """Number of nodes of one stage by outcome; ``seconds`` is the sum over those computed now."""

    computed: int = 0
    cached: int = 0
    failed: int = 0
    skipped: int = 0
    planned: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Failure:
    """A task that failed: its label and stage, the original exception and the text of its traceback."""

    label: str
    stage: str
    error: BaseException
    traceback: str


@dataclass
class Result:
    """Outcome of a run.

    Of a dry run: ``assumed`` are labels whose earlier result served to lay out what follows, ``unknown`` those that
    hide it.
    """

    counts: dict[str, Counts] = field(default_factory=dict)
    failures: list[Failure] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    seconds: float = 0.0
    executor_started: bool = False
    interrupted: bool = False

    @property
    def ok(self) -> bool:
        """Whether it came to its end, nothing failed and nothing was left out."""
        return not self.interrupted and not self.failures and not any(c.skipped for c in self.counts.values())

    def total(self) -> Counts:
        """Counts over all stages."""
        return Counts(**{f.name: sum(getattr(c, f.name) for c in self.counts.values()) for f in fields(Counts)})

    def check(self, *, holes: bool = False) -> None:
        """Raise the first failure as one line with its label: the original error of Rille, or what wraps another.

        With ``holes`` failures that lie in the data are passed over.
        """
        failures = [f for f in self.failures if not (holes and is_hole(f.error))]
        if failures:
            first = failures[0]
            error = first.error
            if (known := translated(error)) is not None:
                raise known.at(first.label) from error
            raise TaskError(
                "RIL-534", f"{first.label} (stage {first.stage}): {type(error).__name__}: {error}"
            ) from error


def is_hole(error: BaseException) -> bool:
    """Whether a failure lies in the data, so that what does not depend on it is delivered all the same."""
    return isinstance(error, DegenerateError)


@dataclass(frozen=True)
class RunOptions:
    """How a graph is run.

    Parameters
    ----------
    executor : ``dask`` (a cluster of this machine), the address of a running dask scheduler (``tcp://...``), a
        ``Client`` of dask, or ``inline``.
    jobs : worker processes; None is one a core.
    keep_going : finish all tasks that do not depend on a failure, of whatever kind.
    force : names of stages to compute again though they are there; the digests must agree.
    dry : look up only.
    ledger : file of JSON lines, one a node, written as they resolve.
    progress : receives every step of the run.
    memory_limit : bytes that this process and its workers may take together; None is what is free here.
    survey : lays the same graph out anew, to look ahead: what cannot fit into memory is refused before anything runs.
    """

    executor: Any = "dask"
    jobs: int | None = None
    keep_going: bool = False
    force: Collection[str] = ()
    dry: bool = False
    ledger: Path | None = None
    progress: Progress = field(default_factory=Progress)
    memory_limit: float | None = None
    survey: Callable[[], Graph] | None = None


_DEFAULTS = RunOptions()


def run(graph: Graph, store: Store, options: RunOptions = _DEFAULTS) -> Result:
    """Bring every node of a graph to an artifact in ``store``; its handles are filled in, expansions may add nodes.

    Raises
    ------
    MemoryRefusedError
        A task that can be foreseen does not fit, even alone.
    KeyboardInterrupt
        Interrupted; running tasks are killed, committed artifacts stay.
    """
    return _Run(graph, store, options).go()


class _Run:
    def __init__(self, graph: Graph, store: Store, options: RunOptions) -> None:
        self.graph, self.store, self.options = graph, store, options
        self.dry, self.force, self.progress = options.dry, frozenset(options.force), options.progress
        self.ledger = Ledger(options.ledger)
        self.admission: Admission | None = None
        self.executor: Executor | None = None
        self.result = Result()
        self.stopped = ""
        self.admitted = self.expanded = 0
        self.waits: Counter[int] = Counter()
        """How many distinct inputs of a node are not resolved yet; nodes without any are left out."""
        self.out: dict[int, Handle] = {}
        """With the executor."""
        self.dependants: dict[int, list[Handle]] = defaultdict(list)
        self.ready: list[int] = []
        self.begun: set[str] = set()
        self.warm: set[str] = set()
        """Stages of which a task was submitted, and of which one has come back."""
        self.missing = Waiting()
        """Looked up, not found, not submitted."""
        self.chainable = Waiting()
        """Nodes that wait only for what is with the executor."""
        self.to_compute: dict[str, list[Handle]] = {}
        """To be computed, by key; further nodes of the same key wait for the first."""
        self.blocked: dict[str, set[str]] = {}
        """Keys that must be computed again before the task of a key can be."""
        self.put_backs: dict[str, int] = defaultdict(int)
        self.recomputed: dict[int, str] = {}
        """Nodes that are resolved and computed again, with their status."""
        self.expansions: list[tuple[list[Handle], Expansion, bool]] = []
        self.hints = store.hints(graph.sequence)
        self.known = provenance.Known(self.hints, graph.choice)

    def go(self) -> Result:
        begin = time.perf_counter()
        gc.freeze()  # what is there need not be searched for garbage again and again as the graph grows
        try:
            with Interrupts() as interrupts:
                self._loop(interrupts)
                self._leave_out()
        except BaseException:
            self.result.interrupted = True
            self._close(kill=True)
            raise
        else:
            self._close(kill=False)
            if not self.dry:
                self.store.note(h.ref for h in self.graph.nodes if h.ref is not None)
                estimate.remember(self.hints, self.progress.estimate)
                cost_model.remember(self.hints, self.graph.nodes)
        finally:
            gc.unfreeze()
            if not self.dry:
                self.known.save(self.graph.nodes)
            self.result.seconds = time.perf_counter() - begin
            # Without "ok" a ledger is that of a run which did not come to its end.
            ended = {} if self.result.interrupted else {"ok": self.result.ok}
            self.ledger.run(seconds=round(self.result.seconds, 3), **ended)
            self.progress.close(self.result)
            self.ledger.close()
        return self.result

    def _close(self, kill: bool) -> None:
        if self.executor is not None:
            self.executor.close(kill=kill)

    def _loop(self, interrupts: Interrupts) -> None:
        self.progress.open(self.graph, estimate.recall(self.hints), self.options.jobs or cores())
        self.store.survey(_sequence(self.graph))
        while True:
            self._settle()
            # An interrupt in a finaliser or a callback of a weak reference was remembered, not raised.
            interrupts.check()
            self._submit()
            if not self.out:
                return
            assert self.executor is not None
            for number, outcome in self.executor.wait():
                self._arrive(self.out.pop(number), outcome)

    # -- what needs no worker -----------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Admit, look up and expand until only what must be computed is left."""
        while not self.stopped:
            self._admit()
            if self.ready:
                self._look_up(self.graph.nodes[heapq.heappop(self.ready)])
            elif not self._expand() and not self._end_plan():
                return

    def _admit(self) -> None:
        for handle in self.graph.nodes[self.admitted :]:
            self.admitted += 1
            upstream = {h.index: h for h in handle.upstream()}
            broken = self._broken(handle)
            for up in upstream.values():
                if up.status in ("pending", "running"):
                    self.waits[handle.index] += 1
                    self.dependants[up.index].append(handle)
            if broken is not None:
                self._break(handle, broken)
            elif not self.waits[handle.index]:
                heapq.heappush(self.ready, handle.index)
            else:
                self._chain(handle)
        # The graph grows while it runs: both lists are taken up from where the last look ended.
        self.expansions += self.graph.expansions[self.expanded :]
        self.expanded = len(self.graph.expansions)

    def _look_up(self, handle: Handle) -> None:
        refs = handle.refs()
        handle.key = key = key_of(handle.spec, refs)
        forced = handle.stage in self.force
        ref = None if forced else self.store.lookup(handle.stage, key, use=not self.dry)
        if ref is not None:
            handle.ref = ref
            self._resolve(handle, "cached")
            return
        self._explain(handle, refs)
        if self.dry:
            self._resolve(handle, "planned")
        elif key in self.to_compute:
            self.to_compute[key].append(handle)
        else:
            self.to_compute[key] = [handle]
            self.missing.push(handle)

    def _explain(self, handle: Handle, refs: Refs) -> None:
        if handle.stage in self.force:
            handle.reason = "forced"
        else:
            made = recipe(handle.spec, refs)
            handle.reason = self.known.reason(self.store, handle.stage, handle.label, handle.key, made)

    def _expand(self) -> bool:
        """Call the first expansion whose handles are done; whether there was one."""
        for i, (handles, fn, holes) in enumerate(self.expansions):
            if all(h.done or h.earlier or (holes and h.status in _FATE) for h in handles):
                del self.expansions[i]
                assumed = [h.label for h in handles if h.earlier and not h.done]
                self.result.assumed += assumed
                before = len(self.graph.nodes)
                try:
                    fn(*(h.ref or h.earlier for h in handles))
                except Exception as error:
                    if assumed:  # what was found with other parameters or images does not fit: no more can be said
                        self.result.unknown += assumed
                    else:
                        self._failed(Failure(f"plan after {_labels(handles)}", "", error, Failed.of(error).traceback))
                self.ledger.expansion([h.label for h in handles], [h.label for h in self.graph.nodes[before:]])
                return True
        return False

    def _end_plan(self) -> bool:
        """Lay out what comes last, once everything else is laid out or will never be; whether there was such."""
        last = self.graph.last
        if last is None or (self.expansions and (self.to_compute or self.out)):
            return False
        self.graph.last = None
        last()
        return True

    # -- what does ----------------------------------------------------------------------------------------------

    def _submit(self) -> None:
        """Keep the executor supplied, with many tasks at a time: what is missing, and what waits for tasks it has."""
        if self.missing and not self.stopped and self.executor is None:
            self._begin()
        if self.stopped:
            self.missing.clear()
            self.chainable.clear()
            self.blocked.clear()
        if self.executor is not None and not self.stopped and self.executor.free():
            batch = [self._send(handle) for handle in self._choose(self.executor)]
            if batch:
                self.executor.submit(batch)

    def _choose(self, executor: Executor) -> Iterator[Handle]:
        """Tasks to be sent now, each when the one before is; none until there is room for several."""
        assert self.admission is not None
        admission, most = self.admission, executor.slots * executor.depth
        admission.together = executor.slots
        # Refill at three quarters: tasks that are sent together cost dask a third of the time of tasks sent one by one.
        at_work, few = sum(not self.waits[index] for index in self.out), most - most // 4
        if at_work < few:
            while at_work < most and not self.stopped:
                handle = self.missing.take(self.begun - self.warm, admission.fits, last=at_work < executor.slots)
                if handle is None:
                    break
                if (refused := admission.refusal(handle)) is not None:
                    self._land(handle, Failed(refused, ""))
                else:
                    at_work += 1
                    yield handle
        if len(self.out) < few:
            while len(self.out) < most and not self.stopped:
                handle = self.chainable.take(self.begun - self.warm, admission.fits, last=False)
                if handle is None:
                    break
                if self._waits_for_sent(handle) and admission.refusal(handle) is None:
                    yield handle

    def _waits_for_sent(self, handle: Handle) -> bool:
        """Whether all that a node waits for is with the executor."""
        return 0 < self.waits[handle.index] <= len(self.out) and all(
            h.done or h.index in self.out for h in handle.upstream()
        )

    def _chain(self, handle: Handle) -> None:
        if not self.dry and self._waits_for_sent(handle):
            self.chainable.push(handle)

    def _send(self, handle: Handle) -> Task:
        assert self.admission is not None
        self.begun.add(handle.stage)
        self.admission.begin(handle)
        handle.status = "running"
        self.out[handle.index] = handle
        self.progress.running(handle)
        for dependant in self.dependants.get(handle.index, ()):
            if dependant.status == "pending":
                self._chain(dependant)
        root, force = self.store.root, handle.stage in self.force
        return Task(handle.index, root, handle.spec, each(_given, handle.inputs), handle.key, force)

    def _arrive(self, handle: Handle, outcome: Outcome | Failed | NotBegun) -> None:
        """Take up what the executor gives back."""
        assert self.admission is not None
        self.admission.end(handle)
        handle.status = "pending"
        chained, all_known = not handle.key, not self.waits[handle.index]
        if chained and all_known and self._broken(handle) is None:
            handle.key = key_of(handle.spec, handle.refs())
        if isinstance(outcome, Outcome):
            # The worker computed the key from its own source files: they were edited during the run, or differ there.
            if handle.key and outcome.ref.key != handle.key:
                outcome = Failed(CodeChangedError("RIL-870", "a worker's source code is not that of this process"), "")
            else:
                handle.key = outcome.ref.key
                if chained and all_known and not outcome.cached:
                    self._explain(handle, handle.refs())
        if isinstance(outcome, NotBegun) or not handle.key:
            self._take_back(handle)
        else:
            self._land(handle, outcome)

    def _take_back(self, handle: Handle) -> None:
        """Treat a task that was not begun, or whose input is not known here yet, as if it had never been sent."""
        again = [handle, *(h for h in self.to_compute.pop(handle.key, ()) if h is not handle)]
        handle.key = ""
        broken = self._broken(handle)
        if broken is not None:
            self._break(handle, broken)
        for node in again:
            if node.status != "pending":
                continue
            if self.waits[node.index]:
                self._chain(node)
            else:
                heapq.heappush(self.ready, node.index)

    @staticmethod
    def _broken(handle: Handle) -> Handle | None:
        """The first input that will not come, or in a plan is still to come."""
        return next((h for h in handle.upstream() if h.status in _FATE or h.status == "planned"), None)

    def _begin(self) -> None:
        """Look ahead, share the memory out, and start the workers that it leaves room for."""
        kind = self.options.executor
        check(kind, self.options.jobs)
        known, jobs = cost_model.recall(self.hints), self.options.jobs or cores()
        ahead = self._look_ahead()
        most = max(largest(ahead, known), *(known.foresee(h.spec, input_bytes(h)).most for h in self.missing))
        shares = account(known, self.options.memory_limit, kind, jobs, most)
        self.admission = Admission(known, shares, automatic=self.options.memory_limit is None)
        self.admission.check(ahead)
        # Before the workers start: a full or read-only disk should not cost that time.
        self.store.writable()
        amounts = {k: round(v) for k, v in vars(shares).items() if math.isfinite(v)}
        name = kind if isinstance(kind, str) else kind.scheduler.address
        self.ledger.run(executor=name, jobs=shares.workers, **amounts)
        self.executor = make(kind, shares.workers, self.store.root, shares.limit)
        self.result.executor_started = True
        if self.executor.pages:
            self.progress.detail(self.executor.pages)

    def _look_ahead(self) -> Graph:
        """The graph laid out anew and looked up, by the index that this run has read."""
        ahead = Graph() if self.options.survey is None else self.options.survey()
        # A run that looks up only, by the same code: what it foresees is what will be done.
        dry = _Run(ahead, self.store, RunOptions(force=self.force, dry=True))
        dry._settle()
        dry._leave_out()
        return ahead

    def _land(self, first: Handle, outcome: Outcome | Failed) -> None:
        key = first.key
        self.warm.add(first.stage)
        if isinstance(outcome, Failed) and self._put_back(first, outcome.error):
            return
        # Two labels may have one key (equal parameters and inputs): it is computed once, and both get it.
        others = [h for h in self.to_compute.pop(key, ()) if h is not first and h.index not in self.out]
        if not isinstance(outcome, Failed) and first.ref is not None and first.ref.digest != outcome.ref.digest:
            error = NonDeterministicError(
                "RIL-535", f"stage {first.stage} is not deterministic: another digest when healed"
            )
            outcome = Failed(error, "")
        if isinstance(outcome, Failed):
            for handle in (first, *others):
                handle.error, handle.ref = outcome.error, None
                handle.reason = f"{type(outcome.error).__name__}: {outcome.error}"
                self._resolve(handle, "failed")
            self._failed(Failure(first.label, first.stage, outcome.error, outcome.traceback))
        else:
            # What is unpickled brings names of its own each time.
            first.took = replace(outcome.took, worker=sys.intern(outcome.took.worker))
            ref = replace(outcome.ref, stage=first.stage, key=first.key)
            for handle in (first, *others):
                handle.ref = ref
                self._resolve(handle, "computed" if handle is first and not outcome.cached else "cached")

    def _put_back(self, handle: Handle, error: BaseException) -> bool:
        """Put a task back whose input was damaged or gone when it was read, behind what must be computed again."""
        if (
            not isinstance(error, DamagedError | GoneError)
            or self.put_backs[handle.key] >= MOST_PUT_BACKS
            or self.stopped
        ):
            return False
        self.put_backs[handle.key] += 1
        self.to_compute.setdefault(handle.key, [handle])
        # fresh: the index vouches for a file that nobody wrote since, which the disk has damaged.
        absent = {h.key: h for h in handle.upstream() if self.store.lookup(h.stage, h.key, fresh=True) is None}
        for key, source in absent.items():
            source.reason = "its artifact was found damaged, or gone, when it was read"
            if key not in self.to_compute:
                self.to_compute[key] = [source]
                self.recomputed[source.index], source.status = source.status, "pending"
                self.missing.push(source)
        if absent:
            self.blocked[handle.key] = set(absent)
        else:
            self.missing.push(handle)
        return True

    def _unblock(self, source: Handle) -> None:
        """Send on what waited for a node to be computed again, or leave it out where that did not succeed."""
        for waiting in [w for w, keys in self.blocked.items() if source.key in keys]:
            if not source.done:
                # Left out before, if it waited for another that was left out.
                if self.blocked.pop(waiting, None) is None:
                    continue
                for handle in self.to_compute.pop(waiting):
                    handle.status = "pending"
                    self._break(handle, source)
                continue
            self.blocked[waiting].discard(source.key)
            if not self.blocked[waiting]:
                del self.blocked[waiting]
                self.missing.push(self.to_compute[waiting][0])

    def _failed(self, failure: Failure) -> None:
        self.result.failures.append(failure)
        self.progress.failed(failure.label, failure.error)
        if not self.options.keep_going and not is_hole(failure.error):
            self.stopped = f"stopped after {failure.label} failed"
            if self.executor is not None:
                self.executor.halt()

    # -- what became of it --------------------------------------------------------------------------------------

    def _resolve(self, handle: Handle, status: str) -> None:
        handle.status = status
        self.chainable.discard(handle)
        if status == "planned":
            handle.earlier = self.known.latest(self.store, handle.stage, handle.label)
        counts = self.result.counts.setdefault(handle.stage, Counts())
        setattr(counts, status, getattr(counts, status) + 1)
        counts.seconds += handle.took.seconds
        self.ledger.write(handle)
        before = self.recomputed.pop(handle.index, None)
        if before is None:
            self.progress.resolved(handle)
        else:  # healed: it counts once, as what became of it last
            setattr(counts, before, getattr(counts, before) - 1)
        for dependant in self.dependants.pop(handle.index, []):
            self.waits[dependant.index] -= 1
            if not self.waits[dependant.index]:
                del self.waits[dependant.index]
            if not handle.done:
                self._break(dependant, handle)
            elif not self.waits[dependant.index] and dependant.status == "pending":
                self.chainable.discard(dependant)
                heapq.heappush(self.ready, dependant.index)
        self._unblock(handle)

    def _break(self, handle: Handle, by: Handle) -> None:
        """An input of ``handle`` will not come, or in a plan is still to come."""
        if handle.status != "pending":
            return
        planned, handle.ref = by.status == "planned", None
        handle.reason = f"input {by.label} is to be computed" if planned else f"{by.label} {_FATE[by.status]}"
        self._resolve(handle, "planned" if planned else "skipped")

    def _leave_out(self) -> None:
        """Account for everything that was not even begun."""
        self._admit()
        for handle in self.graph.nodes:
            if handle.status == "pending" and handle.index in self.recomputed:
                handle.status = self.recomputed[handle.index]
            elif handle.status == "pending":
                handle.reason = self.stopped
                self._resolve(handle, "skipped")
        for handles, *_ in self.expansions:
            missing = [h for h in handles if not h.done]
            self.result.unknown += [h.label for h in missing]
            self.ledger.note(f"plan after {_labels(handles)}", "planned" if self.dry else "skipped", _labels(missing))


def _sequence(graph: Graph) -> str:
    """Name of what the graph works on: its first task reads the first image, or what all images are made from."""
    first = graph.nodes[0].spec if graph.nodes else None
    return digest(None if first is None else [first.module, first.params, dict(first.args)])[:16]


def _given(handle: Handle) -> Given:
    """An input as it is handed over: what it is, or the number of the task that makes it."""
    return handle.index if handle.ref is None else light(handle.ref)


_FATE = {"failed": "failed", "skipped": "was skipped"}


def _labels(handles: list[Handle]) -> str:
    return some([h.label for h in handles], 3)
