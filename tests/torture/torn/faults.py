"""Fails the n-th step of everything that writes below a folder: full disk, read-only disk."""

from __future__ import annotations

import errno
import io
import os
import threading
from pathlib import Path


class Faults:
    """Patches ``os`` and ``io``; ``fail_at`` counts steps from 1, ``onwards`` fails all from there on."""

    def __init__(self, monkeypatch, root, *, code=errno.ENOSPC, fail_at=0, onwards=False):
        self.root, self.code, self.fail_at, self.onwards = str(root), code, fail_at, onwards
        self.steps: list[str] = []
        self._lock = threading.Lock()
        for name, place in (("mkdir", 0), ("link", 1), ("replace", 1), ("rename", 1), ("utime", 0)):
            monkeypatch.setattr(os, name, self._around(getattr(os, name), name, place))
        monkeypatch.setattr(Path, "touch", self._around(Path.touch, "touch", 0))
        monkeypatch.setattr(os, "fsync", self._fsync(os.fsync))
        monkeypatch.setattr(io, "open", self._open(io.open))

    def _below(self, path):
        return isinstance(path, str | Path) and str(path).startswith(self.root)

    def step(self, what):
        """One more; raises where it is its turn."""
        with self._lock:
            self.steps.append(what)
            count = len(self.steps)
        if self.fail_at and (count == self.fail_at or (self.onwards and count > self.fail_at)):
            raise OSError(self.code, os.strerror(self.code), what)

    @property
    def fired(self):
        return bool(self.fail_at) and len(self.steps) >= self.fail_at

    def _around(self, real, name, place):
        def wrapped(*args, **kwargs):
            if self._below(args[place]):
                self.step(f"{name} {args[place]}")
            return real(*args, **kwargs)

        return wrapped

    def _fsync(self, real):
        def wrapped(handle):
            if self._below(os.readlink(f"/proc/self/fd/{handle}")):
                self.step("fsync")
            return real(handle)

        return wrapped

    def _open(self, real):
        def wrapped(file, mode="r", *args, **kwargs):
            if not self._below(file) or not set(mode) & set("wxa+"):
                return real(file, mode, *args, **kwargs)
            self.step(f"open {file}")
            made = real(file, mode, *args, **kwargs)
            return _Writer(made, self)

        return wrapped


class _Writer:
    """A file whose ``write`` is a step; half of what is written arrives."""

    def __init__(self, file, faults):
        self._file, self._faults = file, faults

    def write(self, data):
        try:
            self._faults.step("write")
        except OSError:
            self._file.write(data[: len(data) // 2])
            raise
        return self._file.write(data)

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        self._file.__enter__()
        return self

    def __exit__(self, *error):
        return self._file.__exit__(*error)
