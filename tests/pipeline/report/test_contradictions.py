"""What contradicts the rig or the motion is said first, and a run with it is not complete."""

from types import SimpleNamespace

import numpy as np

from rille.pipeline.flow.products import Products
from rille.pipeline.report import gather
from rille.pipeline.report.delivery import contradictions, lacking


def test_each_contradiction_is_one_line_and_the_run_is_not_complete() -> None:
    products = Products()
    metas = {
        "synchrony": {"contradiction": "left i with right i+1"},
        "rig": {"misread": "in degrees"},
        "resect/0": {"knocked": "at pair 5"},
    }
    products.contradictions = ["synchrony", "rig", "resect/0"]  # type: ignore[list-item]  # a view takes any handle
    products.resections = ["resect/0", "lost"]  # type: ignore[list-item]
    bundles = {label: SimpleNamespace(meta=meta) for label, meta in metas.items()}
    view = SimpleNamespace(products=products, bundle=bundles.get)
    assert contradictions(view) == ["left i with right i+1", "in degrees", "at pair 5"]  # type: ignore[arg-type]
    assert lacking([{"kind": "contradiction", "what": "left i with right i+1", "why": ""}])


def test_rigs_of_many_pairs_that_warn_alike_do_so_once() -> None:
    off = "the calibration contradicts the images: rows of the right image lie {} px too low; repaired"
    rigs = [{"warnings": [off.format(row)]} for row in (0.4, 0.7, 0.9)]
    rigs[1]["warnings"] += ["the rig moves: pitch", "the rig moves: roll"]
    none = np.zeros(0)
    said = gather.Calibration(tuple(rigs), none.reshape(0, 2), none, none).warnings()
    assert said == [off.format(0.4) + " (and alike at 2 other pairs)", "the rig moves: pitch", "the rig moves: roll"]
