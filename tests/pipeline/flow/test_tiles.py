"""Large pairs as tasks: equal digests, whatever the tiles; which pairs are tiled."""

import hashlib

import cv2
import numpy as np
import pytest

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow import tiles
from rille.pipeline.flow.config import build
from rille.pipeline.flow.tiles import Tiling
from rille.stages.core.declare import NoParams
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.imaging.pyramid import PyramidParams

SHAPE = (150, 190)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Textured PNG files, the left one sheared against the right one, so that a plane aligns them."""
    rng = np.random.default_rng(0)
    right = cv2.GaussianBlur(rng.normal(0, 1, SHAPE), (0, 0), 1.6)
    right = np.clip(128 + 35 * right / right.std(), 0, 255).astype(np.uint8)
    y, x = np.indices(SHAPE, np.float32)
    left = cv2.remap(right, x + 10 - np.float32(0.5) * y, y + 1, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    folder = tmp_path_factory.mktemp("images")
    paths = {"left": folder / "left.png", "right": folder / "right.png"}
    for camera, image in (("left", left), ("right", right)):
        cv2.imwrite(str(paths[camera]), image)
    return paths


def pyramids(graph, images):
    found = {}
    for camera, path in images.items():
        args = {"path": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "frame": 0}
        args |= {"camera": camera, "width": SHAPE[1], "height": SHAPE[0], "depth": 8}
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
        node = tiles.Tiles(graph, params, PyramidParams(), given, (SHAPE, SHAPE), side, "hfvm").build()
    driver.run(graph, store, driver.RunOptions(executor="inline")).check()
    return node.ref


@pytest.mark.parametrize(("preset", "side"), [("default", 96), ("fast", 50)])
def test_the_artifact_is_that_of_the_pair_matched_whole(tmp_path, images, preset, side):
    store, params = Store(tmp_path), HfvmParams(preset=preset)
    once = disparity(store, images, params, None)
    assert once.meta["aligned"]
    assert once.meta["match_rate"] > 0.4
    found = disparity(store, images, params, side)
    assert found.key != once.key
    assert found.digest == once.digest


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "fast"])
def test_mockup_in_tiles_of_256_has_the_digest_of_the_whole(tmp_path, preset):
    from rille.pipeline.flow.builders import Builder
    from rille.pipeline.runs.session import Options, settings

    digests = []
    for side in (0, 256):
        found = settings(Options("mockup-short", (f"hfvm.preset={preset}", f"tiling.tile={side}")))
        graph = Graph()
        disparity = Builder(graph, found.sequence, found.config).disparity(0)
        driver.run(graph, Store(tmp_path), driver.RunOptions(executor="inline")).check()
        digests.append(disparity.ref.digest)
    assert digests[0] == digests[1]


def test_wrong_size_of_the_camera_is_one_clear_line(tmp_path, images):
    graph = Graph()
    given = pyramids(graph, images)
    less = (SHAPE[0] // 2, SHAPE[1] // 2)
    tiles.Tiles(graph, HfvmParams(), PyramidParams(), given, (less, less), 50, "hfvm").build()
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
    tiling, shapes = Tiling(tile=96), ((200, 300), (96, 150))
    assert tiles.side(tiling, HfvmParams(plane_level=3), PyramidParams(), shapes) == 96
    # The right image ends at level 3; aligned to the left one it has level 4, which no task would have been there for.
    assert tiles.side(tiling, HfvmParams(plane_level=4), PyramidParams(), shapes) is None
    assert tiles.side(tiling, HfvmParams(plane_level=3, preset="fast"), PyramidParams(), shapes) is None
    assert tiles.side(tiling, HfvmParams(), PyramidParams(levels=1), shapes) is None


def test_tiling_is_a_section_of_the_configuration():
    assert build({"tiling": {"tile": 256}}).tiling == Tiling(tile=256)
