"""What contradicts the rig or the motion is said first, and a run with it is not complete."""

from types import SimpleNamespace

from rille.pipeline.flow.products import Products
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
