"""Run a graph: look its tasks up in the cache, give the others to workers, continue its flows as results arrive.

>>> result = run(graph, Store("cache"), RunOptions(jobs=2, progress=events.make("auto")))
>>> result.check()                       # raises the first failure, with its stage and label
>>> result.counts["cached"]
8

Nodes are taken in the order of their creation. One whose inputs are there has a key, and is looked up; one whose inputs
are being computed is given to the workers as well, which chain it. A run that finds everything starts no worker. With
``dry=True`` nothing is computed: ``status`` of the handles is ``cached`` or ``planned``, and ``reason`` says why
(``rille plan``). Tasks that depend on results still to come are laid out by those of an earlier run
(``Result.assumed``); if there are none, these tasks are unknown (``Result.unknown``).

A stage that raises is not tried again (but for ``OSError``: :mod:`rille.pipeline.engine.task`), and the tasks that
depend on it are skipped. Where the data do not determine an answer
(:class:`~rille.stages.core.errors.DegenerateError`) everything else finishes: the run has a hole. After any other error
no task is begun, unless with ``keep_going``. An artifact that a task finds damaged, or gone, is computed again, and the
task after it. A task whose workers died is tried once more when nothing else runs. In every case the ledger has a line
for each missing node, with the reason.
"""

from __future__ import annotations

import heapq
import math
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rille.pipeline.engine import memory, provenance
from rille.pipeline.engine.caller import check
from rille.pipeline.engine.events import Ledger, Progress
from rille.pipeline.engine.failures import translated
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.runtime.interrupts import Interrupts
from rille.pipeline.engine.store.arrays import DamagedError
from rille.pipeline.engine.store.base import GoneError, Store, not_deterministic
from rille.pipeline.engine.task import Outcome, Refs, Took, code_changed, key_of, map_ports, recipe
from rille.pipeline.engine.workers import Call, Died, Ended, Failed, NotBegun, Workers, make, without_facts
from rille.stages.core.errors import DegenerateError, RilleError
from rille.stages.core.quantities import some

MISSING = ("failed", "skipped", "planned")
"""Statuses of an input after which a task is not begun."""


@dataclass(frozen=True)
class Failure:
    """A task that failed: its label and stage, and the original exception."""

    label: str
    stage: str
    error: BaseException


@dataclass
class Result:
    """Outcome of a run; ``counts`` are numbers of nodes by their status.

    Of a dry run: ``assumed`` are labels whose earlier results were used to lay out later tasks, ``unknown`` those whose
    later tasks are unknown. Of a cut graph: ``left_out`` counts by stage the known tasks that are not wanted.
    """

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    interrupted: bool = False

    @property
    def ok(self) -> bool:
        """Whether it came to its end, nothing failed and nothing was left out."""
        return not self.interrupted and not self.failures and not self.counts["skipped"]

    def check(self, *, holes: bool = False) -> None:
        """Raise the first failure as one line with its label: the original error of Rille, or one that wraps another.

        With ``holes`` failures that lie in the data are passed over.
        """
        failures = [f for f in self.failures if not (holes and isinstance(f.error, DegenerateError))]
        if failures:
            first, error = failures[0], failures[0].error
            if (known := translated(error)) is not None:
                raise known.at(first.label) from error
            text = f"{first.label} (stage {first.stage}): {type(error).__name__}: {error}"
            raise RilleError("RIL-534", text) from error


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
    kept : list that holds the workers after the run, for the next run with the same list; its maker ends them. None:
        the workers end with the run.
    """

    executor: Any = "dask"
    jobs: int | None = None
    keep_going: bool = False
    force: Collection[str] = ()
    dry: bool = False
    ledger: Path | None = None
    progress: Progress = field(default_factory=Progress)
    memory_limit: float | None = None
    kept: list[Workers] | None = None


def run(graph: Graph, store: Store, options: RunOptions = RunOptions()) -> Result:
    """Bring every node of a graph to an artifact in ``store``; its handles are filled in, flows may add nodes.

    Raises
    ------
    ConfigError
        A task that is known beforehand does not fit, even alone.
    KeyboardInterrupt
        Interrupted; running tasks are killed, committed artifacts stay.
    """
    return _Run(graph, store, options).go()


class _Run:
    """One run of a graph.

    Attributes
    ----------
    taken : nodes of the graph that were taken up, in order.
    retries : numbers of nodes to be taken up again, the least first.
    in_flight : with the workers, or in ``calls``.
    calls : what the workers are given next, all at once.
    suspects : numbers of nodes whose workers died; each is tried when nothing else runs, and is then in ``alone``.
    before : digests of artifacts that are computed again because they were damaged or gone, by number of the node.
    seen : nodes of a cut graph of which it is known whether they are wanted for themselves.
    """

    def __init__(self, graph: Graph, store: Store, options: RunOptions) -> None:
        self.graph, self.store, self.options = graph, store, options
        self.dry, self.force, self.progress = options.dry, frozenset(options.force), options.progress
        self.ledger, self.result = Ledger(options.ledger), Result()
        self.workers: Workers | None = None
        self.budget = memory.Budget(math.inf, 0.0)
        self.estimates, self.largest = memory.Estimates(), 0.0
        self.stopped = ""
        self.taken = 0
        self.retries: list[int] = []
        self.in_flight: dict[int, Handle] = {}
        self.calls: list[Call] = []
        self.suspects: list[int] = []
        self.alone: set[int] = set()
        self.heals: Counter[int] = Counter()
        self.before: dict[int, str] = {}
        self.history = provenance.History(store, graph.sequence, graph.choice)
        self.seen = 0
        self._mark_needed()

    def go(self) -> Result:
        begin = time.perf_counter()
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
        finally:
            self.result.counts.update(h.status for h in self.graph.nodes)
            if not self.dry:
                self.history.save(self.graph.nodes)
            self.result.seconds = time.perf_counter() - begin
            # Without "ok" a ledger is that of a run which did not come to its end.
            ended: dict[str, Any] = {} if self.result.interrupted else {"ok": self.result.ok}
            if self.graph.outdated:
                ended["outdated"] = [h.label for h in self.graph.nodes if h.index in self.graph.outdated]
            self.progress.close()  # first: a ledger on a full disk raises
            self.ledger.run(seconds=round(self.result.seconds, 3), **ended)
            self.ledger.close()
        return self.result

    def _close(self, *, kill: bool) -> None:
        if self.workers is None:
            return
        if kill or self.options.kept is None:
            self.workers.close(kill=kill)
        else:
            self.workers.cancel()
            self.options.kept.append(self.workers)

    def _loop(self, interrupts: Interrupts) -> None:
        self.progress.open()
        while True:
            while self._take() or self._go_on():
                # An interrupt in a finaliser or a callback of a weak reference was remembered, not raised.
                interrupts.check()
            if not self.in_flight:
                return
            workers = self.workers = self.workers or self._begin()
            workers.submit(self.calls)
            self.calls = []
            for number, ended in workers.wait():
                interrupts.check()
                if number in self.in_flight:  # not if the run was stopped by one before
                    self._land(self.in_flight.pop(number), ended)

    def _mark_needed(self) -> None:
        """Find what a cut graph asks for by now: wanted nodes, what flows wait for, and all that these need."""
        cut, nodes = self.graph.cut, self.graph.nodes
        if cut is None:
            return
        wanted = [h for h in nodes[self.seen :] if cut.wants(h)]
        wanted += [h for waiting in self.graph.waiting for h in waiting.handles]
        self.seen = len(nodes)
        while wanted:
            handle = wanted.pop()
            if handle.index not in self.graph.needed:
                self.graph.needed.add(handle.index)
                if handle.index < self.taken:
                    heapq.heappush(self.retries, handle.index)
                wanted += handle.upstream()

    # -- what becomes of a node ---------------------------------------------------------------------------------

    def _take(self) -> bool:
        """Take up the next node; whether there was one, and room for it."""
        # 2000: tasks that the workers have at a time, also those that wait for others: so many that no worker waits for
        # this process, and so few that dask's scheduler stays small.
        if self.stopped or len(self.in_flight) >= 2000:
            return False
        if self.suspects or not self.alone.isdisjoint(self.in_flight):
            if self.in_flight:
                return False
            number = heapq.heappop(self.suspects)
            self.alone.add(number)
            self._settle(self.graph.nodes[number])
        elif self.retries:
            self._settle(self.graph.nodes[heapq.heappop(self.retries)])
        elif self.taken < len(self.graph.nodes):
            self.taken += 1
            if self.graph.cut is None or self.taken - 1 in self.graph.needed:
                self._settle(self.graph.nodes[self.taken - 1])
        else:
            return False
        return True

    def _settle(self, handle: Handle) -> None:
        """Leave a node out, find it in the cache, or give it to the workers."""
        upstream = handle.upstream()
        missing = next((h for h in upstream if h.status in MISSING), None)
        if missing is not None:
            self._skip(handle, missing)
            return
        handle.key = ""
        if all(h.done for h in upstream):
            refs = handle.refs()
            handle.key = key_of(handle.spec, refs)
            if handle.stage not in self.force:
                handle.ref = self.store.lookup(handle.stage, handle.key, use=not self.dry)
                if handle.ref is not None:
                    self._resolve(handle, "cached")
                    return
            if handle.index not in self.before:
                self._explain(handle, refs)
        if self.dry:
            handle.earlier = self.history.latest(handle)
            self._resolve(handle, "planned")
        else:
            self._submit(handle, upstream)

    def _explain(self, handle: Handle, refs: Refs) -> None:
        forced = handle.stage in self.force
        handle.reason = "forced" if forced else self.history.why_missed(handle, recipe(handle.spec, refs))

    def _submit(self, handle: Handle, upstream: list[Handle]) -> None:
        needs = self.estimates.task(handle)
        refused = self.budget.refusal(handle, needs) if all(h.done for h in upstream) else None
        if refused is not None:
            self._fail(handle, Failed(refused))
            return
        if needs > self.largest:
            self.largest = needs
            if self.workers is not None:
                self.workers.scale(self.budget.workers(needs))
        # An input is its artifact without the facts, which the task reads, or the number of the call that makes it.
        given = map_ports(lambda h: h.index if h.ref is None else without_facts(h.ref), handle.inputs)
        force = handle.stage in self.force
        self.calls.append(Call(handle.index, self.store.root, handle.spec, given, handle.key, force))
        self.in_flight[handle.index] = handle

    def _begin(self) -> Workers:
        """Start as many workers as memory leaves room for.

        Raises
        ------
        ConfigError
            It has none for one of the tasks that are known before any result is.
        """
        kind = self.options.executor
        check(kind, self.options.jobs)
        self.budget = memory.budget(kind, self.options.memory_limit, self.options.jobs)
        for handle in self.in_flight.values():
            if (refused := self.budget.refusal(handle, self.estimates.task(handle))) is not None:
                raise refused.at(handle.label)
        # Before the workers start: a full or read-only disk should not cost that time.
        self.store.writable()
        jobs = self.budget.workers(self.largest)
        name = kind if isinstance(kind, str) else kind.scheduler.address
        self.ledger.run(executor=name, jobs=jobs)
        if not self.options.kept:
            return make(kind, jobs, self.store.root, self.budget.limit)
        workers = self.options.kept.pop()
        workers.scale(jobs)
        return workers

    def _resolve(self, handle: Handle, status: str, took: Took | None = None) -> None:
        handle.status, took = status, took or Took()
        self.ledger.write(handle, took)
        if handle.index not in self.before:  # a task that was computed again counts once
            known = self.graph.nodes if self.graph.cut is None else self.graph.needed
            self.progress.resolved(handle, len(known), took)

    def _skip(self, handle: Handle, missing: Handle) -> None:
        planned, handle.ref = missing.status == "planned", None
        fate = "failed" if missing.status == "failed" else "was skipped"
        handle.reason = f"input {missing.label} is to be computed" if planned else f"{missing.label} {fate}"
        handle.cause = missing.label
        if planned:
            handle.earlier = self.history.latest(handle)
        self._resolve(handle, "planned" if planned else "skipped")

    # -- what comes back ----------------------------------------------------------------------------------------

    def _land(self, handle: Handle, ended: Ended) -> None:
        """Take up the outcome of a call."""
        if isinstance(ended, Outcome):
            self._succeed(handle, ended)
        elif isinstance(ended, NotBegun):
            heapq.heappush(self.retries, handle.index)
        elif isinstance(ended, Died) and handle.index not in self.alone:
            heapq.heappush(self.suspects, handle.index)
        elif isinstance(ended, Died):
            self._fail(handle, Failed(self._culprit(handle, ended)))
        elif not self._heal(handle, ended.error):
            self._fail(handle, ended)

    def _succeed(self, handle: Handle, outcome: Outcome) -> None:
        if not handle.key and all(h.done for h in handle.upstream()):
            refs = handle.refs()
            handle.key = key_of(handle.spec, refs)
            if not outcome.cached:
                self._explain(handle, refs)
        # The worker computed the key from its own source files: they were edited during the run, or differ there.
        if handle.key not in ("", outcome.ref.key):
            self._fail(handle, Failed(code_changed()))
            return
        if self.before.get(handle.index, outcome.ref.digest) != outcome.ref.digest:
            self._fail(handle, Failed(not_deterministic(handle.stage, handle.label)))
            return
        # Unpickling makes a new object of each name: one for all saves memory.
        handle.ref, handle.key = replace(outcome.ref, stage=handle.stage), outcome.ref.key
        self._resolve(handle, "cached" if outcome.cached else "computed", outcome.took)

    def _culprit(self, handle: Handle, died: Died) -> RilleError:
        """The error of a task that ran alone as its workers died: out of memory, or a crash in native code."""
        at = f"; the last was ended at {died.memory}" if died.memory else ""
        needs = memory.words(self.estimates.task(handle))
        text = f"{died.workers} worker processes died while they ran it alone{at} (it is estimated to need {needs})"
        lower = handle.spec.stage.memory.lower
        change = f"change {' or '.join(lower)}, " if lower and died.memory else ""
        remedy = f"{change}give it more memory with fewer --jobs, or run it with --executor inline to see the crash"
        return RilleError("RIL-586", text, remedy=remedy)

    def _heal(self, handle: Handle, error: BaseException) -> bool:
        """Have inputs that were damaged or gone when a task read them computed again, and the task after them."""
        # 3: times that a task is begun again for such an input.
        if not isinstance(error, DamagedError | GoneError) or self.heals[handle.index] >= 3:
            return False
        self.heals[handle.index] += 1
        for source in {h.index: h for h in handle.upstream()}.values():
            if source.ref is not None and self.store.lookup(source.stage, source.key) is None:
                self.before[source.index] = source.ref.digest
                source.reason = "its artifact was found damaged, or gone, when it was read"
                source.ref, source.status = None, "pending"
                heapq.heappush(self.retries, source.index)
        heapq.heappush(self.retries, handle.index)
        return True

    def _fail(self, handle: Handle, failed: Failed) -> None:
        handle.error, handle.ref = failed.error, None
        if failed.error.__traceback__ is None and failed.traceback:  # from a worker: --debug prints notes
            failed.error.add_note(failed.traceback)
        handle.reason = f"{type(failed.error).__name__}: {failed.error}"
        self._resolve(handle, "failed")
        self._failed(Failure(handle.label, handle.stage, failed.error))

    def _failed(self, failure: Failure) -> None:
        self.result.failures.append(failure)
        self.progress.failed(failure.label, failure.error)
        # A failure that lies in the data is a hole: what does not depend on it is delivered all the same.
        if not self.options.keep_going and not isinstance(failure.error, DegenerateError):
            self.stopped = f"stopped after {failure.label} failed"
            self.in_flight.clear()
            self.calls.clear()
            if self.workers is not None:
                self.workers.cancel()

    # -- flows, and the end -------------------------------------------------------------------------------------

    def _go_on(self) -> bool:
        """Go on with the first flow whose handles are done, or lay out what comes last; whether there was such."""
        if self.stopped or self.suspects:
            return False
        for i, waiting in enumerate(self.graph.waiting):
            known = all(h.done or h.earlier or h.lost for h in waiting.handles)
            if waiting.go_on is not None and known:
                del self.graph.waiting[i]
                self._expand(waiting.handles, waiting.go_on)
                self._mark_needed()
                return True
        last = self.graph.last
        if last is None or (self.graph.waiting and self.in_flight):
            return False
        self.graph.last = None
        last()
        self._mark_needed()
        return True

    def _expand(self, handles: list[Handle], go_on: Callable[..., None]) -> None:
        assumed = [h.label for h in handles if h.earlier and not h.done]
        self.result.assumed += assumed
        try:
            go_on(*(h.ref or h.earlier for h in handles))
        except BrokenPipeError:  # the reader of the flow's output closed it
            raise
        except Exception as error:
            if assumed:  # assumed results of other parameters or images do not fit: the rest is unknown
                self.result.unknown += assumed
            else:
                label = f"plan after {_labels(handles)}"
                self.ledger.note(label, "failed", f"{type(error).__name__}: {error}")
                self._failed(Failure(label, "", error))

    def _leave_out(self) -> None:
        """Account for everything that was not even begun; drop the nodes that a cut graph does not ask for, and
        those of an outdated calibration that failed."""
        if self.graph.cut is not None:
            self.result.left_out.update(h.stage for h in self.graph.nodes if h.index not in self.graph.needed)
            self.graph.nodes[:] = [h for h in self.graph.nodes if h.index in self.graph.needed]
        for handle in self.graph.nodes:
            if handle.status == "pending":
                lost = next((h for h in handle.upstream() if h.status in MISSING), None)
                if lost is not None:
                    self._skip(handle, lost)
                else:
                    handle.reason = self.stopped
                    self._resolve(handle, "skipped")
        gone = {h for h in self.graph.nodes if h.index in self.graph.outdated and h.lost}
        self.graph.nodes[:] = [h for h in self.graph.nodes if h not in gone]
        self.result.failures = [f for f in self.result.failures if f.label not in {h.label for h in gone}]
        for waiting in self.graph.waiting:
            missing = [h for h in waiting.handles if not h.done]
            self.result.unknown += [h.label for h in missing]
            status = "planned" if self.dry else "skipped"
            self.ledger.note(f"plan after {_labels(waiting.handles)}", status, _labels(missing))


def _labels(handles: list[Handle]) -> str:
    return some([h.label for h in handles], 3)
