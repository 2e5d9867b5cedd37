"""A dask scheduler and its workers, started as a user would by hand."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

HERE = Path(__file__).parent


class Hands:
    """Starts what a user would start by hand."""

    def __init__(self, folder, environment):
        self.folder, self.environment = folder, environment
        self.processes = []

    def _start(self, *words, **extra):
        log = (self.folder / f"log-{len(self.processes)}").open("w")
        command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
        process = subprocess.Popen(
            command, env={**self.environment, **extra}, cwd=self.folder, stdout=log, stderr=log, start_new_session=True
        )
        self.processes.append(process)
        return process

    def scheduler(self):
        file = self.folder / "scheduler.json"
        words = (
            "dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(file),
        )
        process = self._start(*words)
        until = time.monotonic() + 60
        while not file.exists() or not file.read_text().endswith("}"):
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
        self.address = json.loads(file.read_text())["address"]
        return process

    def worker(self, name, nanny="--no-nanny", **extra):
        """With ``--nanny`` a worker that dies is started again."""
        words = ("dask_worker", self.address, "--nthreads", "1", "--name", name, nanny, "--no-dashboard")
        single = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        return self._start(*words, "--host", "127.0.0.1", "--death-timeout", "60", **{**single, **extra})


@contextmanager
def by_hand(folder, **extra):
    """What is started in the block is ended with it."""
    places = [str(HERE), str(HERE.parent / "torture"), str(HERE.parent.parent)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places), **extra}
    hands = Hands(folder, environment)
    try:
        hands.scheduler()
        yield hands
    finally:
        for process in hands.processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(10)
