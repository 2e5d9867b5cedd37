"""Matches that deserve doubt as a whole, and those that do not."""

import cv2
import numpy as np
from matching_scenes import Texture, convergent_rig, pair, rig_displacement

from rille.stages.calibration import doubt
from rille.stages.calibration.doubt import doubts
from rille.stages.core.validity import matched
from rille.stages.hfvm.stage import match


def codes(left, right):
    found = match(left, right)
    return [line[:7] for line in doubts(found, left, right)]


def test_a_rigid_scene_without_repetition_is_not_doubted():
    depth = lambda x, y: 1.5 + 0.3 * np.sin(x / 25) + 0.002 * y  # noqa: E731
    left, right, *_ = pair(rig_displacement(convergent_rig(), depth), noise=1.0)
    assert codes(left, right) == []


def test_an_image_that_is_matched_with_itself_is_doubted():
    left, *_ = pair(rig_displacement(convergent_rig(), lambda x, y: 1.5 + 0.3 * np.sin(x / 25)), noise=1.0)
    assert codes(left, left.copy()) == ["RIL-708"]


def test_a_chess_board_is_doubted_wherever_it_lies():
    y, x = np.indices((200, 320))
    board = cv2.GaussianBlur(((x // 12 + y // 12) % 2 * 120 + 60).astype(np.uint8), (0, 0), 1)
    assert "RIL-704" in codes(board[:, 30:], board[:, :-30])


def test_a_field_that_no_camera_makes_is_doubted():
    left, right, *_ = pair(lambda x, y: (-8 + 5 * np.sin(y / 18) * np.cos(x / 30), 6 * np.sin(x / 22)), noise=1.0)
    assert codes(left, right) == ["RIL-703"]


def test_too_few_matches_are_not_judged():
    y, x = np.indices((140, 180), dtype=np.float64)
    left, right = Texture(0)(x, y), Texture(1)(x, y)
    found = match(left, right)
    assert doubt.judge(left, right, found, matched(found.validity)) is None


def test_lines_of_an_exact_geometry_hold_all_matches():
    _, _, u, v = pair(rig_displacement(convergent_rig(), lambda x, y: 1.5 + 0.3 * np.sin(x / 25)))
    places = doubt.sample(u, v, np.ones(u.shape, bool))
    assert doubt.on_their_lines(places, doubt.lines(places)) > 0.99
    assert doubt.on_their_lines(places, None) == 0.0
