"""A process that has everything imported, and forks a program of its own group for each line: a try costs no import."""

from __future__ import annotations

import json
import os
import signal
import sys

import numpy  # noqa: F401
import toys.mischief
import toys.numbers
import toys.scale
import toys.total  # noqa: F401
import zarr
import zarr.codecs
import zarr.storage  # noqa: F401

import rille.pipeline.engine.events
import rille.pipeline.engine.keys
import rille.pipeline.engine.run
import rille.pipeline.engine.store.maintenance
import torn.saboteur  # noqa: F401
from torn import chain


def _child(line, alone):
    """Become the program; never comes back."""
    code = 1
    try:
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets its background jobs ignore it
        os.write(alone, b"x")
        os.close(alone)
        task = json.loads(line)
        log = os.open(task.pop("log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        code = chain.main(task)
        sys.stdout.flush()
    except KeyboardInterrupt:
        code = 130
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        import atexit
        import threading

        threading._shutdown() if code == 0 else None
        atexit._run_exitfuncs()
        os._exit(code)


def main():
    """Say the process id, wait for its end, say how it ended."""
    rille.pipeline.engine.keys.tree_digest()  # reads all sources, once for all
    for line in sys.stdin:
        seen, alone = os.pipe()
        pid = os.fork()
        if pid == 0:
            _child(line, alone)
        os.close(alone)
        os.read(seen, 1)  # until it has a group of its own, which may be killed
        os.close(seen)
        print(pid, flush=True)
        _, status = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
