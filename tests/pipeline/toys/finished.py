"""A finished run made of synthetic artifacts, and a reader of its page."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rille.datasets.protocol import Sequence
from rille.pipeline.export.view import RunView, TaskRow
from rille.pipeline.flow.products import Products
from rille.pipeline.report import canvas, gallery, summary
from rille.pipeline.report.page import write_report
from rille.stages.calibration.rig import RigParams
from rille.stages.core.declare import Bundle
from rille.stages.evaluation.accuracy import trajectory_accuracy
from rille.stages.evaluation.dem_accuracy import dem_accuracy
from rille.stages.evaluation.path_check import path_check
from rille.stages.facts.evaluation import metric as figure
from rille.stages.geometry.epipolar import corrected
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import MEASURES
from rille.stages.hazard.risk import RiskParams
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path import PathParams

CELL, ROWS, COLS = 0.01, 60, 80
LATTICE = {"x0": -0.4, "y0": 0.8, "cell": CELL, "rows": ROWS, "cols": COLS}
FRAMES = tuple(range(6))
BASIC = (0, 4)
STEP = np.array([0.015, 0.030, 0.0])


def level_pose(position: np.ndarray) -> RigidTransform:
    """Optical camera at ``position``, looking along y."""
    return RigidTransform(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), position)


CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
RIG = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.097, 0.0, 0.0])))
REPAIRED = corrected(RIG, np.array([0.01, 0, 0, 0, 0]))
"""Pitch of 0.01 rad: 0.6 px of 60 px of focal length at the image's centre."""


def sequence(*, truth: bool) -> Sequence:
    # The truth's own world is turned and shifted: only alignment by the first frame brings it here.
    turn = RigidTransform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([5.0, 6.0, 7.0]))
    poses = tuple(turn @ level_pose(i * STEP) for i in FRAMES) if truth else None
    return Sequence(
        name="bed",
        rig=RIG,
        frames=len(FRAMES),
        image=lambda frame, camera: None,  # type: ignore[arg-type,return-value]
        frame_names=tuple(f"left{i:03d}" for i in FRAMES),
        truth=poses,
        truth_source="exact poses" if truth else "",
        notes=("Rendered for test <1>.",),
    )


def bundles() -> dict[str, Bundle]:
    """Artifacts of a run of six frames and two basic pairs, by the name of their handle."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:ROWS, 0:COLS]
    z = (-0.18 + 0.01 * np.sin(x / 9.0) * np.cos(y / 7.0)).astype(np.float32)
    z[:5, :9] = np.nan
    risk = np.zeros((ROWS, COLS), dtype=np.uint8)
    risk[20:30, 50:60] = 2
    risk[:5, :9] = 3
    bands = dict.fromkeys((m.band for m in MEASURES), np.full((ROWS, COLS), 0.1, dtype=np.float32))
    bands["p_hazard"] = bands["tilt"]
    bands |= {"risk": risk, **dict.fromkeys(("reason", "filled"), np.zeros_like(risk))}
    rows = np.arange(ROWS - 1, 9, -1)
    path = np.column_stack([np.zeros(len(rows)), 0.8 - CELL * rows, np.full(len(rows), -0.18)])
    sigma = np.where(np.isfinite(z), 5e-4, np.nan).astype(np.float32)
    dem = {"elevation": z, "elevation_std": sigma, "ortho": (z - z[30, 30] + 0.5) * 100}
    lattice = {"lattice": LATTICE}
    path_meta = {
        "found": True,
        "reason": "",
        "blocking_y": None,
        "length_m": 0.49,
        "climb_m": 0.004,
        "max_inclination": 0.1,
        "max_tilt": 0.08,
        "least_clearance": 0.02,
        "max_p_hazard": 0.01,
        "ground": "outline",
    }
    poses = np.array([level_pose(i * STEP).matrix34 for i in FRAMES])
    count = np.where(np.isfinite(z), 2, 0).astype(np.uint16)
    made = {
        "tile": Bundle(
            {**dem, "count": count, "spread": sigma, "source": np.zeros(z.shape, np.int32), "relief_std": sigma},
            lattice,
        ),
        "risk": Bundle(bands, {**lattice, "vehicle": {}}),
        "path": Bundle({"path": path}, path_meta),
        "trajectory": Bundle(
            {
                "poses": poses,
                "covariance": np.tile(1e-8 * np.eye(6), (6, 1, 1)),
                "segment": np.array([0, 0, 0, 0, 0, 1], dtype=np.int16),
                "piece": np.zeros(6, dtype=np.int16),
            },
            {"frames": list(FRAMES), "pieces": [list(FRAMES)], "main": 0, "verticals": ["attitude"]},
        ),
    }
    error = np.where(np.isfinite(z), 4e-4, np.nan).astype(np.float32)
    judged = dem_accuracy(z, np.full_like(z, 3e-4), z - error, np.ones(z.shape, dtype=bool))
    made["dem_accuracy"] = Bundle({"error": error}, {**lattice, "metrics": judged})
    positions, assessed = trajectory_accuracy(poses, poses)
    made["accuracy"] = Bundle(positions, {"metrics": assessed, "frames": list(FRAMES)})
    checked = path_check(path, risk, Lattice.from_dict(LATTICE))
    made["path_check"] = Bundle({}, {"metrics": checked})
    for frame in FRAMES:
        image = rng.integers(0, 255, (48, 64)).astype(np.uint8)
        made[f"image{frame}"] = Bundle({"image": image}, {"frame": frame})
    for number, segment in enumerate(((0, 1, 2, 3, 4), (4, 5))):
        points = rng.uniform(5, 40, (12, 1, 2)) + 2.0 * np.arange(len(segment))[None, :, None]
        points[3, 2:] = np.nan
        facts = [{"frame": f, "landmarks": 12, "inliers": 11, "rms_px": 0.2 + 0.01 * f} for f in segment]
        made[f"track{number}"] = Bundle({"points": points.astype(np.float32)}, {"frames": list(segment)})
        made[f"resect{number}"] = Bundle(
            {"inlier": np.ones((12, len(segment)), dtype=np.uint8)},
            {"per_frame": facts, "landmark_source": "disparity"},
        )
    column = np.full((48, 64), -8.0, dtype=np.float32)
    column[:4] = np.nan
    validity = np.where(np.isfinite(column), 1, 16).astype(np.uint8)
    # The second model lies 3 mm above the first.
    made["seams4"] = Bundle({}, {"pair": 4, "seams": [{"pair": 4, "other": 0, "bias": -0.003, "noise": 0.0}]})
    for pair in BASIC:
        made[f"disparity{pair}"] = Bundle(
            {"column_disparity": column, "row_disparity": 0.1 * column, "validity": validity}, {}
        )
        made[f"level{pair}"] = Bundle({}, {"source": "pitch"})
        made[f"local_dem{pair}"] = Bundle(dem, {**lattice, "defined": 0.9, "median_elevation_std": 5e-4})
        metrics = {"rmse": figure(1e-3 * (1 + pair), "m", "x"), "completeness": figure(0.9 - 0.05 * pair, "1", "x")}
        made[f"local_dem_accuracy{pair}"] = Bundle({}, {"metrics": metrics})
        made[f"local_risk{pair}"] = made["risk"]
        made[f"local_path{pair}"] = made["path"]
    return made


def orientation() -> Bundle:
    """Points at infinity whose right images fit the repaired rig exactly, and one outlier."""
    left = np.array([[x, y] for x in range(4, 60, 8) for y in range(4, 44, 8)], dtype=np.float32)
    rays = CAMERA.rays(left.astype(np.float64)) @ REPAIRED.T_right_left.rotation.T
    right = (rays[:, :2] / rays[:, 2:] * 60.0 + [31.5, 23.5]).astype(np.float32)
    right[0, 1] += 40
    weight = np.ones(len(left), dtype=np.float32)
    weight[0] = 0
    return Bundle({"left": left, "right": right, "weight": weight}, {"residual_before_px": 0.6})


def checks() -> dict[str, Bundle]:
    """Artifacts by which a run checks itself: the rig repaired, the other program's poses, the choice of pairs."""
    names = ("pitch", "yaw", "roll")
    parameter = {"unit": "deg", "sigma": 0.001, "asked": 0.573}
    freed = {"name": "pitch", "value": 0.573, "freed": True, "why": "contradicted"}
    held = {"name": "yaw", "value": 0.0, "freed": False, "why": "not observed <>"}
    rig = {
        "rig": REPAIRED.to_dict(),
        "given": RIG.to_dict(),
        "changed": True,
        "source": "given calibration, pitch repaired from 2 pairs",
        "parameters": [parameter | freed, parameter | held],
        "per_pair": [
            {"pair": k, "values": dict.fromkeys(names, 0.5), "sigma": dict.fromkeys(names, 0.1)} for k in BASIC
        ],
        "residual_before_px": 0.6,
        "residual_after_px": 0.0,
        "warnings": ["the calibration contradicts the images: rows are off by 0.60 px; repaired"],
    }
    theirs = np.array([level_pose(i * STEP + [0.002 * (i == 3), 0, 0]).matrix34 for i in FRAMES])
    theirs[5] = np.nan
    distance = np.array([0, 0, 0, 0.002, 0, np.nan])
    agreement = {
        "poses": theirs,
        "distance": distance,
        "angle": np.radians([0, 0, 0, 0.5, 0, np.nan]),
        "step_distance": np.array([np.nan, 0, 0, 0.002, 0.002, np.nan]),
        "step_angle": np.zeros(6),
        "flagged": np.array([0, 0, 0, 1, 0, 0], dtype=np.uint8),
    }
    compared = {
        "frames": list(FRAMES),
        "metrics": {"rmse": figure(9e-4, "m", "RMS"), "scale_ratio": figure(1.002, "1", "scale")},
        "rule": "disagreement above the median",
        "limits": {"distance": 0.001, "angle": 0.1, "step_distance": None, "step_angle": None},
        "flagged": [{"frame": 3, "why": ["position", "rotation"]}],
        "pieces": 1,
    }
    exact = np.array([i * STEP for i in FRAMES])
    _, assessed = trajectory_accuracy(theirs, np.array([level_pose(p).matrix34 for p in exact]))
    judged = {"position": theirs[:, :, 3], "position_truth": exact}
    select = {
        "basic": list(BASIC),
        "overlap": [None, 0.72],
        "why": ["first frame", "overlap"],
        "displacement": [3.0, 3.5, None, 4.0, 4.5],
        "warnings": [],
    }
    return {
        "rig": Bundle({}, rig),
        "agreement": Bundle(agreement, compared),
        "crosscheck": Bundle({"poses": theirs}, {"frames": list(FRAMES)}),
        "crosscheck_accuracy": Bundle(judged, {"metrics": assessed, "frames": list(FRAMES)}),
        "keyframes": Bundle({}, select),
        **{f"orientation{pair}": orientation() for pair in BASIC},
    }


NAMES = {
    "images": "image",
    "resections": "resect",
    "rigs": "rig",
    "orientations": "orientation",
    "world_tiles": "tile",
    "world_risk": "risk",
    "world_path": "path",
}
"""Artifacts of the products that are not called by the product's name."""


def products(made: Mapping[str, Bundle] | None = None) -> Products:
    """Handles, which are names, of the artifacts in ``made``: a name, or one a frame with its number behind."""
    made = bundles() if made is None else made
    found: Any = Products()
    for product, empty in vars(found).items():
        name = NAMES.get(product, product)
        numbered = {int(of[1]): of[0] for known in made if (of := re.fullmatch(rf"{name}(\d+)", known))}
        if isinstance(empty, dict):
            value: Any = numbered or (dict.fromkeys(BASIC, name) if name in made else {})
        elif isinstance(empty, list):
            value = list(numbered.values()) or [name] * (name in made)
        else:
            value = name if name in made else empty
        setattr(found, product, value)
    return found  # type: ignore[no-any-return]


def checked() -> Products:
    """Handles of a run that also checks itself."""
    return products(bundles() | checks())


TASKS = (
    TaskRow("hfvm/0", "hfvm", "computed", 2.0),
    TaskRow("hfvm/4", "hfvm", "cached", 4.0),
    TaskRow("locus/local/0", "locus", "computed", 1.0),
    TaskRow("locus/local/4", "locus", "computed", 1.0),
    TaskRow("locus/world/0", "locus", "cached", 0.5),
    TaskRow("risk/local/0", "risk", "computed", 0.1),
    TaskRow("path/local/0", "path", "computed", 0.1),
    TaskRow("track/0", "track", "computed", 0.3),
    TaskRow("resect/0", "resect", "computed", 0.2),
    TaskRow("pyramid/left/0", "pyramid", "cached", 0.05),
)


def view(made: dict[str, Bundle] | None = None, *, truth: bool = True, **changes: Any) -> RunView:
    store = bundles() if made is None else made
    if not truth:
        store.pop("accuracy", None)
    base = RunView(
        run_id="20260101T000000Z-abcdef12",
        sequence=sequence(truth=truth),
        frames=FRAMES,
        products=products(),
        bundle=lambda handle: store.get(handle) if isinstance(handle, str) else None,
        tasks=TASKS,
        config=SimpleNamespace(
            vehicle=Vehicle(name="rover of the toy"), risk=RiskParams(), path=PathParams(), rig=RigParams()
        ),
        config_toml="[locus]\ncell_size = 0.01  # <m>\n",
        seconds=12.3,
        versions={"rille": "0.1.0", "numpy": "2.4"},
        command="rille reconstruct bed",
        vehicle_source="sequence",
    )
    return replace(base, **changes)


class Page(HTMLParser):
    """Text in reading order, addresses, identifiers, images."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.images: list[dict[str, Any]] = []
        self._hidden = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self._hidden = tag in ("style", "script")
        self.addresses += [str(found[k]) for k in ("src", "href", "srcset", "action", "data", "poster") if k in found]
        self.ids += [str(found["id"])] if "id" in found else []
        self.images += [found] if tag == "img" else []
        assert tag not in {"link", "iframe", "object", "embed"}

    def handle_endtag(self, tag: str) -> None:
        self._hidden = self._hidden and tag not in ("style", "script")

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def _blank(fig: object, alt: str, *, photo: bool = False) -> canvas.Panel:
    return canvas.Panel("data:image/png;base64,", alt, 1, 1)


def report(folder: Path, run: RunView) -> None:
    """Both files of the report, of artifacts as they are."""
    with TemporaryDirectory() as made:
        for drawing in gallery.OUTPUTS:
            assert drawing.write is not None
            drawing.write(Path(made) / drawing.name, run)
        figures = [canvas.FIGURE.validate_json((Path(made) / one.name).read_bytes()) for one in gallery.OUTPUTS]
    write_report(folder, run, summary.collect(run), figures)


Written = tuple[dict[str, Any], Page, str, Path]


def written(folder: Path, run: RunView, *, pictures: bool = False) -> Written:
    """The report's facts, page and text; without ``pictures`` the figures are laid out, but not painted."""
    with pytest.MonkeyPatch.context() as patch:
        if not pictures:
            patch.setattr(canvas, "encode", _blank)
        report(folder, run)
    html = (folder / "report.html").read_text(encoding="utf-8")
    return json.loads((folder / "report.json").read_text(encoding="utf-8")), Page(html), html, folder
