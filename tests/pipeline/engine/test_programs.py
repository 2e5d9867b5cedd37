"""Worker processes, crashes, interruptions and edits, with programs of their own."""

from __future__ import annotations

import asyncio
import json
import math
import multiprocessing
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import resource_tracker
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from distributed import Client, LocalCluster
from raising import raises
from toys.chain import build

from rille.pipeline.engine import caller, workers
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import ConfigError

HERE = Path(__file__).resolve().parent.parent


def start(cache, environment, *words, **options):
    command = [sys.executable, "-m", "toys.chain", str(cache), *words]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


def finish(process):
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])["nodes"]


HANGS = 50.0
"""Seconds after which a program counts as hanging; how soon it leaves is timed by the torture of the engine."""


def gone(children, within=HANGS):
    """Whether all processes have ended."""
    left = psutil.wait_procs(children, timeout=within)[1]
    return not [p for p in left if p.status() != psutil.STATUS_ZOMBIE]


def test_workers_give_the_same_bits_die_alone_and_leave_nobody_behind(cache, tmp_path):
    """One pool for several questions, because starting it is what takes the time."""
    plain = Graph()
    build(plain)
    driver.run(plain, Store(cache / "inline"), driver.RunOptions(executor="inline"))

    graph, tally = Graph(), tmp_path / "tally"
    build(graph)
    die = graph.node("toys.mischief", "die", NoParams(), {"what": "die", "tally": str(tally)})
    graph.node("toys.mischief", "after", NoParams(), {"what": "fine"}, inputs={"after": die})
    graph.node("toys.mischief", "unpicklable", NoParams(), {"what": "unpicklable"})
    result = driver.run(graph, Store(cache / "workers"), driver.RunOptions(executor="dask", jobs=2, keep_going=True))

    found = {h.label: h for h in graph.nodes}
    assert {h.label: h.ref.digest for h in plain.nodes} == {
        n: found[n].ref.digest for n in (h.label for h in plain.nodes)
    }
    assert tally.read_text() in ("xx", "xxx", "xxxx"), "two once nothing else ran; dask may count others' deaths, too"
    assert found["die"].error.code == "RIL-586"
    assert found["after"].reason == "die failed"
    assert "UnpicklableError: 1 and 2" in str(found["unpicklable"].error)
    assert "mischief.py" in "".join(found["unpicklable"].error.__notes__), "the traceback on the worker"
    assert (result.counts["failed"], result.counts["skipped"]) == (2, 1)
    children = [p for p in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]
    assert gone(children)


def test_interruption_while_workers_start_leaves_without_a_word(cache, program_environment):
    process = start(cache, program_environment, "dask", "sleep", start_new_session=True)
    process.stdout.readline()
    deadline = time.monotonic() + 30
    while len(children := psutil.Process(process.pid).children()) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=HANGS)
    assert (process.returncode, err) == (130, "")
    assert gone(children)


@pytest.mark.parametrize("executor", ["inline", "dask"])
def test_interruption_leaves_nobody_behind(cache, program_environment, executor):
    process = start(cache, program_environment, executor, "sleep", start_new_session=True)
    process.stdout.readline()
    deadline = time.monotonic() + 30
    while len(list(cache.glob("artifacts/*/*/*.zip"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.2)  # now the sleepers run
    children = psutil.Process(process.pid).children(recursive=True)
    assert (len(children) >= 2) == (executor == "dask")
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=HANGS)  # the tasks sleep for longer
    assert process.returncode == 130
    assert err == ""
    assert gone(children)
    assert maintenance.verify(Store(cache))[1] == []


def test_workers_end_when_the_program_is_killed(cache, program_environment):
    process = start(cache, program_environment, "dask", "sleep", start_new_session=True)
    deadline = time.monotonic() + 30
    while len(list(cache.glob("artifacts/*/*/*.zip"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.05)
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate()
    assert len(children) >= 2
    assert gone(children)


@pytest.fixture
def editable(tmp_path, program_environment):
    """A copy of the toys that a test may edit: ``run(old, new)`` gives the nodes of a run after the edit."""
    shutil.copytree(HERE / "toys", tmp_path / "lib" / "toys", ignore=shutil.ignore_patterns("__pycache__"))
    environment = program_environment | {
        "PYTHONPATH": os.pathsep.join([str(tmp_path / "lib"), str(HERE.parent.parent)]),
        # Python takes compiled code for that of an edit in the same second that keeps the file's size.
        "PYTHONDONTWRITEBYTECODE": "1",
    }

    def run(file="helper.py", old="", new=""):
        path = tmp_path / "lib" / "toys" / file
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new) if old else path.read_text() + new)
        return finish(start(tmp_path / "edited", environment))

    return run


def test_an_edit_computes_again_exactly_what_it_can_change(editable):
    first = editable()
    comment = editable(new="\n# only words\n")
    assert {v[0] for v in comment.values()} == {"cached"}
    neutral = editable(old="values * SCALE", new="SCALE * values")
    assert {n for n, v in neutral.items() if v[0] == "computed"} == {f"scale/{i}" for i in range(4)}
    assert {n: v[1] for n, v in neutral.items()} == {n: v[1] for n, v in first.items()}, "early cut-off"
    assert neutral["scale/2"][2] == "code: toys/helper.py changed"
    real = editable(old="SCALE = 2.0", new="SCALE = 3.0")
    assert {n for n, v in real.items() if v[0] == "computed"} == {*(f"scale/{i}" for i in range(4)), "total"}
    assert real["total"][2] == "input parts changed (4 of 4)"


@pytest.mark.parametrize("client", [5, SimpleNamespace(scheduler=None)])
def test_what_is_no_open_client_is_refused(client):
    with raises("RIL-588", "no open Client"):
        caller.check(client)


def test_of_clusters_and_clients_only_a_synchronous_client_is_taken():
    async def refused():
        async with (
            LocalCluster(n_workers=0, processes=False, dashboard_address=None, asynchronous=True) as cluster,
            Client(cluster, asynchronous=True) as client,
        ):
            for given in (cluster, client):
                with raises("RIL-588"):
                    caller.check(given)

    asyncio.run(refused())
    with LocalCluster(n_workers=0, processes=False, dashboard_address=None) as cluster, Client(cluster) as client:
        caller.check(client)
        with raises("RIL-588"):
            caller.check(cluster)


def code_in_a_pool(how, kind):
    """Code with which a process of a pool is refused."""
    with multiprocessing.get_context(how).Pool(1) as pool:
        return pool.apply(code_of_refusal, (kind,))


def code_of_refusal(kind):
    try:
        caller.check(kind)
    except ConfigError as error:
        return error.code
    return ""


def test_a_process_of_a_pool_starts_no_workers():
    assert code_in_a_pool("spawn", "dask") == "RIL-542"
    assert code_in_a_pool("spawn", "inline") == ""


def test_a_process_forked_after_a_run_is_refused():
    caller.check("inline")
    assert code_in_a_pool("fork", "inline") == "RIL-543"


@pytest.mark.parametrize("name", ["__main__", "__mp_main__"])  # that of the program, and where a worker imports it
def test_a_program_without_a_guard_is_refused_before_its_workers_import_it(tmp_path, name):
    program = tmp_path / "program.py"
    program.write_text(
        "from rille.pipeline.engine import caller\n"
        "def work(kind):\n    caller.check(kind)\n"
        "work('inline')\n"
        "if __name__ in ('__main__', '__mp_main__'):\n    work('dask')\n"
        "work('dask') if __name__ else None\n"
    )
    runpy.run_path(str(program), run_name=name)
    with program.open("a") as file:
        file.write("for kind in ('inline', 'dask'):\n    work(kind)\n")
    with raises("RIL-972", f"line 9 of {program}"):
        runpy.run_path(str(program), run_name=name)
    exec(compile("work('dask')", "<stdin>", "exec"), {"__name__": name, "work": caller.check})  # no worker imports it


def test_a_package_that_is_run_needs_no_guard(tmp_path, monkeypatch):
    """No worker imports its ``__main__``."""
    (tmp_path / "package").mkdir()
    begin = "from rille.pipeline.engine import caller\ncaller.check('dask')\n"
    for name in ("__init__.py", "__main__.py"):
        (tmp_path / "package" / name).write_text(begin if name == "__main__.py" else "")
    monkeypatch.syspath_prepend(tmp_path)
    runpy.run_module("package", run_name="__main__", alter_sys=True)


@pytest.mark.parametrize("begun", [0, 1, 2])
def test_no_worker_that_still_starts_outlives_a_run_that_is_broken_off(begun, tmp_path):
    resource_tracker.ensure_running()
    before = set(psutil.Process().children())
    made = workers.make("dask", 2, tmp_path, math.inf)
    while len(set(psutil.Process().children()) - before) < begun:
        pass  # not even a moment: dask has a worker's number some time after the process is there
    made.close(kill=True)
    assert set(psutil.Process().children()) == before
    time.sleep(1)
    assert set(psutil.Process().children()) == before
