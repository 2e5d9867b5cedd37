"""How work runs: keys, artifacts, graph, executors, report and command line; ``open_sequence``, ``reconstruct`` and
``open_run`` from Python. No numerics."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.api import Run, open_run, open_sequence, reconstruct

__all__ = ["Run", "open_run", "open_sequence", "reconstruct"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module(f"{__name__}.api"), name)
