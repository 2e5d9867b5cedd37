"""Large pairs as tasks: results of tiles against those of the whole; which pairs are tiled."""

import hashlib

import cv2
import numpy as np
import pytest
from raising import raises

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow import tiles
from rille.pipeline.flow.config import build
from rille.pipeline.flow.tiles import Tiling
from rille.stages.core.declare import NoParams
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import PyramidParams

SHAPE = (300, 380)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Textured PNG files, the left one sheared against the right one, so that a plane aligns them."""
    rng = np.random.default_rng(0)
    right = cv2.GaussianBlur(rng.normal(0, 1, SHAPE), (0, 0), 1.6)
    right = np.clip(128 + 35 * right / right.std(), 0, 255).astype(np.uint8)
    y, x = np.indices(SHAPE, np.float32)
    left = cv2.remap(right, x + 60 - np.float32(0.5) * y, y + 1, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    folder = tmp_path_factory.mktemp("images")
    paths = {"left": folder / "left.png", "right": folder / "right.png"}
    for camera, image in (("left", left), ("right", right)):
        cv2.imwrite(str(paths[camera]), image)
    return paths


def pyramids(graph, images):
    found = {}
    for camera, path in images.items():
        args = {"path": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "frame": 0}
        args |= {"camera": camera, "header": {"width": SHAPE[1], "height": SHAPE[0], "depth": 8}}
        image = graph.node("rille.datasets.images.files", f"image/{camera}", NoParams(), args)
        found[camera] = graph.node(
            "rille.stages.imaging.pyramid", f"pyramid/{camera}", PyramidParams(), inputs={"image": image}
        )
    return found


def disparity(store, images, params, side):
    graph = Graph()
    given = pyramids(graph, images)
    if side is None:
        node = graph.node("rille.stages.hfvm.stage", "hfvm", params, inputs=given)
    else:
        node = tiles.build(graph, params, given, SHAPE, side, "hfvm")
    driver.run(graph, store, driver.RunOptions(executor="inline")).check()
    return node.ref


@pytest.mark.parametrize(("preset", "side", "blur"), [("default", 160, 0), ("fast", 100, 0), ("default", 160, 2)])
def test_the_artifact_is_nearly_that_of_the_pair_matched_whole(tmp_path, images, preset, side, blur):
    if blur:
        soft = tmp_path / "right.png"
        cv2.imwrite(str(soft), cv2.GaussianBlur(cv2.imread(str(images["right"]), cv2.IMREAD_GRAYSCALE), None, blur))
        images = images | {"right": soft}
    store, params = Store(tmp_path), HfvmParams(preset=preset)
    once = disparity(store, images, params, None)
    assert once.meta["aligned"]
    assert once.meta["match_rate"] > 0.4
    found = disparity(store, images, params, side)
    assert found.key != once.key
    assert found.meta["aligned"]
    a, b = (np.stack([store.open(ref)[f"{way}_disparity"] for way in ("column", "row")]) for ref in (once, found))
    same = (np.abs(a - b) <= 0.01) | (np.isnan(a) & np.isnan(b))
    assert same.all(axis=0).mean() >= 0.999


def test_wrong_size_of_the_camera_is_one_clear_line(tmp_path, images):
    graph = Graph()
    given = pyramids(graph, images)
    less = (SHAPE[0] // 2, SHAPE[1] // 2)
    tiles.build(graph, HfvmParams(), given, less, 50, "hfvm")
    result = driver.run(graph, Store(tmp_path), driver.RunOptions(executor="inline"))
    assert {failure.error.code for failure in result.failures} == {"RIL-351"}


def test_tiles_follow_size_and_memory():
    small, large, params = ((600, 800),) * 2, ((4300, 5800),) * 2, HfvmParams()
    assert tiles.side(Tiling(), params, PyramidParams(), small) is None
    side = tiles.side(Tiling(), params, PyramidParams(), large)
    assert side is not None
    assert tiles.TILE_BYTES * side**2 <= 1e9
    assert tiles.side(Tiling(memory=300), params, PyramidParams(), large) < side
    assert tiles.side(Tiling(tile=0), params, PyramidParams(), large) is None
    assert tiles.side(Tiling(tile=256), params, PyramidParams(), small) == 256
    assert tiles.side(Tiling(tile=800), params, PyramidParams(), small) is None
    assert tiles.side(Tiling(tile=256), HfvmParams(preset="accurate"), PyramidParams(), large) is None


def test_a_pair_is_whole_where_an_image_lacks_the_level_that_tiles_start_from():
    tiling, small = Tiling(tile=96), ((200, 300), (48, 150))
    # Alignment and brightness are decided on at level 2.
    assert tiles.side(tiling, HfvmParams(), PyramidParams(), small) == 96
    assert tiles.side(tiling, HfvmParams(preset="fast"), PyramidParams(), small) is None
    assert tiles.side(tiling, HfvmParams(), PyramidParams(levels=2), small) is None


def test_tiling_is_a_section_of_the_configuration():
    assert build({"tiling": {"tile": 256}}).tiling == Tiling(tile=256)
    assert build({"tiling": {"tile": 0}}).tiling.tile == 0
    with raises("RIL-027", "tiling.tile = 5 is not permitted: 0, or at least 64"):
        build({"tiling": {"tile": 5}})
