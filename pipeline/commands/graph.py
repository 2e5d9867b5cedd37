"""``rille graph``: the tasks of a run and what each reads, by stage or by task, as text for Graphviz.

What depends on results that are still to come is drawn as the last run had it, where there was one.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from rille.pipeline.commands.options import COMPLETE, Output, Settings, cache_folder, check_output, flag
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.run import RunOptions, run
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs.session import lay_out, settings

_SETTINGS = Settings()


def graph(
    seq: str = "mockup",
    *,
    output: Annotated[Path | None, Output] = None,
    options: Settings = _SETTINGS,
    tasks: Annotated[bool, flag("Each task, not each stage.")] = False,
) -> int:
    """Draw the tasks of a run and what each reads, by stage.

    Prints text for Graphviz: rille graph SEQ | dot -Tsvg > graph.svg.

    Parameters
    ----------
    seq
        As for reconstruct.
    output
        File to write instead, .dot.
    """
    if output is not None:
        check_output(output, ".dot")
    settled = settings(replace(options, sequence=seq))
    laid_out = lay_out(settled.sequence, settled.config, settled.frames)
    run(laid_out, Store(cache_folder(options.cache)), RunOptions(dry=True)).check()
    text = dot(laid_out, tasks=tasks)
    if output is None:
        print(text)
    else:
        atomic.write(output, f"{text}\n")
        print(f"{output}  {len(laid_out.nodes)} tasks of {len({h.stage for h in laid_out.nodes})} stages")
    return COMPLETE


def dot(graph: Graph, *, tasks: bool = False) -> str:
    """Return a box for each name with the number of its tasks, and an arrow for each that one reads."""
    names, arrows = Counter[str](), dict[tuple[str, str], None]()
    for handle in graph.nodes:
        name = handle.label if tasks else handle.stage
        names[name] += 1
        arrows |= dict.fromkeys((source.label if tasks else source.stage, name) for source in handle.upstream())
    boxes = [f'  "{name}"' + (f' [label="{name} x {n}"];' if n > 1 else ";") for name, n in names.items()]
    return "\n".join(["digraph {", *boxes, *(f'  "{a}" -> "{b}";' for a, b in arrows if a != b), "}"])
