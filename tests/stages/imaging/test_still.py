"""What keeps its place while the scene moves is found, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.imaging.still import still

ROWS, COLS, BODY = 120, 200, 80


def views(count=12, body=True, step=9):
    """A scene that moves by ``step`` pixels from image to image in changing light, and a body below row ``BODY``."""
    rng = np.random.default_rng(2)
    scene = np.kron(rng.integers(40, 200, (60, 400)), np.ones((2, 2)))
    own = np.kron(rng.integers(40, 200, (30, 100)), np.ones((2, 2)))
    images = []
    for k in range(count):
        image = scene[:ROWS, step * k : step * k + COLS].copy()
        if body:
            image[BODY:] = own[: ROWS - BODY]
        images.append(np.clip(image * (0.8 + 0.03 * k) + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    return images


def test_a_body_is_found_and_little_of_the_scene():
    found = still(views())
    assert found[BODY:].all()
    assert found[: BODY - 20].mean() == 0


@pytest.mark.parametrize("count", [5, 12])
def test_a_scene_that_moves_has_no_body(count):
    assert not still(views(count, body=False)).any()


def test_all_keeps_its_place_where_nothing_moves():
    assert still(views(step=0)).mean() > 0.9
