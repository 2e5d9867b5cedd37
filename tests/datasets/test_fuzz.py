"""Whatever a file holds, its reader takes it or refuses it in one line, within seconds and a bounded memory."""

from __future__ import annotations

import random
import resource
from collections import Counter

import fuzzing
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

CASES = st.tuples(st.sampled_from(sorted(fuzzing.seeds())), st.integers(0, 2**32 - 1))

REFUSED = {"calibration/colmap.txt", "imu/euroc.csv", "manifest/attitude.toml", "poses/euroc.csv"}
"""Seeds that are right by themselves and do not suit the scene: no pose, another clock, another size of images."""

MOST_MEMORY = 1_000_000
"""kB, by which the process may grow."""


def peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def fuzz(tmp_path, examples: int, derandomize: bool) -> Counter[str]:
    told: Counter[str] = Counter()

    @settings(
        max_examples=examples,
        derandomize=derandomize,
        database=None,
        deadline=None,  # fuzzing.within has its own
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(CASES)
    def case(chosen: tuple[str, int]) -> None:
        name, number = chosen
        told[fuzzing.read(name, fuzzing.mutate(fuzzing.seeds()[name], random.Random(number)), tmp_path / "scene")] += 1

    case()
    return told


@pytest.mark.parametrize("name", sorted(fuzzing.seeds()))
def test_seeds_are_read(tmp_path, name):
    found = fuzzing.read(name, fuzzing.seeds()[name], tmp_path / "scene")
    assert (found == "taken") == (name not in REFUSED), found


def test_readers_take_or_refuse_200_files(tmp_path):
    told = fuzz(tmp_path, 200, derandomize=True)
    assert told["taken"] > 5
    assert len(told) > 10, "many ways to be wrong"


@pytest.mark.slow
def test_readers_take_or_refuse_2000_files(tmp_path, capsys):
    before = peak()
    told = fuzz(tmp_path, 2000, derandomize=False)
    grown = peak() - before
    with capsys.disabled():
        ways = f"{told['taken']} taken, {told.total() - told['taken']} refused by {len(told) - 1} codes"
        print(f"\nfuzz: {told.total()} files, {ways}, 0 internal errors, 0 hangs, memory grew by {grown / 1000:.0f} MB")
    assert told.total() >= 1900
    assert grown < MOST_MEMORY


def test_the_check_itself_sees_a_fault_and_a_hang(tmp_path, monkeypatch):
    def fault(path):
        raise KeyError("x")

    def hang(path):
        while True:
            pass

    monkeypatch.setattr(fuzzing, "LONGEST", 0.2)
    for reader, error in ((fault, KeyError), (hang, fuzzing.TooLongError)):
        monkeypatch.setitem(fuzzing.READERS, "times", reader)
        with pytest.raises(error):
            fuzzing.read("times/times.txt", b"1\n", tmp_path / "scene")
