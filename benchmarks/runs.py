"""Whole runs, cold and warm, by the clock: what the user waits for, from the command to its prompt.

``python benchmarks/runs.py [--sequence mockup] [--warm 5] [--bucket]``

A cold run starts with an empty cache and no compiled kernels; warm runs follow, with nothing to compute.
``--bucket`` repeats both with the cache in a bucket of moto's S3 server on this machine (a process of its own). Printed
are wall and processor time, and the bound ``1.15 x max(seconds of stages / cores, longest chain) + 5 s`` of the cold
run with ``rille timing``'s account.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median


def rille(*words: str, environment: dict[str, str]) -> tuple[float, float, str]:
    """Wall and processor time, s, of a command with all that it starts, and what it printed."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "rille.pipeline.cli", *words],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{' '.join(words)}: exit {done.returncode}\n{done.stderr[-2000:]}")
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, used, done.stdout


@contextmanager
def bucket() -> Iterator[dict[str, str]]:
    """A bucket of moto's server on loopback; gives the environment by which a program reaches it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    keys = {"AWS_ACCESS_KEY_ID": "none", "AWS_SECRET_ACCESS_KEY": "none", "AWS_REGION": "us-east-1"}
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, env={**os.environ, **keys}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(200):
            try:
                urllib.request.urlopen(urllib.request.Request(f"{url}/bucket", method="PUT"), timeout=20).close()
                break
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.1)
        yield {**keys, "AWS_ENDPOINT_URL": url}
    finally:
        server.terminate()
        server.wait()


def measure(sequence: str, cache: str, folder: Path, warm: int, environment: dict[str, str]) -> None:
    """Print one cold run with its account, and some warm ones."""
    where = ["--cache", cache, "--runs", str(folder / "runs")]
    environment = {**os.environ, "RILLE_LOCAL": str(folder / "local"), "XDG_CACHE_HOME": str(folder), **environment}
    wall, used, text = rille("reconstruct", sequence, *where, environment=environment)
    print(f"cold   {wall:7.2f} s by the clock, {used:7.2f} s of processors: {text.split('  ')[-1].strip()}")
    _, _, account = rille("timing", sequence, "--runs", str(folder / "runs"), environment=environment)
    print("       " + account.strip().replace("\n", "\n       "))
    bound = float(next(iter(re.findall(r"limit of a good run ([\d.]+) s", account))))
    print(f"       command to prompt {wall:.1f} s, bound {bound:.1f} s: {'kept' if wall <= bound else 'NOT KEPT'}")
    runs = [rille("reconstruct", sequence, *where, environment=environment) for _ in range(warm)]
    if any("computed 0," not in text for *_, text in runs):
        sys.exit("a warm run had something to do: " + runs[-1][2])
    walls, useds = [r[0] for r in runs], [r[1] for r in runs]
    print(
        f"warm   {min(walls):.2f} {median(walls):.2f} {max(walls):.2f} s (least, median, greatest of {warm}), "
        f"{median(useds):.2f} s of processors"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", default="mockup")
    parser.add_argument("--warm", type=int, default=5)
    parser.add_argument("--bucket", action="store_true", help="also with the cache in a bucket")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(f"== {given.sequence}, cache on the local disk")
        measure(given.sequence, str(folder / "disk" / "cache"), folder / "disk", given.warm, {})
        if given.bucket:
            print(f"== {given.sequence}, cache in a bucket of moto's server on loopback")
            with bucket() as environment:
                measure(given.sequence, "s3://bucket/cache", folder / "bucket", given.warm, environment)


if __name__ == "__main__":
    main()
