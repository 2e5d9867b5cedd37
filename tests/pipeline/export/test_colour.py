"""Colours of the ortho image: those of the pixels that show each cell, on the merged grey."""

import cv2
import numpy as np
import pytest
import rasterio
from test_output import run

from rille.datasets.images.files import decode_colour
from rille.pipeline.export import colour
from rille.pipeline.export.rasters import OUTPUTS
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice

CAMERA = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
LATTICE = Lattice(x0=-0.5, y0=0.4, cell=0.02, rows=40, cols=50)


class View:
    """Two frames that look straight down on flat ground 1 m below, one red on its left half, the other blue."""

    def __init__(self, shade):
        self.frames = (0, 1)
        red, blue = np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160, 3), np.uint8)
        red[..., 0], blue[..., 2] = shade, shade
        images = {
            0: Bundle({"image": red[..., 0], "colour": red}, {}),
            1: Bundle({"image": blue[..., 0], "colour": blue}, {}),
        }
        down = np.diag([1.0, -1.0, -1.0])
        poses = np.array([RigidTransform(down, np.array([x, 0.0, 0.0])).matrix34 for x in (0.0, 0.1)])
        rig = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
        made = {
            "trajectory": Bundle({"poses": poses}, {"frames": [0, 1]}),
            **{f"image{k}": b for k, b in images.items()},
        }
        self.bundle = lambda name: made.get(name)
        self.products = type("Products", (), {
            "images": {0: "image0", 1: "image1"}, "trajectory": "trajectory", "rigs": {},
        })  # fmt: skip
        self.sequence = type("Sequence", (), {"rig": rig})


def merged(source):
    flat = np.full(LATTICE.shape, -1.0, np.float32)
    return {"ortho": np.full(LATTICE.shape, 100, np.float32), "elevation": flat, "source": source}


def test_each_cell_takes_the_colour_of_its_pair_and_keeps_the_merged_grey():
    source = np.zeros(LATTICE.shape, np.int16)
    source[:, 25:] = 1
    arrays = merged(source)
    arrays["ortho"][:3] = np.nan
    source[3] = -1
    rgb = colour.ortho(View(200), LATTICE, arrays)
    assert (rgb[:3] == 0).all()
    assert (rgb[3] == 100).all()  # interpolated: no pair, no colour
    np.testing.assert_allclose(rgb[5:, 25:] @ colour.LUMA, 100, atol=16)  # clipped at 255 and 1
    red, blue = rgb[5:, 5:20], rgb[5:, 30:45]
    assert (red[..., 0] > red[..., 2] + 100).all()
    assert (blue[..., 2] > blue[..., 0] + 100).all()


def test_grey_sequences_write_grey_ortho_images(tmp_path):
    view, _ = run()
    assert not colour.coloured(view, np.zeros((1, 1), int))
    (row,) = (output for output in OUTPUTS if output.name == "ortho.tif")
    row.write(tmp_path / "ortho.tif", view)
    with rasterio.open(tmp_path / "ortho.tif") as found:
        assert (found.count, found.dtypes[0]) == (1, "float32")


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_files_give_their_colours_and_the_grey_of_before(depth):
    rng = np.random.default_rng(0)
    bgr = rng.integers(0, np.iinfo(depth).max, (40, 50, 3)).astype(depth)
    grey, rgb = decode_colour(cv2.imencode(".png", bgr)[1].tobytes(), "a.png")
    np.testing.assert_array_equal(grey, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY))
    np.testing.assert_array_equal(rgb, (bgr[..., ::-1] >> (0 if depth == np.uint8 else 8)).astype(np.uint8))
    same = np.repeat(bgr[..., :1], 3, axis=2)
    assert decode_colour(cv2.imencode(".png", same)[1].tobytes(), "a.png")[1] is None
    assert decode_colour(cv2.imencode(".png", bgr[..., 0])[1].tobytes(), "a.png")[1] is None


def test_a_first_image_that_is_dark_does_not_take_the_colours_of_all():
    view = View(200)
    assert "colour" in view.bundle("image1").arrays
    dark = Bundle({"image": np.zeros((120, 160), np.uint8)}, {})
    given = view.bundle
    view.bundle = lambda name: dark if name == "image0" else given(name)
    assert colour.coloured(view, np.array([[-1, 0], [0, 1]]))
    assert not colour.coloured(view, np.array([[-1, 0]]))
