"""``rille graph``: the stages of a run and what each reads, as text for Graphviz.

What depends on results that are still to come is drawn as the last run had it, where there was one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from rille.pipeline.commands.options import COMPLETE, Settings, cache_folder
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.run import RunOptions, run
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs.session import lay_out, settings

_SETTINGS = Settings()


def graph(seq: str = "mockup", *, options: Settings = _SETTINGS) -> int:
    """Draw the stages of a run, the number of their tasks, and what each reads.

    Prints text for Graphviz: rille graph SEQ | dot -Tsvg > graph.svg.

    Parameters
    ----------
    seq
        As for reconstruct.
    """
    settled = settings(replace(options, sequence=seq))
    laid_out = lay_out(settled.sequence, settled.config, settled.frames)
    run(laid_out, Store(cache_folder(options.cache)), RunOptions(dry=True)).check()
    print(dot(laid_out))
    return COMPLETE


def dot(graph: Graph) -> str:
    """Return a box for each stage with the number of its tasks, and an arrow for each stage that one reads."""
    tasks = Counter(handle.stage for handle in graph.nodes)
    arrows = dict.fromkeys((source.stage, handle.stage) for handle in graph.nodes for source in handle.upstream())
    boxes = (f'  "{stage}" [label="{stage} x {count}"];' for stage, count in tasks.items())
    return "\n".join(["digraph {", *boxes, *(f'  "{a}" -> "{b}";' for a, b in arrows if a != b), "}"])
