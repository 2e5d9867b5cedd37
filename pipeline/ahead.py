"""Draws figures while the last tasks of a run still compute: those whose artifacts are all there.

Artifacts never change and the plan is complete by then, so a figure for which every artifact was found is as it would
be at the end. All others, and whatever fails, are left to the report.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from stages.declare import Bundle

if TYPE_CHECKING:  # a run that has nothing to draw need not import what draws
    from pipeline.report.block import Block
    from pipeline.report.view import RunView


WRITERS = ("PIL.Image", "jinja2", "matplotlib.figure", "pyogrio.raw", "rasterio", "zarr")
"""What writes results is imported beforehand, too: two seconds."""

AGAIN = 0.5
"""Seconds until artifacts that were not there are looked for again."""


class NotYetError(Exception):
    """An artifact of the plan is not there, or not any more."""


class Ahead:
    """Figures by title, drawn on another thread by :meth:`draw` until they are taken; ``view`` gives what is drawn."""

    def __init__(self, view: Callable[[], RunView]) -> None:
        self._view = view
        self._drawn: dict[str, Block] = {}
        self._wanted, self._drawing = threading.Event(), threading.Lock()

    def draw(self) -> None:
        """Draw what can be drawn; ends early, after the figure at hand, when the figures are wanted."""
        with self._drawing:
            if self._wanted.is_set():
                return
            from pipeline.report import gallery
            from pipeline.report.gather import Scene

            view = self._view()
            for name in WRITERS:
                import_module(name)
            scene = Scene(replace(view, bundle=_there(view.bundle)))
            left = dict(gallery.makers())
            while left and not self._wanted.is_set():
                for title, maker in list(left.items()):
                    if self._wanted.is_set():
                        return
                    try:
                        block = maker(scene)
                    except NotYetError:
                        continue
                    except Exception:  # drawn anew at the end, and what is wrong is said then
                        block = None
                    del left[title]
                    if block is not None:
                        self._drawn[title] = block
                self._wanted.wait(AGAIN)

    def take(self) -> Mapping[str, Block]:
        """What was drawn; nothing more will be."""
        self._wanted.set()
        with self._drawing:
            return self._drawn


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
