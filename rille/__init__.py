"""Stereo image sequences to terrain, trajectory, risk map and safe path.

One pair, step by step: ``open``, ``match``, ``points``, ``terrain``, ``hazards``, ``path``
(:mod:`rille.pipeline.python.steps`). Whole sequences: ``reconstruct``, ``reconstruct_many``, ``open_run``
(:mod:`rille.pipeline.python.runs`).
"""

# Not even `__future__` is imported here: `python -m rille` looks for it in the current folder first, and until
# `rille.__main__` has begun, Ctrl-C prints a traceback.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from rille.pipeline.python.runs import Run, open_run, reconstruct, reconstruct_many
    from rille.pipeline.python.sequence import StereoPair, StereoSequence, open
    from rille.pipeline.python.steps import hazards, match, path, points, terrain
    from rille.stages.core.errors import RilleError

    __version__: str

__all__ = [
    "RilleError",
    "Run",
    "StereoPair",
    "StereoSequence",
    "hazards",
    "match",
    "open",
    "open_run",
    "path",
    "points",
    "reconstruct",
    "reconstruct_many",
    "terrain",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})  # a notebook completes names that are not loaded yet


def __getattr__(name: str) -> "Any":
    from importlib import import_module, metadata

    if name == "__version__":
        return metadata.version("rille")
    if name not in __all__:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    # Loaded at first use: `import rille` must not import NumPy before threads are set.
    homes = {"RilleError": "stages.core.errors"}
    homes |= dict.fromkeys(("Run", "open_run", "reconstruct", "reconstruct_many"), "pipeline.python.runs")
    homes |= dict.fromkeys(("StereoPair", "StereoSequence", "open"), "pipeline.python.sequence")
    return getattr(import_module(f"rille.{homes.get(name, 'pipeline.python.steps')}"), name)
