"""A store in any order of commits, look-ups, damage, removal and clearing up, with a second process beside it."""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from raising import raises

from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.arrays import DamagedError, array_digests, output_digest
from rille.pipeline.engine.store.artifact import artifact_path
from rille.pipeline.engine.store.base import GoneError, Store
from rille.stages.core.declare import Array, Bundle, NoParams, Stage

STAGE = Stage(
    name="toy",
    summary="",
    params=NoParams,
    inputs=(),
    outputs=(Array("elevation", ("row", "col"), "float32", "m", "e"), Array("flag", ("n",), "bool", "1", "f")),
    run=lambda params, args, inputs: Bundle({}, {}),
)
KEYS = ["ab" + c * 62 for c in "012"]
GRACE = 1000.0

keys, storages = st.sampled_from(KEYS), st.integers(0, 1)


def result(key: str) -> Bundle:
    """What the stage gives for a key."""
    rng = np.random.default_rng(KEYS.index(key))
    arrays = {"elevation": rng.random((6, 5), np.float32), "flag": rng.random(9) > 0.5}
    return Bundle(arrays, {"rows": KEYS.index(key)})


def commit(root: Path, key: str) -> str:
    """Digest of what is committed, from wherever this is called."""
    return Store(root).commit(STAGE, key, result(key), label=key[:3]).digest


@cache
def digest(key: str) -> str:
    """Digest of the right result."""
    return output_digest(array_digests(result(key).arrays), result(key).meta)


@cache
def other_process() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))


def flip(data: bytes, at: random.Random) -> bytes:
    changed = bytearray(data)
    changed[at.randrange(len(data))] ^= 1 << at.randrange(8)
    return bytes(changed)


DAMAGES = {
    "flip": flip,
    "cut": lambda data, at: data[: at.randrange(len(data))],
    "zeros": lambda data, at: data[: (n := at.randrange(len(data)))] + bytes(len(data) - n),
    "empty": lambda data, at: b"",
    "other": lambda data, at: at.randbytes(300),
}


class Machine(RuleBasedStateMachine):
    """``state`` of each key: ``absent``, ``sound``, or ``suspect`` where a byte is not as it was written."""

    def __init__(self) -> None:
        super().__init__()
        self.root = Path(tempfile.mkdtemp())
        self.stores = [Store(self.root), Store(self.root)]
        self.state = dict.fromkeys(KEYS, "absent")
        self.old: set[str] = set()
        self.refs = {}

    def teardown(self) -> None:
        shutil.rmtree(self.root)

    def file(self, key: str) -> Path:
        return self.root / artifact_path("toy", key)

    def look(self, key: str) -> None:
        """After something that may have set a suspect aside."""
        if self.state[key] == "suspect" and not self.file(key).exists():
            self.state[key] = "absent"

    @rule(key=keys, which=storages)
    def commits(self, key: str, which: int) -> None:
        ref = self.stores[which].commit(STAGE, key, result(key), label=key[:3])
        self.committed(key, ref.digest)

    @rule(key=keys)
    def another_process_commits(self, key: str) -> None:
        self.committed(key, other_process().submit(commit, self.root, key).result())

    def committed(self, key: str, made: str) -> None:
        assert made == digest(key)
        assert self.file(key).is_file()
        # Damage of the arrays alone is seen by who reads them.
        seen = self.state[key] == "absent" or Store(self.root).manifest("toy", key) is None
        self.state[key] = "sound" if seen else self.state[key]
        self.old.discard(key)

    @precondition(lambda self: "sound" in self.state.values())
    @rule(which=storages)
    def commits_another_result(self, which: int) -> None:
        key = next(key for key, state in self.state.items() if state == "sound")
        wrong = Bundle({**result(key).arrays, "flag": np.zeros(9, bool)}, result(key).meta)
        with raises("RIL-577", "flag"):
            self.stores[which].commit(STAGE, key, wrong)
        self.old.discard(key)

    @rule(key=keys, which=storages, use=st.booleans())
    def looks_up(self, key: str, which: int, use: bool) -> None:
        ref = self.stores[which].lookup("toy", key, use=use)
        self.look(key)
        if ref is not None:
            assert self.state[key] != "absent"
            self.refs[key] = ref
            if use:
                self.old.discard(key)
        if self.state[key] == "sound":
            assert (ref.digest, dict(ref.meta), ref.nbytes) == (digest(key), result(key).meta, 6 * 5 * 4 + 9)

    @precondition(lambda self: self.refs)
    @rule(which=storages, data=st.data())
    def reads(self, which: int, data: st.DataObject) -> None:
        key = data.draw(st.sampled_from(sorted(self.refs)))
        try:
            read = self.stores[which].open(self.refs[key])
            assert output_digest(array_digests(read.arrays), read.meta) == digest(key)
        except (GoneError, DamagedError):
            assert self.state[key] != "sound"
            assert self.stores[which].lookup("toy", key) is None, "it was set aside"
        else:
            assert self.state[key] != "absent"
        self.look(key)

    @rule(key=keys, way=st.sampled_from(sorted(DAMAGES)), seed=st.integers(0, 10**6))
    def is_damaged(self, key: str, way: str, seed: int) -> None:
        if self.state[key] != "absent":
            self.file(key).write_bytes(DAMAGES[way](self.file(key).read_bytes() or b"0", random.Random(seed)))
            self.state[key] = "suspect"
            self.old.discard(key)

    @rule(key=keys)
    def is_removed(self, key: str) -> None:
        self.file(key).unlink(missing_ok=True)
        self.state[key] = "absent"

    @rule(key=keys)
    def grows_old(self, key: str) -> None:
        if self.state[key] != "absent":
            os.utime(self.file(key), (time.time() - 1e6,) * 2)
            self.old.add(key)

    @rule(keep=st.sets(keys), dry_run=st.booleans())
    def is_cleared_up(self, keep: set[str], dry_run: bool) -> None:
        going = {key for key in self.old - keep if self.state[key] != "absent"}
        sizes = sorted(self.file(key).stat().st_size for key in going)
        cleared = maintenance.gc(self.stores[0], keep, grace=GRACE, dry_run=dry_run)
        assert sorted(cleared.get("toy", [])) == sizes
        if not dry_run:
            self.state |= dict.fromkeys(going, "absent")

    @rule()
    def is_verified(self) -> None:
        states = list(self.state.values())
        sound, damages = maintenance.verify(self.stores[1])
        assert sound + len(damages) == len(KEYS) - states.count("absent")
        assert sound >= states.count("sound")
        assert maintenance.verify(Store(self.root)) == (sound, [])
        for key in KEYS:
            self.look(key)
            if self.state[key] == "suspect":  # no byte that anybody reads
                self.state[key] = "sound"

    @rule(which=storages)
    def a_run_begins(self, which: int) -> None:
        self.stores[which] = Store(self.root)

    @invariant()
    def nothing_is_left_over(self) -> None:
        present = {key for _, key in maintenance.artifacts(self.stores[0])}
        assert present == {key for key, state in self.state.items() if state != "absent"}
        assert not list(self.root.rglob(".tmp-*"))


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    yield
    other_process().shutdown()
    other_process.cache_clear()


class TestStore(Machine.TestCase):
    settings = settings(max_examples=50, stateful_step_count=30, deadline=None)
