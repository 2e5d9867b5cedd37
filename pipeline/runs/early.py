"""Draws figures and writes files while the last tasks of a run still compute: those whose artifacts are all there.

Artifacts never change and the plan is complete by then, so a figure or file for which every artifact was found is as it
would be at the end. All others, and whatever fails, are left to the end.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from stages.core.declare import Bundle

if TYPE_CHECKING:  # a run that has nothing to draw need not import what draws
    from pipeline.report.block import Block
    from pipeline.report.view import RunView

LIBRARIES = ("PIL.Image", "jinja2", "matplotlib.figure", "pyogrio.raw", "rasterio", "zarr")
"""What writes results is imported beforehand, too: two seconds."""

AGAIN = 0.5
"""Seconds until artifacts that were not there are looked for again."""

PATIENCE = 1.0
"""Seconds that a run which failed waits for what is at work here."""


class NotYetError(Exception):
    """An artifact of the plan is not there, or not any more."""


@dataclass(frozen=True)
class Early:
    """What was made beforehand: figures by title, and by the name of what writes them the folder of finished files."""

    figures: dict[str, Block] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)


class Ahead:
    """Makes results on another thread by :meth:`work` until they are taken; what nobody took is gone at the end.

    Parameters
    ----------
    folder : of the run; files wait in a hidden folder of it.
    view : gives what is drawn.
    """

    def __init__(self, folder: Path, view: Callable[[], RunView]) -> None:
        self._view, self._place = view, folder / ".early"
        self._made = Early()
        self._wanted, self._working = threading.Event(), threading.Lock()

    def __enter__(self) -> Ahead:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._wanted.set()
        held = self._working.acquire(timeout=-1 if error is None else PATIENCE)
        shutil.rmtree(self._place, ignore_errors=True)
        if held:
            self._working.release()

    def work(self) -> None:
        """Make what can be made; ends early, after what is at hand, when results are wanted."""
        with self._working:
            if self._wanted.is_set():
                return
            left = self._tasks()
            while left and not self._wanted.is_set():
                for name, task in list(left.items()):
                    if self._wanted.is_set():
                        return
                    try:
                        task()
                    except NotYetError:
                        continue
                    except Exception:  # done anew at the end, and what is wrong is said then
                        pass
                    del left[name]
                self._wanted.wait(AGAIN)

    def take(self) -> Early:
        """What was made; nothing more will be."""
        self._wanted.set()
        with self._working:
            return self._made

    def _tasks(self) -> dict[str, Callable[[], None]]:
        from pipeline.runs import run_files
        from pipeline.report import gallery
        from pipeline.report.gather import Scene

        for name in LIBRARIES:
            import_module(name)
        view = self._view()
        view = replace(view, bundle=_there(view.bundle))
        scene = Scene(view)
        tasks = {name: partial(self._write, name, writer, view) for name, writer in run_files.WRITERS.items()}
        return {**tasks, **{title: partial(self._draw, title, maker, scene) for title, maker in gallery.makers()}}

    def _write(self, name: str, writer: Callable[[Path, RunView], None], view: RunView) -> None:
        folder = self._place / name
        folder.mkdir(parents=True, exist_ok=True)
        writer(folder, view)
        self._made.files[name] = folder

    def _draw(self, title: str, maker: Callable[[Any], Block | None], scene: Any) -> None:
        block = maker(scene)
        if block is not None:
            self._made.figures[title] = block


def _there(find: Callable[[Any], Bundle | None]) -> Callable[[Any], Bundle | None]:
    """``find`` that tells what the plan lacks (None) from what is not there yet.

    Raises
    ------
    NotYetError
        When called for a handle without an artifact.
    """

    def bundle(handle: Any) -> Bundle | None:
        found = find(handle)
        if found is None and handle is not None:
            raise NotYetError
        return found

    return lru_cache(maxsize=16)(bundle)
