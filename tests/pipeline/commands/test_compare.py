"""``rille compare``: what one of the runs lacks is told, and is no equal result."""

from __future__ import annotations

import json
from pathlib import Path

from rille.pipeline.commands.results.compare import _figures, _tasks


def ledger(run: Path, **digests: str | None) -> Path:
    """Folder of a run whose tasks have these results; None: failed."""
    run.mkdir()
    rows = [{"label": n, "stage": n} | ({"digest": d} if d else {"state": "failed"}) for n, d in digests.items()]
    (run / "ledger.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def test_a_failed_task_has_no_result(tmp_path: Path) -> None:
    a = ledger(tmp_path / "a", same="1", other="2", fails="3", broken=None)
    b = ledger(tmp_path / "b", same="1", other="4", fails=None, broken=None, more="5")
    head, *stages = _tasks(a, b)
    assert head.split(maxsplit=1)[1] == "1 with the same result, 1 with another"
    assert {line.strip() for line in stages} == {
        "other: 1 another result",
        "fails: 1 in A alone",
        "more: 1 in B alone",
        "broken: 1 without a result in both",
    }


def test_figures_of_one_run_are_told() -> None:
    both = {"drift": {"label": "Drift", "value": 1.0, "unit": "m"}}
    alone = {"climb": {"label": "Climb", "value": 0.5, "unit": "m"}}
    clock = {"wall_clock": {"label": "Time", "value": 3.0, "unit": "s"}}
    lines = list(_figures({"metrics": both | alone | clock}, {"metrics": both}))
    assert "1 equal" in lines[0]
    assert [line.strip() for line in lines[1:]] == ["Climb: 0.500 m -> none"]
