"""Share of a frame that is still seen: flows whose share is known, with what leaves the image unmatched."""

import numpy as np
import pytest
from motion_scenes import CAMERA, drive, motion, share_kept, shift, turned, zoom

from rille.stages.geometry.geometry import rotation_exp
from rille.stages.odometry.steps import Step, overlaps

# The edge of the image cuts blocks, of which the part inside is taken by the distance of the centre: exact for shifts,
# and off by a few per cent of a block (17 x 12 of them) where they are scaled or turned.
CUT = 0.015


def after(*bundles):
    *_, last = overlaps([Step.from_bundle(b) for b in bundles])
    return last


def test_nothing_moves():
    seen = after(*[motion(shift(0.0))] * 5)
    assert seen == (1.0, 1.0)


@pytest.mark.parametrize(("u", "v"), [(48.0, 0.0), (-61.0, 0.0), (0.0, 35.0), (37.0, -21.0)])
def test_shifts_lose_a_strip_of_each_frame(u, v):
    step = motion(shift(u, v), wrong=(0.0, 0.0))
    one, two = (((480 - n * abs(u)) / 480) * ((320 - n * abs(v)) / 320) for n in (1, 2))
    assert min(after(step)) == pytest.approx(one, abs=CUT)
    assert min(after(step, step)) == pytest.approx(two, abs=CUT)


def test_what_has_left_does_not_return():
    out, back = motion(shift(120.0)), motion(shift(-120.0))
    assert after(out, back).kept == pytest.approx(0.75, abs=CUT)


@pytest.mark.parametrize("scale", [1.1, 1.25])
def test_zoom_loses_the_border_and_its_reverse_gains_one(scale):
    ahead, back = after(motion(zoom(scale))), after(motion(zoom(1 / scale)))
    assert ahead.kept == pytest.approx(scale**-2, abs=CUT)
    assert ahead.covered == pytest.approx(1.0, abs=CUT)
    assert back.kept == pytest.approx(1.0, abs=CUT)
    assert back.covered == pytest.approx(scale**-2, abs=CUT)
    assert min(ahead) == pytest.approx(min(back), abs=2 * CUT)


def test_near_ground_that_leaves_below_is_counted_though_it_finds_no_match():
    flow = drive(0.15)
    truth = share_kept(flow)
    assert truth < 0.85
    # False displacements of the strip that leaves, as interpolation along rows gives them, change nothing.
    for wrong in ((0.0, 0.0), (15.0, -20.0)):
        assert min(after(motion(flow, wrong=wrong))) == pytest.approx(truth, abs=0.02)


@pytest.mark.parametrize("axis", [(0, 0, 0.5), (0, 0.15, 0), (0.1, -0.1, 0.2)])
def test_turning_camera(axis):
    flow = turned(rotation_exp(axis))
    seen = after(motion(flow))
    assert seen.kept == pytest.approx(share_kept(flow), abs=2 * CUT)
    assert seen.covered == pytest.approx(share_kept(turned(rotation_exp(axis).T)), abs=2 * CUT)


def test_holes_without_texture_take_the_motion_of_their_surroundings():
    def sky(x, y):
        return (y < 90) | ((x > 200) & (x < 300))

    assert min(after(motion(shift(96.0), unmatched=sky))) == pytest.approx(0.8, abs=CUT)


def test_matches_too_few_for_a_median_are_no_displacement():
    rng = np.random.default_rng(0)
    step = Step.from_bundle(motion(shift(5.0), unmatched=lambda x, y: rng.random(x.shape) < 0.8))
    assert not step.known.any()
    assert step.displacement is None
    assert step.match_rate == 0.0
    step = Step.from_bundle(motion(shift(3.0, 4.0)))
    assert step.displacement == 5.0
    assert step.match_rate == pytest.approx(1.0, abs=0.03)  # a strip leaves the image
    for covered, whole in zip(step.size, (480, 320), strict=True):
        assert whole - step.side < covered <= whole


def test_blocks_tile_odd_sizes():
    bundle = motion(shift(0.0))
    cut = type(bundle)({k: v[:61, :97] for k, v in bundle.arrays.items()}, bundle.meta)
    step = Step.from_bundle(cut)
    assert (step.blocks.min(0) == 0.5 * step.side - 0.5).all()
    assert (step.blocks.max(0) == np.array(step.size) - 0.5 * step.side - 0.5).all()
    assert step.size[0] <= 97 * 4
    assert step.size[0] > 97 * 4 - step.side
    assert step.side < CAMERA.height / 8
