"""Page of the seam audit: worst first, in figures that a reader can check, and a picture of the worst."""

from __future__ import annotations

import base64
import io
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rille.pipeline.report import seams
from rille.stages.core.declare import Bundle, NoParams
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain import overlap_audit, overlap_qa
from rille.stages.terrain.overlap_audit import OverlapAuditParams

TILT = math.radians(0.2)


def dem(pair: int, j0: int, bias: float = 0.0, tilt: float = 0.0) -> Bundle:
    lattice = Lattice.at(0, j0, 0.01, 60, 50)
    z = np.random.default_rng(pair).normal(0, 0.001, lattice.shape) + bias + tilt * (lattice.xy()[..., 0] - 0.245)
    even = np.ones(lattice.shape)
    maps = {"elevation": z, "elevation_std": 0.001 * even, "residual": 0 * even, "ortho": 90 * even}
    return Bundle({k: v.astype(np.float32) for k, v in maps.items()}, {"pair": pair, "lattice": lattice.to_dict()})


@pytest.fixture(scope="module")
def scene() -> Any:
    dems = {4 * k: dem(4 * k, 20 * k) for k in range(5)}
    dems[8] = dem(8, 40, bias=0.02, tilt=TILT)
    found = {}
    for pair in list(dems)[1:]:
        others = [dems[k] for k in dems if k < pair]
        found[pair] = overlap_qa.STAGE.run(NoParams(), {}, {"dem": dems[pair], "others": others})
    centres = {str(k): [0.245, 0.01 * (5 * k - 29.5)] for k in dems}
    audit = overlap_audit.STAGE.run(OverlapAuditParams(), {"centres": centres}, {"seams": list(found.values())})
    products = SimpleNamespace(overlap_audit=audit, seams=found)
    return SimpleNamespace(view=SimpleNamespace(bundle=lambda handle: handle, products=products))


_PICTURE = re.compile("data:image/webp;base64,([^%]+)%22")


def test_the_worst_seam_is_drawn_with_and_without_its_plane(scene: Any) -> None:
    block = seams.worst(scene)
    assert block is not None
    assert block.table is not None
    assert "8" in block.table.rows[0][0].split(" – ")
    assert "20 mm ±" in block.table.rows[0][2]
    assert 0.1 < float(block.table.rows[0][3].split("°")[0].lstrip("+−")) < 0.3
    noise = [float(row[5].split()[0]) for row in block.table.rows]
    assert noise == pytest.approx([1.4] * len(noise), abs=0.15)
    whole, left = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(_PICTURE.findall(p.uri)[0]))).convert("RGB"), dtype=float)
        for p in block.panels
    )
    middle = (slice(whole.shape[0] // 4, whole.shape[0] // 2), slice(whole.shape[1] // 3, 2 * whole.shape[1] // 3))
    # an offset of 20 mm fills the map with colour, noise of 1.4 mm about zero is nearly white on the same scale
    assert np.ptp(left[middle].mean(axis=(0, 1))) < 0.3 * np.ptp(whole[middle].mean(axis=(0, 1)))


def test_the_model_to_blame_stands_first(scene: Any) -> None:
    block = seams.models(scene)
    assert block is not None
    assert block.table is not None
    assert "look first at pair 8." in block.caption
    assert "  " not in block.caption
    first, *rest = block.table.rows
    assert (first[0], first[-1]) == ("8", "stands out, beyond its σ")
    assert first[1].startswith("+20 mm ±")
    assert first[2].startswith("+0.2")
    assert all(row[-1] == "as expected" for row in rest)
    facts = seams.facts(scene)
    assert facts is not None
    assert facts["models"][0]["pair"] == 8
    assert "warnings" not in facts


def test_without_a_seam_there_is_no_page() -> None:
    empty = overlap_audit.STAGE.run(OverlapAuditParams(), {"centres": {"0": [0.0, 0.0]}}, {"seams": []})
    for audit in (None, empty):
        products = SimpleNamespace(overlap_audit=audit, seams={})
        scene = SimpleNamespace(view=SimpleNamespace(bundle=lambda handle: handle, products=products))
        assert seams.worst(scene) is None
        assert seams.models(scene) is None
        assert seams.facts(scene) is None
