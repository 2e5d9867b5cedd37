"""Dense matching side by side: HFVM in every preset against OpenCV's matchers, Pandora and ELAS.

Without arguments: ten pairs of Middlebury by halves, as ratios to SGBM 3WAY (settings were chosen with the first half);
accuracy on *motorcycle* and *cones* (where RILLE_DATA has them) and the first pair of the mockup; the same under a
misaligned right camera; what is claimed on images that have nothing in common; time on three sizes: 570 x 520 (the
mockup's, and the paper's), the first pair of the KITTI street, and motorcycle enlarged by bicubic interpolation to 1.4
megapixels; last, what is claimed of the matcher, held against these figures. With ``--left --right --truth``: accuracy,
misalignment and time of that pair.

All matchers get equal threads and are filled alike: a pixel without a match takes the column of the nearest match in
its row, of two the background's; its row follows the epipolar lines of the matches, which are level for matchers of
rows. Matchers along rows are told the truth's range of disparities; OpenCV's get images padded by it, so that they
match at the left edge, too, Pandora and ELAS a frame of a few pixels, which serves them better. HFVM is told nothing.
HFVM is judged on its vector, the others on the column, so that rows cannot help them. Times: HFVM with pyramid, both
directions, consistency and filling, as Pandora and ELAS; OpenCV's one direction on the padded images.

Pandora and ELAS are programs in environments of their own, of which ``--pandora`` and ``--elas`` name the Python:

    python3 -m venv PANDORA && PANDORA/bin/pip install 'pandora[sgm]'
    python3 -m venv ELAS && ELAS/bin/pip install numpy setuptools wheel
    CPATH=$(ELAS/bin/python -c 'import numpy; print(numpy.get_include())') \
        ELAS/bin/pip install --no-build-isolation pyelas

They have no part in misalignment and in the time of three sizes.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

ACCURACY = (
    ("bad1", "bad-1"),
    ("bad2", "bad-2"),
    ("bad3", "bad-3"),
    ("bad2_column", "bad-2, column"),
    ("bad2_own", "own filling"),
    ("bad1_matched", "matched: bad-1"),
    ("bad2_matched", "bad-2"),
    ("bad3_matched", "bad-3"),
    ("median", "median, px"),
    ("completeness", "completeness"),
    ("nmad", "column NMAD, px"),
    ("within_1", "within 1 std"),
    ("within_2", "2 std"),
    ("locking", "fullest bin"),
)
TIMES = (
    ("min_ms", "least, ms"),
    ("median_ms", "median, ms"),
    ("min_ratio", "ratio of least"),
    ("median_ratio", "median of ratios"),
    ("cpu_ratio", "of processor time"),
    ("rounds", "rounds"),
)
PEERS = (
    ("bad1", "filled alike: bad-1"),
    ("bad2", "bad-2"),
    ("bad2_own", "own filling: bad-2"),
    ("bad2_best", "filled alike: bad-2 / best peer's"),
    ("completeness", "completeness"),
    ("bad2_matched", "matched: bad-2"),
    ("time", "processor time"),
)
PARTS = ("peers", "accuracy", "misalignment", "unrelated", "time")
PICTURES = {"peers_picture": "peers", "misalignment_picture": "misalignment"}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--left", type=Path, help="left image")
    parser.add_argument("--right", type=Path, help="right image")
    parser.add_argument("--truth", type=Path, help="its disparities: .npz, .npy, .pfm, 8- or 16-bit .png")
    parser.add_argument("--truth-scale", type=float, help="stored value of one pixel; default 256 if 16-bit, else 1")
    parser.add_argument(
        "--max-disparity", type=int, help="number that the row matchers search; default: from the truth"
    )
    parser.add_argument("--threads", type=int, default=1, help="of every matcher (default 1)")
    parser.add_argument("--only", choices=PARTS, action="append", help="this part alone; may be repeated")
    parser.add_argument("--methods", help="comma-separated beginnings of names, e.g. 'SGBM 3WAY,HFVM default'")
    parser.add_argument(
        "--hfvm",
        action="append",
        default=[],
        metavar="KEY=VALUE ...",
        help="one more variant of HFVM with these parameters, e.g. 'rounds=2 median=3'; may be repeated",
    )
    parser.add_argument("--rounds", type=int, default=7, help="timed rounds (default 7)")
    parser.add_argument("--budget", type=float, default=8.0, help="seconds of timing a method and pair (default 8)")
    parser.add_argument("--pandora", type=Path, metavar="PYTHON", help="of an environment with Pandora")
    parser.add_argument("--elas", type=Path, metavar="PYTHON", help="of an environment with pyelas")
    parser.add_argument("--peers-picture", type=Path, help="draw accuracy against time there, e.g. docs/peers.png")
    parser.add_argument("--misalignment-picture", type=Path, help="draw its curve there, e.g. docs/misalignment.png")
    parser.add_argument("--json", type=Path, help="write all figures there")
    given = parser.parse_args()
    if len({given.left is None, given.right is None, given.truth is None}) > 1:
        parser.error("give --left, --right and --truth together")
    if given.threads < 1 or given.rounds < 1:
        parser.error("--threads and --rounds are at least 1")
    for picture, part in PICTURES.items():
        if getattr(given, picture) and given.only and part not in given.only:
            parser.error(f"--{picture.replace('_', '-')} is drawn by the part {part}")
    return given


def start_process(threads: int) -> None:
    """Place of compiled kernels and number of threads, before NumPy and numba are imported."""
    from rille.pipeline.engine.runtime.environment import SINGLE, prepare_environment

    prepare_environment()
    os.environ.update({f"{name}_NUM_THREADS": str(threads) for name in SINGLE})
    os.environ["OPENCV_FOR_THREADS_NUM"] = str(threads)


def say(text: str) -> None:
    print(f"... {text}", file=sys.stderr, flush=True)


def cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if value >= 100 else f"{value:.3g}" if value >= 10 else f"{value:.3f}"
    return str(value)


def table(title: str, headings: list[str], rows: list[list[Any]]) -> None:
    cells = [[cell(v) for v in row] for row in [headings, *rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(headings))]
    print(f"\n{title}\n")
    for k, row in enumerate(cells):
        words = [row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]
        print("| " + " | ".join(words) + " |")
        if k == 0:
            print("|" + "|".join("-" * (w + 2) for w in widths) + "|")


def peers(methods: list[Any], rounds: int, picture: Path | None) -> list[dict[str, Any]]:
    from stereo import ratios
    from stereo.pairs import halves

    try:
        known = halves()
    except SystemExit as missing:
        print(f"the part peers is left out: {missing}")
        return []
    found = []
    for half, pairs in known.items():
        mine = ratios.figures(pairs, methods, rounds, lambda name: say(f"peers: {name}"))
        means = ratios.means(mine)
        table(
            f"{half} half ({', '.join(p.name for p in pairs)}): means over the pairs, of time the median; bad-1, "
            f"filled bad-2 and time as ratios to {methods[0].name}",
            ["method", *(words for _, words in PEERS)],
            [[m["method"], *(m[key] for key, _ in PEERS)] for m in means],
        )
        if picture and half == "judged":
            ratios.picture(means, picture)
            print(f"\n{picture}")
        found += [{"half": half, **f} for f in mine]
    return found


def accuracy(pairs: list[Any], methods: list[Any]) -> list[dict[str, Any]]:
    from stereo.measures import judge, locking

    found = []
    for pair in pairs:
        mine = []
        for method in methods:
            say(f"accuracy: {pair.name}, {method.name}")
            mine.append({"pair": pair.name, "method": method.name, **judge(method(pair), pair.truth)})
        own, _ = locking(pair.truth.u[pair.truth.known])
        rows = "" if pair.parallel else "; not rectified: rows differ"
        table(
            f"{pair.name}, {pair.size}, {pair.range[1]} disparities{rows}; shares; truth's own fullest bin {own:.2f}",
            ["method", *(words for _, words in ACCURACY)],
            [[f["method"], *(f[key] for key, _ in ACCURACY)] for f in mine],
        )
        found += mine
    return found


def misalignment(pairs: list[Any], methods: list[Any], picture: Path | None) -> list[dict[str, Any]]:
    from stereo import misalignment as knock

    labels = [knock.label(c) for c in knock.conditions()]
    found = knock.curve(pairs, methods, lambda name: say(f"misalignment: {name}"))
    for pair in pairs:
        rows = [
            [m.name, *(f["bad2"] for f in found if (f["pair"], f["method"]) == (pair.name, m.name))] for m in methods
        ]
        table(f"{pair.name}, right camera knocked: bad-2 (HFVM: of the vector)", ["method", *labels], rows)
    if not pairs:
        print("\nno rectified pair to misalign")
    elif picture:
        knock.picture([f for f in found if f["method"] != "HFVM paper"], picture)
        print(f"\n{picture}")
    return found


def unrelated(pairs: list[Any], methods: list[Any]) -> list[dict[str, Any]]:
    from stereo.pairs import unrelated as strangers

    cases = strangers(pairs)
    found = [{"pair": c.name, "method": m.name, "matched": float(m(c).matched.mean())} for m in methods for c in cases]
    rows = [[m.name, *(f["matched"] for f in found if f["method"] == m.name)] for m in methods]
    table("images that have nothing in common: share claimed as matched", ["method", *(c.name for c in cases)], rows)
    return found


def times(pairs: list[Any], methods: list[Any], rounds: int, budget: float) -> list[dict[str, Any]]:
    from stereo.timing import timings

    found = []
    for pair in pairs:
        say(f"time: {pair.name}")
        mine = timings(pair, methods, rounds, budget)
        table(
            f"time: {pair.name}, {pair.size}, {pair.range[1]} disparities; ratios to {methods[0].name}",
            ["method", *(words for _, words in TIMES)],
            [[f["method"], *(f[key] for key, _ in TIMES)] for f in mine],
        )
        found += mine
    return found


def claims(found: dict[str, Any]) -> list[dict[str, Any]]:
    from stereo.limits import lines

    claimed = lines(found)
    if not claimed:
        return []
    rows = [[c.words, c.figure, c.limit, "kept" if c.kept else "not kept"] for c in claimed]
    table("what is claimed, as far as this run measured it", ["line", "figure", "limit", ""], rows)
    return [{"line": c.words, "figure": c.figure, "limit": c.limit, "kept": c.kept} for c in claimed]


def chosen_pairs(given: argparse.Namespace) -> tuple[list[Any], list[Any]]:
    """Pairs to judge, and pairs to time."""
    from stereo import pairs

    if given.left is not None:
        images = pairs.read_image(given.left), pairs.read_image(given.right)
        truth = pairs.read_truth(given.truth, given.truth_scale)
        pair = pairs.measured(given.left.stem, *images, truth, given.max_disparity)
        return [pair], [pair]
    known = pairs.with_truth()
    street = pairs.street()
    timed = [known[-1].searching(128), *([street] if street else [])]
    timed += [pairs.enlarged(p).searching(224) for p in known if p.name == "motorcycle"]
    if len(known) < 3 or street is None:
        print("RILLE_DATA does not name a folder with motorcycle, cones and kitti06_51: what is missing is left out")
    return known, timed


def chosen_methods(given: argparse.Namespace) -> list[Any]:
    from stereo import methods

    found = methods.opencv()
    for name, words in methods.PEERS.items():
        if (python := getattr(given, name)) is None:
            print(f"{words} is left out: --{name} PYTHON is not given")
        else:
            method, version = methods.elsewhere(name, python)
            print(f"{words}: {version}")
            found.append(method)
    found += methods.hfvm(given.hfvm, given.threads)
    names = [n.strip() for n in given.methods.split(",")] if given.methods else [""]
    found = [m for m in found if any(m.name.startswith(n) for n in names)]
    if not found:
        raise SystemExit(f"no method begins with {given.methods!r}")
    return found


def main() -> None:
    given = arguments()
    start_process(given.threads)
    from pydantic import ValidationError

    from rille.stages.core.errors import RilleError

    try:
        measure(given)
    except (RilleError, ValidationError, OSError) as error:
        raise SystemExit(f"matching.py: {' '.join(str(error).split())}") from None


def measure(given: argparse.Namespace) -> None:
    """All parts that were asked for."""
    from stereo.limits import PEER
    from stereo.methods import set_threads

    set_threads(given.threads)
    parts = given.only or PARTS
    pairs, timed = chosen_pairs(given)
    methods = chosen_methods(given)
    print(f"{given.threads} thread{'s' * (given.threads > 1)} each; filled alike; missing pixels count as bad")
    found: dict[str, Any] = {"threads": given.threads}
    if "peers" in parts and given.left is None:
        if methods[0].name == PEER:
            compared = [m for m in methods if m.name != "HFVM paper"]
            found["peers"] = peers(compared, given.rounds, given.peers_picture)
        else:
            print(f"the part peers is left out: --methods leaves {PEER} out")
    if "accuracy" in parts:
        found["accuracy"] = accuracy(pairs, methods)
    if "misalignment" in parts:
        compared = [m for m in methods if m.name == PEER or m.name.startswith("HFVM")]
        found["misalignment"] = misalignment([p for p in pairs if p.parallel], compared, given.misalignment_picture)
    if "unrelated" in parts and given.left is None:
        found["unrelated"] = unrelated(pairs, methods)
    if "time" in parts:
        found["time"] = times(timed, [m for m in methods if m.told is None], given.rounds, given.budget)
    if given.left is None:
        found["claims"] = claims(found)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
