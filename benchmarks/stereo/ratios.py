"""Figures of matchers as ratios to those of the first one, OpenCV's SGBM 3WAY, and the picture of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import fmean, median
from typing import Any

from .measures import judge
from .methods import Method
from .pairs import Pair
from .timing import timings

BUDGET = 3.0
"""Seconds of timing a matcher and pair, after three rounds."""


def figures(
    pairs: Iterable[Pair], methods: list[Method], rounds: int, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """What :func:`judge` finds of every pair and matcher; ``cpu_ratio``: processor time over the first matcher's."""
    found = []
    for pair in pairs:
        assert pair.truth is not None
        say(pair.name)
        for method, timed in zip(methods, timings(pair, methods, rounds, BUDGET), strict=True):
            found.append({**timed, **judge(method(pair), pair.truth)})
    return found


def means(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each matcher, in the order of :func:`figures`.

    Means over the pairs of ratios to the first matcher: ``bad1`` and ``bad2``, filled alike; ``bad2_own``, by the own
    filling, over the first one's ``bad2``, None without one. ``bad2_best``: mean ratio of ``bad2`` to the least one of
    the matchers other than HFVM on the same pair. Means: ``completeness`` and ``bad2_matched``. ``time``: median of
    ``cpu_ratio``.
    """
    by_name: dict[str, list[dict[str, Any]]] = {}
    for f in found:
        by_name.setdefault(f["method"], []).append(f)
    first = next(iter(by_name.values()))
    others = [mine for name, mine in by_name.items() if not name.startswith("HFVM")]
    best = [min(f["bad2"] for f in pair) for pair in zip(*others, strict=True)]
    bad1, bad2 = ([f[key] for f in first] for key in ("bad1", "bad2"))

    def ratio(mine: list[dict[str, Any]], key: str, to: list[float]) -> float:
        return fmean(f[key] / other for f, other in zip(mine, to, strict=True))

    return [
        {
            "method": name,
            "bad1": ratio(mine, "bad1", bad1),
            "bad2": ratio(mine, "bad2", bad2),
            "bad2_own": None if mine[0]["bad2_own"] is None else ratio(mine, "bad2_own", bad2),
            "bad2_best": ratio(mine, "bad2", best),
            "completeness": fmean(f["completeness"] for f in mine),
            "bad2_matched": fmean(f["bad2_matched"] for f in mine),
            "time": median(f["cpu_ratio"] for f in mine),
        }
        for name, mine in by_name.items()
    ]


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw bad-2 over processor time, both as ratios; full marks: all filled alike, hollow ones: own filling."""
    from matplotlib import pyplot as plt
    from matplotlib.ticker import FuncFormatter

    with plt.rc_context({"font.size": 11}):
        figure, axis = plt.subplots(figsize=(8.2, 5.0), layout="constrained")
        for words, face in (("all filled alike", "0.3"), ("own filling", "white")):
            axis.plot([], [], "D", color="0.3", markerfacecolor=face, label=words)
        figure.legend(loc="outside upper center", ncols=2, frameon=False)
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_xlim(0.6 * min(r["time"] for r in rows), 1.6 * max(r["time"] for r in rows))
        axis.set_ylim(0, 1.15 * max(max(_heights(r)) for r in rows))
        axis.axhline(1.0, color="0.6", linewidth=1, zorder=0)
        axis.grid(alpha=0.3)
        axis.set_xlabel(f"processor time / that of {rows[0]['method']}")
        axis.set_ylabel(f"off by more than 2 px / that of {rows[0]['method']}")
        for row in rows:
            colour, marker = ("#0072b2", "o") if row["method"].startswith("HFVM") else ("#d55e00", "s")
            full, *own = _heights(row)
            axis.plot([row["time"]] * (1 + len(own)), [full, *own], color=colour, linewidth=1, zorder=1)
            axis.plot([row["time"]] * len(own), own, marker, color=colour, markersize=10, markerfacecolor="white")
            axis.plot(row["time"], full, marker, color=colour, markersize=7)
        figure.draw_without_rendering()
        _name_marks(axis, rows)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})
        plt.close(figure)


def _heights(row: dict[str, Any]) -> list[float]:
    return [row[key] for key in ("bad2", "bad2_own") if row[key] is not None]


def _name_marks(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Names beside the marks, each at the first place where it covers neither marks nor other names."""
    from matplotlib.transforms import Bbox

    marks = [axis.transData.transform([(row["time"], y) for y in _heights(row)]) for row in rows]
    taken = [Bbox([m, m]).padded(7) for both in marks for m in both]
    taken += [Bbox([both.min(axis=0), both.max(axis=0)]).padded(2) for both in marks]
    for row, both in zip(rows, marks, strict=True):
        (x, y), low, high = both[0], both[:, 1].min() - 8, both[:, 1].max() + 8
        above, below = (x, high, "center", "bottom"), (x, low, "center", "top")
        places = above, below, (x + 8, y, "left", "center"), (x - 8, y, "right", "center")
        for right, up, across, along in places:
            text = axis.text(right, up, row["method"], ha=across, va=along, transform=None)
            box = text.get_window_extent()
            if not any(box.overlaps(other) for other in taken):
                break
            text.set_visible(False)
        text.set_visible(True)
        text.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5})
        taken.append(box)
