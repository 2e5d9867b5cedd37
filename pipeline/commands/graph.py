"""``rille graph``: the tasks of a run and what each reads, drawn by stage or by task as SVG, or as text for Graphviz.

What depends on results that are still to come is drawn as the last run had it, where there was one.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from html import escape
from pathlib import Path

from rille.pipeline.commands.options import check_output
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.run import RunOptions, run
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs.session import Options, lay_out, settings

BOX, GAP = (150, 22), (20, 48)
"""Width and height of a box, and of the space between two, pixels."""

Names = Counter[str]
Edges = Counter[tuple[str, str]]


def graph(options: Options, output: Path, *, tasks: bool = False) -> int:
    """Draw the graph of a run into a file; gives the exit code.

    Raises
    ------
    ConfigError
        The file's name ends neither in ``.svg`` nor in ``.dot``.
    """
    check_output(output, ".svg", ".dot")
    draw = svg if output.suffix.lower() == ".svg" else dot
    settled = settings(options)
    laid_out = lay_out(settled.sequence, settled.config, settled.frames)
    run(laid_out, Store(options.cache), RunOptions(dry=True)).check()
    names, edges = parts(laid_out, tasks=tasks)
    atomic.write(output, draw(names, edges))
    print(f"{output}  {len(laid_out.nodes)} tasks of {len({h.stage for h in laid_out.nodes})} stages")
    return 0


def parts(graph: Graph, *, tasks: bool = False) -> tuple[Names, Edges]:
    """How many tasks stand behind each name, and how many reads behind each arrow; names in order of creation."""
    names, edges = Counter[str](), Counter[tuple[str, str]]()
    for handle in graph.nodes:
        name = handle.label if tasks else handle.stage
        names[name] += 1
        edges.update((source.label if tasks else source.stage, name) for source in handle.upstream())
    return names, Counter({edge: count for edge, count in edges.items() if edge[0] != edge[1]})


def dot(names: Names, edges: Edges) -> str:
    """Text for ``dot`` of Graphviz."""
    boxes = [f'  "{name}" [label="{_label(name, count)}"];' for name, count in names.items()]
    return "\n".join(["digraph {", *boxes, *(f'  "{a}" -> "{b}";' for a, b in edges), "}", ""])


def svg(names: Names, edges: Edges) -> str:
    """A drawing: each name in the row behind all that it reads and that was created before it."""
    rows: dict[str, int] = {}
    read = defaultdict[str, list[str]](list)
    for a, b in edges:
        read[b].append(a)
    for name in names:
        # A stage that reads itself through others (`locus` by `pose`) stays where it was first created: its loop is
        # drawn upwards.
        rows[name] = 1 + max((rows[a] for a in read[name] if a in rows), default=-1)
    filled, places = Counter[int](), {}
    for name, row in rows.items():
        places[name] = (filled[row] * (BOX[0] + GAP[0]), row * (BOX[1] + GAP[1]))
        filled[row] += 1
    size = (max(filled.values(), default=1) * (BOX[0] + GAP[0]), len(filled) * (BOX[1] + GAP[1]))
    lines = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-5 -5 {size[0]} {size[1]}" font-family="sans-serif">']
    for a, b in edges:
        (x, y), (u, v) = places[a], places[b]
        half = BOX[0] // 2
        lines.append(f'<path d="M{x + half} {y + BOX[1]} L{u + half} {v}" stroke="#888" stroke-opacity="0.6"/>')
    for name, (x, y) in places.items():
        lines.append(f'<rect x="{x}" y="{y}" width="{BOX[0]}" height="{BOX[1]}" rx="4" fill="#eef" stroke="#446"/>')
        label = escape(_label(name, names[name]))
        lines.append(f'<text x="{x + BOX[0] // 2}" y="{y + 15}" font-size="11" text-anchor="middle">{label}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _label(name: str, count: int) -> str:
    return name if count == 1 else f"{name} x {count}"
