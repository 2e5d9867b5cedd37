"""Runs of toy graphs in this process: what is computed, what is cached, what is said about it."""

from __future__ import annotations

import io
import signal
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from raising import raises
from toys.chain import build
from toys.numbers import NumbersParams
from toys.scale import ScaleParams

from rille.pipeline.engine import events, keys, provenance
from rille.pipeline.engine import run as driver
from rille.pipeline.engine import workers as base
from rille.pipeline.engine.graph import Graph, Maybe
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.task import Spec, ensure, recipe
from rille.stages.core.declare import NoParams

NO = NoParams()


def run(cache, *, make=build, **options):
    graph = Graph()
    kwargs = {k: options.pop(k) for k in ("frames", "seed", "size", "offset") if k in options}
    make(graph, **kwargs)
    result = driver.run(graph, Store(cache), driver.RunOptions(executor=options.pop("executor", "inline"), **options))
    return graph, result


def statuses(graph):
    return {h.label: h.status for h in graph.nodes}


def digests(graph):
    return {h.label: h.ref.digest for h in graph.nodes}


def mischief(*what, after=True, **args):
    def make(graph):
        for w in what:
            node = graph.node("toys.mischief", w, NO, {"what": w, **args})
            if after:
                second = graph.node("toys.mischief", f"{w}/after", NO, {"what": "", "w": w}, inputs={"after": node})
                graph.node("toys.mischief", f"{w}/third", NO, {"what": "", "w": f"{w}/3"}, inputs={"after": second})

    return make


def test_computes_what_numpy_computes(cache):
    graph, result = run(cache)
    assert result.ok
    assert statuses(graph) == dict.fromkeys(statuses(graph), "computed")
    assert [h.label for h in graph.nodes][-2:] == ["scale/3", "total"]
    total = graph.nodes[-1]
    for frame, found in enumerate(Store(cache).open(total.ref)["sums"]):
        values = np.random.default_rng([0, frame]).normal(size=(40, 40)).astype(np.float32)
        values[0, 0] = np.nan
        assert found == np.nansum(2 * values, dtype=np.float64)
    assert total.ref.meta == {"count": 4, "extra": False}


def test_a_second_run_computes_nothing_and_starts_no_executor(cache, monkeypatch):
    first, _ = run(cache)
    monkeypatch.setattr(driver, "make", lambda *_: pytest.fail("an executor was started"))
    second, result = run(cache, executor="dask")
    assert set(statuses(second).values()) == {"cached"}
    assert digests(second) == digests(first)
    assert result.counts["cached"] == 9


@pytest.mark.parametrize(
    ("change", "computed", "reason"),
    [
        ({"offset": 1.0}, {"scale", "total"}, "params.offset 0.0 -> 1.0"),
        ({"seed": 1}, {"numbers", "scale", "total"}, "input values changed"),
        ({"frames": 5}, {"numbers", "scale", "total"}, "never computed"),
    ],
)
def test_exactly_what_changed_is_computed_again_and_why_is_said(cache, change, computed, reason):
    run(cache)
    graph, _ = run(cache, **change)
    assert {h.stage for h in graph.nodes if h.status == "computed"} == computed
    assert reason in {h.reason for h in graph.nodes if h.stage == "scale"}
    if change == {"frames": 5}:
        assert [h.label for h in graph.nodes if h.status == "computed"] == ["numbers/4", "scale/4", "total"]
        assert graph.nodes[-1].reason == "input parts has 5 instead of 4"
    else:
        assert graph.nodes[-1].reason == "input parts changed (4 of 4)"
    back, _ = run(cache)
    assert set(statuses(back).values()) == {"cached"}


def test_a_damaged_artifact_is_computed_again_and_nothing_else(cache):
    graph, _ = run(cache)
    before = digests(graph)
    victim = graph.nodes[1].ref
    (cache / victim.path).write_bytes(b"")
    graph, _ = run(cache)
    assert [h.label for h in graph.nodes if h.status == "computed"] == ["numbers/1"]
    assert graph.nodes[1].reason == "was computed before, its artifact is gone or damaged"
    assert digests(graph) == before


class Removing(base.Inline):
    """Removes artifacts just as the task ``last`` is given to it."""

    def __init__(self, *paths):
        super().__init__()
        self.paths = list(paths)

    def submit(self, calls):
        super().submit(calls)
        while self.paths and any(call.spec.label == "last" for call in calls):
            self.paths.pop().unlink()


def in_a_row(*whats, **first):
    """Tasks each of which reads the one before; ``first`` are arguments of the first."""

    def make(graph):
        node = graph.node("toys.mischief", whats[0], NO, {"what": "", **first})
        for what in whats[1:]:
            node = graph.node("toys.mischief", what, NO, {"what": "", "w": what}, inputs={"after": node})

    return make


@pytest.mark.parametrize("keep_going", [False, True])
def test_where_healing_fails_all_that_waits_is_left_out_and_told(cache, tmp_path, keep_going, monkeypatch):
    tally = tmp_path / "tally"
    earlier, _ = run(cache, make=in_a_row("first", "second", tally=str(tally)))
    tally.unlink()
    tally.mkdir()  # now the first task fails
    monkeypatch.setattr(driver, "make", lambda *_: Removing(*(cache / h.ref.path for h in earlier.nodes)))
    graph, result = run(
        cache,
        make=in_a_row("first", "second", "last", "rest", tally=str(tally)),
        keep_going=keep_going,
        ledger=tmp_path / "ledger.jsonl",
    )
    assert [f.label for f in result.failures] == ["first"]
    told = {row["label"]: (row["status"], row["reason"]) for row in events.read(tmp_path / "ledger.jsonl")}
    assert told.pop("first")[0] == "failed"
    by = {"second": "first failed", "last": "second was skipped", "rest": "last was skipped"}
    assert told == {label: ("skipped", reason) for label, reason in by.items()}
    assert not any(h.done for h in graph.nodes)


def test_what_waits_for_healing_goes_on_if_another_worker_has_healed_it(cache, tmp_path, monkeypatch):
    class Dying(Removing):
        """Its worker dies, once, after it has committed the task that others wait for."""

        died = False

        def wait(self):
            ((number, outcome),) = super().wait()
            if number == 0 and not self.died:
                self.died, outcome = True, base.NotBegun()
            return [(number, outcome)]

    earlier, _ = run(cache, make=in_a_row("first"))
    monkeypatch.setattr(driver, "make", lambda *_: Dying(cache / earlier.nodes[0].ref.path))
    graph, result = run(cache, make=in_a_row("first", "last"), ledger=tmp_path / "ledger.jsonl")
    assert result.ok
    assert statuses(graph) == {"first": "cached", "last": "computed"}
    assert [row["label"] for row in events.read(tmp_path / "ledger.jsonl")] == ["first", "last"], "one line a node"


def test_dry_run_computes_nothing_and_explains(cache):
    graph, _ = run(cache, dry=True)
    assert statuses(graph) == {f"numbers/{i}": "planned" for i in range(4)}
    assert not cache.exists()
    run(cache)
    graph, _ = run(cache, dry=True, offset=0.5)
    assert {h.status for h in graph.nodes if h.stage == "scale"} == {"planned"}
    assert [h.reason for h in graph.nodes[-2:]] == ["params.offset 0.0 -> 0.5", "input scale/0 is to be computed"]


LONG = [[k, 0.123456789] for k in range(9)]
IMAGE = {"sha256": "1" * 64, "frame": 2}


@pytest.mark.parametrize(
    ("then", "now", "words"),
    [
        ({"steps": LONG}, {"steps": [*LONG[:4], [4, 0.5], *LONG[5:]]}, "args.steps[4][1] 0.123456789 -> 0.5"),
        ({"steps": LONG}, {"steps": [*LONG[:8], [7, 0.5]]}, "args.steps[8][0] 8 -> 7 and 1 more of 18 values"),
        ({"steps": LONG}, {"steps": LONG[1:]}, "args.steps has 8 values instead of 9"),
        ({"at": [{"x": LONG}]}, {"at": [{"x": LONG[:-1]}]}, "args.at[0].x[8][0] 8 -> null and 1 more of 16 values"),
        ({"goal": [0.0, 1.0]}, {"goal": [0.0, 1.5]}, "args.goal [0.0, 1.0] -> [0.0, 1.5]"),
        ({"why": "w" * 70 + "a"}, {"why": "w" * 70 + "b"}, f"args.why ...{'w' * 20}a -> ...{'w' * 20}b"),
        (IMAGE, IMAGE | {"sha256": "2" * 64}, f"left/2.png: args.sha256 {'1' * 37}... -> {'2' * 37}..."),
    ],
)
def test_of_what_is_long_the_part_that_differs_is_named(then, now, words):
    same = {"params": {}, "inputs": {}, "code": {}, "env": {}, "version": 1, "format": 5}
    hints = {"path": "/data/left/2.png"} if "sha256" in now else {}
    assert provenance.differences({**same, "args": then}, {**same, "args": now, "hints": hints}) == [words]


def test_a_reason_names_the_file_that_changed(cache):
    def make(graph, seed):
        graph.node("toys.mischief", "image/2", NO, {"what": "", "sha256": str(seed)}, {"path": "/data/left/2.png"})

    run(cache, make=make, seed=1)
    graph, _ = run(cache, make=make, seed=2)
    reason = "left/2.png: args.sha256 1 -> 2"
    assert graph.nodes[0].reason == reason
    stored = Store(cache).manifest("mischief", graph.nodes[0].key)["provenance"]
    assert stored["hints"] == {"path": "/data/left/2.png"}
    assert provenance.differences({**stored, "args": {"what": "", "sha256": "1"}}, stored) == [reason]


def test_hints_and_labels_are_no_part_of_the_key(cache):
    a = Spec("toys.numbers", "a", NumbersParams(), {"frame": 1}, {"path": "/one"})
    b = Spec("toys.numbers", "b", NumbersParams(), {"frame": 1}, {"path": "/two"})
    c = Spec("toys.numbers", "a", NumbersParams(), {"frame": 2}, {"path": "/one"})
    assert not ensure(cache, a, {}).cached
    assert ensure(cache, b, {}).cached
    assert not ensure(cache, c, {}).cached


def test_without_keep_going_nothing_new_is_begun(cache, tmp_path):
    graph, result = run(cache, make=mischief("value", "fine"), ledger=tmp_path / "ledger.jsonl")
    assert statuses(graph) == {"value": "failed"} | dict.fromkeys(
        ("value/after", "value/third", "fine", "fine/after", "fine/third"), "skipped"
    )
    assert not result.ok
    rows = {r["label"]: r for r in events.read(tmp_path / "ledger.jsonl")}
    assert rows["value"]["error"] == {"type": "ValueError", "message": "negative depth"}
    assert rows["value/after"]["reason"] == "value failed"
    assert rows["value/third"]["reason"] == "value/after was skipped"
    assert rows["fine"]["reason"] == "stopped after value failed"


def test_with_keep_going_the_rest_finishes_and_the_ledger_accounts_for_all(cache, tmp_path):
    file = tmp_path / "ledger.jsonl"
    graph, result = run(cache, make=mischief("value", "degenerate", "fine"), keep_going=True, ledger=file)
    assert {h.label for h in graph.nodes if h.done} == {"fine", "fine/after", "fine/third"}
    assert (result.counts["computed"], result.counts["failed"], result.counts["skipped"]) == (3, 2, 4)
    rows = events.read(file)
    assert sorted(r["label"] for r in rows) == sorted(h.label for h in graph.nodes)
    assert {r["key"] for r in rows if r["status"] == "computed"} == {h.key for h in graph.nodes if h.done}
    assert all(r["digest"] and r["seconds"] > 0 for r in rows if r["status"] == "computed")


def test_what_the_data_do_not_determine_is_a_hole(cache):
    told = []

    def follow(wanted):
        refs = yield wanted
        told.append([ref is None for ref in refs])

    def make(graph):
        mischief("degenerate", "fine")(graph)
        graph.flow(follow(Maybe([graph.nodes[1], graph.nodes[4]])))
        graph.flow(follow([graph.nodes[1], graph.nodes[4]]))

    graph, result = run(cache, make=make)
    assert {h.label for h in graph.nodes if h.done} == {"fine", "fine/after", "fine/third"}
    assert told == [[True, False]]
    result.check(holes=True)
    with raises("RIL-899"):
        result.check()
    _, result = run(cache, make=mischief("degenerate", "value"))
    with raises("RIL-534"):
        result.check(holes=True)


def test_the_users_error_is_the_original_with_its_place(cache):
    _, result = run(cache, make=mischief("degenerate"))
    with raises("RIL-899") as caught:
        result.check()
    assert str(caught.value) == "degenerate: no texture in frame 7: choose other frames"
    _, result = run(cache, make=mischief("value"))
    with raises("RIL-534") as caught:
        result.check()
    assert isinstance(caught.value.__cause__, ValueError)
    assert "mischief.py" in "".join(traceback.format_exception(result.failures[0].error))


def test_input_output_errors_are_tried_three_times_others_once(cache, tmp_path, monkeypatch):
    monkeypatch.setattr("rille.pipeline.engine.task.PAUSES_SECONDS", (0.001, 0.001))
    _, result = run(cache, make=mischief("disk", tally=str(tmp_path / "disk")))
    assert result.ok
    assert (tmp_path / "disk").read_text() == "xxx"
    for what in ("value", "missing"):
        _, result = run(cache, make=mischief(what, tally=str(tmp_path / what)))
        assert not result.ok
        assert (tmp_path / what).read_text() == "x"


def test_a_flow_that_fails_is_a_failure_and_one_that_cannot_go_on_is_noted(cache, tmp_path):
    def follow(handle, then):
        yield handle
        then()

    def make(graph):
        node = graph.node("toys.numbers", "n", NumbersParams(), {"frame": 0})
        bad = graph.node("toys.mischief", "value", NO, {"what": "value"})
        graph.flow(follow(node, lambda: {}["basic"]))
        graph.flow(follow(bad, lambda: pytest.fail("called")))

    _, result = run(cache, make=make, keep_going=True, ledger=tmp_path / "l")
    assert [f.label for f in result.failures] == ["plan after n", "value"]
    assert events.read(tmp_path / "l")[-1] == {
        "label": "plan after value",
        "stage": "",
        "status": "skipped",
        "reason": "value",
    }


@pytest.fixture
def interruptible():
    """SIGINT as Python handles it: a shell's background job ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_where_python_forgets_it_stops_the_run_all_the_same(cache, tmp_path, capfd, interruptible, number):
    class Forgotten:
        def __del__(self):
            signal.raise_signal(number)
            time.sleep(0)  # the handler runs between two instructions

    done = []

    def make(graph):
        first = graph.node("toys.numbers", "first", NumbersParams(), {"frame": 0})

        def rest():
            yield first
            Forgotten()
            done.append(graph.node("toys.numbers", "second", NumbersParams(), {"frame": 1}))

        graph.flow(rest())

    with pytest.raises(KeyboardInterrupt):
        run(cache, make=make, ledger=tmp_path / "ledger.jsonl")
    assert "ok" not in events.facts(tmp_path / "ledger.jsonl"), "it did not come to its end"
    assert [node.status for node in done] == ["pending"], "the flow went on, the run did not"
    assert capfd.readouterr().err == ""
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    found, _ = run(cache, make=lambda graph: graph.node("toys.numbers", "first", NumbersParams(), {"frame": 0}))
    assert statuses(found) == {"first": "cached"}


def test_what_was_created_first_runs_first(cache, tmp_path):
    def make(graph):
        first = graph.node("toys.numbers", "a", NumbersParams(), {"frame": 0})
        graph.node("toys.scale", "b", ScaleParams(), inputs={"values": first})
        for frame, label in enumerate("cd", 1):
            graph.node("toys.numbers", label, NumbersParams(), {"frame": frame})

    run(cache, make=make, ledger=tmp_path / "l")
    assert [row["label"] for row in events.read(tmp_path / "l")] == ["a", "b", "c", "d"]


def test_a_miss_is_explained_against_the_most_similar_artifact(cache):
    run(cache)
    run(cache, seed=1, size=41)
    graph, _ = run(cache, size=42, dry=True)
    assert graph.nodes[0].reason == "params.size 40 -> 42"
    graph, _ = run(cache, seed=1, size=42, dry=True)
    assert graph.nodes[0].reason == "params.size 41 -> 42"


def test_force_computes_again_and_keeps_the_artifact(cache):
    first, _ = run(cache)
    second, _ = run(cache, force={"scale"})
    assert Counter(h.stage for h in second.nodes if h.status == "computed") == {"scale": 4}
    assert [h.ref for h in second.nodes] == [h.ref for h in first.nodes]
    assert second.nodes[4].reason == "forced"


def test_force_finds_a_stage_that_is_not_deterministic(cache):
    _, result = run(cache, make=mischief("random", after=False))
    assert result.ok
    _, result = run(cache, make=mischief("random", after=False), force={"mischief"})
    with raises("RIL-577"):
        result.check()
    assert maintenance.verify(Store(cache)) == (1, [])


def test_a_worker_with_other_code_refuses(cache):
    with raises("RIL-581"):
        ensure(cache, Spec("toys.numbers", "n", NumbersParams(), {"frame": 0}), {}, key="0" * 64)


def test_manifest_says_where_a_result_comes_from(cache):
    graph, _ = run(cache)
    scale = graph.nodes[4]
    about = Store(cache).manifest("scale", scale.key)["provenance"]
    assert about["params"] == {"offset": 0.0}
    assert about["inputs"] == {"values": graph.nodes[0].ref.digest}
    assert set(about["code"]) >= {"toys.scale", "toys.helper", "rille.stages.core.declare"}
    assert about["env"] == {"numpy": keys.version("numpy")}
    assert about["seconds"] >= 0
    assert about["peak_rss"] > 1e6


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda g, n: g.node("toys.numbers", "n", NumbersParams(), {"frame": 1}), "'n' is taken"),
        (lambda g, n: g.node("toys.numbers", "m", ScaleParams(), {}), "params are ScaleParams, not NumbersParams"),
        (lambda g, n: g.node("toys.scale", "m", ScaleParams()), r"missing inputs \['values'\]"),
        (lambda g, n: g.node("toys.scale", "m", ScaleParams(), inputs={"value": n}), r"unknown inputs \['value'\]"),
        (lambda g, n: g.node("toys.scale", "m", ScaleParams(), inputs={"values": [n]}), "values takes one handle"),
        (lambda g, n: g.node("toys.total", "m", NO, inputs={"parts": n}), "parts takes a list"),
    ],
)
def test_mistakes_in_the_graph_are_refused_at_once(call, words):
    graph = Graph()
    node = graph.node("toys.numbers", "n", NumbersParams(), {"frame": 0})
    with pytest.raises((ValueError, TypeError), match=words):
        call(graph, node)


def test_arguments_without_canonical_form_are_named(cache):
    spec = Spec("toys.numbers", "numbers/3", NumbersParams(), {"frame": np.int64(3)})
    with pytest.raises(TypeError, match=r"numbers/3\.args\.frame is a int64"):
        ensure(cache, spec, {})
    assert "hints" not in recipe(spec, {})


def test_a_ledger_that_cannot_be_written_is_named_and_the_bar_goes(cache):
    shown = events.Progress()
    shown.close = lambda: setattr(shown, "closed", True)
    with pytest.raises(OSError, match="/dev/full"):
        run(cache, make=mischief("fine"), ledger=Path("/dev/full"), progress=shown)
    assert shown.closed


@pytest.mark.parametrize("mode", ["plain", "quiet", "bar"])
def test_progress_speaks_on_its_stream_alone(cache, mode, capsys, monkeypatch):
    monkeypatch.setattr(events, "INTERVAL", 0.0)
    stream = io.StringIO()
    run(cache, make=mischief("fine", "value"), progress=events.make(mode, stream, "street"))
    text = stream.getvalue()
    if mode == "quiet":
        assert text == ""
    else:
        assert "rille: street: value failed (ValueError)" in text, "several runs may write to one stream"
    assert capsys.readouterr() == ("", "")


def test_no_workers_are_refused(cache):
    with raises("RIL-540"):
        run(cache, jobs=0)


def test_a_task_passes_few_modules_from_the_graph_to_its_artifact(cache):
    """Whoever follows a task reads these: a new station needs a reason."""
    graph, passed, room = Graph(), set(), f"{Path(driver.__file__).parent}/"

    def note(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(room) and frame.f_code.co_name != "<module>":
            passed.add(frame.f_code.co_filename.removeprefix(room))

    build(graph)
    sys.setprofile(note)
    try:
        driver.run(graph, Store(cache), driver.RunOptions(executor="inline")).check()
    finally:
        sys.setprofile(None)
    assert {"run.py", "task.py", "store/base.py"} <= passed
    assert len(passed) <= 15, sorted(passed)
