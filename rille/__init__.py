"""Stereo image sequences to terrain, trajectory, risk map and safe path.

``open_sequence``, ``reconstruct``, ``open_run``: see :mod:`rille.pipeline.api`.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rille.pipeline.api import Run, open_run, open_sequence, reconstruct

__all__ = ["Run", "open_run", "open_sequence", "reconstruct"]

_HERE = Path(__file__).resolve().parent
if not (_HERE / "stages").is_dir():  # a checkout: the packages lie beside this folder; a wheel has them in it
    __path__.append(str(_HERE.parent))


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(import_module("rille.pipeline.api"), name)
