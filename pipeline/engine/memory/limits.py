"""Memory: how much may be used here, and how much a task took.

The limit is the free memory of the machine, or of a control group (v1 or v2) that this process is in, whichever is
least. Memory that other processes hold is not free; memory that the kernel can drop at once (page cache) is.

A :class:`Meter` reads the greatest resident memory of the process while a task runs. Linux lets a process set that mark
back (``/proc/self/clear_refs``); elsewhere, or where several tasks share the process, nothing is measured.
"""

from __future__ import annotations

import ctypes
import re
import resource
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import psutil

from rille.stages.core.errors import ConfigError

SHARE = 0.9
"""Part of what is free that a run takes by itself: page cache for its files, and others that grow, need the rest."""

UNITS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9, "t": 1e12, "ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}

# Control groups v1 write "no limit" as the greatest 64-bit number of whole pages, not as a word.
_UNLIMITED = 1 << 60
_WORDS = re.compile(r"([\d.]+)\s*([kmgt]?i?)b?", re.IGNORECASE)


def parse(text: str) -> int:
    """Bytes of ``6GB``, ``800 MiB``, ``75%`` (of the machine or its control group).

    Raises
    ------
    ConfigError
        It is none of these.
    """
    words = text.strip()
    # The pattern lets 1.2.3 pass, float() does not.
    with suppress(ValueError):
        if words.endswith("%") and 0 < float(words[:-1]) <= 100:
            return int(float(words[:-1]) / 100 * total())
        found = _WORDS.fullmatch(words)
        if found and float(found[1]) > 0:
            return int(float(found[1]) * UNITS[found[2].lower()])
    raise ConfigError(
        "RIL-553", f"--memory-limit {text!r} is no amount of memory", remedy="give e.g. 6GB, 800MB or 75%"
    )


def words(amount: float) -> str:
    """``412 MB``, ``1.2 GB``, ``35 kB``."""
    for limit, unit, digits in ((999.5e6, 1e9, 1), (99.5e3, 1e6, 0), (0, 1e3, 0)):
        if amount >= limit:
            name = {1e9: "GB", 1e6: "MB", 1e3: "kB"}[unit]
            return f"{amount / unit:.{1 if unit == 1e6 and amount < 9.95e6 else digits}f} {name}"
    return "0 kB"


def total(root: Path = Path("/")) -> int:
    """Memory of the machine, or of the narrowest control group around this process, bytes."""
    return min([int(psutil.virtual_memory().total), *_resource(), *(limit for limit, _ in _groups(root))])


def free(root: Path = Path("/")) -> int:
    """Return the memory [bytes] that this process and its children may still take."""
    machine = int(psutil.virtual_memory().available)
    return max(0, min([machine, *_resource(), *(limit - used for limit, used in _groups(root))]))


def _resource() -> list[int]:
    """Resident memory that each process may have by its resource limit (``ulimit -m``), if there is one."""
    # Linux itself no longer enforces this limit (getrlimit(2)); it is kept here because somebody has set it.
    soft, _ = resource.getrlimit(resource.RLIMIT_RSS)
    return [] if soft == resource.RLIM_INFINITY else [soft]


def _groups(root: Path) -> Iterator[tuple[int, int]]:
    """Limit and use (without what can be dropped) of each control group with a limit around this process."""
    with suppress(OSError):
        for line in (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "":  # v2; where v1 is mounted too, under unified
                for base in ("sys/fs/cgroup", "sys/fs/cgroup/unified"):
                    yield from _chain(root / base, path, ("memory.max", "memory.current", "inactive_file"))
            elif "memory" in controllers.split(","):
                names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
                yield from _chain(root / "sys/fs/cgroup/memory", path, names)


def _chain(base: Path, path: str, names: tuple[str, str, str]) -> Iterator[tuple[int, int]]:
    """The group and all around it; a container may see its own group at the mount itself."""
    group = base / path.lstrip("/")
    for folder in dict.fromkeys([group, *group.parents]):
        # Within the mount only: above it other files of these names would mean something else.
        if folder != base and base not in folder.parents:
            return
        with suppress(OSError, ValueError):  # "max" is no number: no limit
            limit = int((folder / names[0]).read_text())
            if 0 < limit < _UNLIMITED:
                used = int((folder / names[1]).read_text())
                yield limit, max(0, used - _statistic(folder / "memory.stat", names[2]))


def _statistic(path: Path, name: str) -> int:
    with suppress(OSError, ValueError):
        for line in path.read_text().splitlines():
            if line.startswith(f"{name} "):
                return int(line.split()[1])
    return 0


SELDOM = 64
"""Unmeasured tasks after which a process gives freed memory back."""


def resident() -> int:
    """Resident memory of this process, bytes."""
    return int(psutil.Process().memory_info().rss)


class Meter:
    """Measures one task: ``memory`` is what it took beyond what the process holds before or after it, ``rest``.

    What earlier tasks have freed is given back to the system first, and what this one has freed at its end: a heap
    that is kept for later would hide what a task takes. Fetching it anew took a tenth of a task's time, so a task can
    be left unmeasured; then freed memory is given back after every :data:`SELDOM` tasks, so that a heap in pieces does
    not grow. Both figures are then None, as where the system cannot tell, or where another task ran in the process
    meanwhile.

    >>> with Meter() as meter:
    ...     array = np.ones(10**7)
    >>> meter.memory + meter.rest >= 8 * 10**7
    True
    """

    _lock = threading.Lock()
    _running: list[Meter] = []  # noqa: RUF012 (of the process, on purpose)

    _since = 0
    """Tasks since freed memory was last given back."""

    memory: int | None = None
    rest: int | None = None

    def __init__(self, *, measure: bool = True) -> None:
        self._measure = measure

    def __enter__(self) -> Meter:
        with Meter._lock:
            Meter._running.append(self)
            self._alone = len(Meter._running) == 1
            for other in Meter._running if not self._alone else ():
                other._alone = False
        self._before = 0
        if self._alone and self._measure:
            _trim()
            self._before = _status()[0] if _set_back() else 0
        return self

    def __exit__(self, *_: object) -> None:
        peak = _status()[1] if self._before else 0
        Meter._since += 1
        if self._alone and (self._measure or Meter._since >= SELDOM):
            _trim()
            Meter._since = 0
        now = _status()[0] if self._before else 0
        with Meter._lock:
            Meter._running.remove(self)
            # Another task may have begun while this one ran: the peak is then that of both, and says nothing.
            alone = self._alone
        if alone and self._before:
            self.rest = max(self._before, now)
            self.memory = max(0, peak - self.rest)


def _set_back() -> bool:
    """Begin the mark of the greatest resident memory anew."""
    try:
        # 5 sets VmHWM, the greatest resident memory, back to the present one (Linux, proc(5)).
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _status() -> tuple[int, int]:
    """Resident memory of this process now, and its greatest since the mark was set back, bytes."""
    text = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    # proc(5) writes kB and means 1024 bytes.
    found = dict(re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB$", text, re.MULTILINE))
    return int(found["VmRSS"]) * 1024, int(found["VmHWM"]) * 1024


def _trim() -> None:
    """Give freed memory back, where the C library can (glibc); some 0.1 ms where there is little."""
    with suppress(OSError, AttributeError):
        _library().malloc_trim(0)


@cache
def _library() -> Any:
    # The symbols of this process, so of whichever C library it runs on; another than glibc lacks malloc_trim.
    return ctypes.CDLL(None)
