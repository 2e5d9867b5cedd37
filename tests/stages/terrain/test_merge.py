from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raising import raises
from terrain_scenes import ArrayLayer

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice, mosaic
from rille.stages.terrain import merge as merge_stage
from rille.stages.terrain.merge import (
    EXACT,
    Merged,
    MergeParams,
    Placed,
    footprint,
    merge,
)

TILE = Lattice.at(0, 0, 0.1, 4, 5)
PARAMS = MergeParams()


def layer(
    pair: int,
    elevation: object,
    std: object = 0.1,
    ortho: object = 100.0,
    lattice: Lattice = TILE,
) -> ArrayLayer:
    arrays = (np.broadcast_to(np.asarray(v, np.float32), lattice.shape).copy() for v in (elevation, std, ortho))
    return ArrayLayer(pair, lattice, *arrays)


def noisy(count: int, seed: int = 0) -> list[ArrayLayer]:
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        z = rng.normal(0.0, 0.1, TILE.shape)
        z[rng.random(TILE.shape) < 0.2] = np.nan
        std = rng.uniform(0.05, 0.2, TILE.shape)
        out.append(layer(k, z, std, rng.uniform(0, 255, TILE.shape)))
    return out


def arrays(merged: Merged) -> list[np.ndarray]:
    return list(merged)


def test_two_models_by_hand() -> None:
    """Weights 1/0.1^2 = 100 and 1/0.2^2 = 25: mean of 1.0 and 1.6 is 1.12."""
    merged = merge([layer(0, 1.0), layer(4, 1.6, std=0.2, ortho=200.0)], TILE, PARAMS)
    np.testing.assert_allclose(merged.elevation, 1.12, rtol=1e-6)
    # Shares 4/5 and 1/5: relief 0.08 and 0.04; fully alike their mean has 0.12.
    np.testing.assert_allclose(merged.relief_std, np.hypot(0.08, 0.04), rtol=1e-6)
    np.testing.assert_allclose(merged.elevation_std, np.sqrt(0.2 * (0.08**2 + 0.04**2) + 0.8 * 0.12**2), rtol=1e-6)
    np.testing.assert_allclose(merged.spread, np.sqrt(0.8 * 0.12**2 + 0.2 * 0.48**2), rtol=1e-6)
    assert (merged.count == 2).all()
    assert (merged.source == 0).all()
    np.testing.assert_allclose(merged.ortho, 100.0, atol=0.01)  # the best image, not a double exposure


def test_two_models_of_any_standard_deviations_by_the_equations() -> None:
    rng = np.random.default_rng(8)
    z, std, ortho = (rng.uniform(*ends, (2, *TILE.shape)) for ends in ((0, 1), (0.05, 0.2), (9, 200)))
    merged = merge([layer(k, z[k], std[k], ortho[k]) for k in range(2)], TILE, PARAMS)
    weight = 1.0 / std**2
    share = weight / weight.sum(axis=0)
    mean = (share * z).sum(axis=0)
    alone, together = ((share * std) ** 2).sum(axis=0), (share * std).sum(axis=0) ** 2
    sharp = (weight / weight.max(axis=0)) ** 8
    np.testing.assert_allclose(merged.elevation, mean, rtol=1e-5)
    np.testing.assert_allclose(merged.relief_std, np.sqrt(alone), rtol=1e-5)
    np.testing.assert_allclose(merged.elevation_std**2, (1 - PARAMS.alike) * alone + PARAMS.alike * together, rtol=1e-5)
    np.testing.assert_allclose(merged.spread, np.sqrt((share * (z - mean) ** 2).sum(axis=0)), rtol=1e-4)
    np.testing.assert_allclose(merged.ortho, (sharp * ortho).sum(axis=0) / sharp.sum(axis=0), rtol=1e-4)
    np.testing.assert_array_equal(merged.source, weight.argmax(axis=0))


def test_cells_without_grey_values_have_an_elevation() -> None:
    merged = merge([layer(0, 1.0, ortho=np.nan), layer(1, 1.0, ortho=np.nan)], TILE, PARAMS)
    np.testing.assert_allclose(merged.elevation, 1.0)
    assert np.isnan(merged.ortho).all()


def test_one_model_passes_through() -> None:
    one = noisy(1)[0]
    merged = merge([one], TILE, PARAMS)
    assert np.array_equal(merged.elevation, one.elevation, equal_nan=True)
    seen = np.isfinite(one.elevation)
    np.testing.assert_allclose(merged.elevation_std[seen], one.elevation_std[seen], rtol=1e-6)
    np.testing.assert_allclose(merged.relief_std[seen], one.elevation_std[seen], rtol=1e-6)
    np.testing.assert_allclose(merged.ortho[seen], one.ortho[seen], rtol=1e-6)
    assert (merged.spread[seen] == 0).all()
    assert np.array_equal(merged.count, seen.astype(np.uint16))
    assert np.array_equal(merged.source == -1, ~seen)


@given(st.permutations(range(5)), st.integers(0, 5))
def test_order_changes_no_bit(order: list[int], seed: int) -> None:
    layers = noisy(5, seed)
    for a, b in zip(
        arrays(merge(layers, TILE, PARAMS)), arrays(merge([layers[i] for i in order], TILE, PARAMS)), strict=True
    ):
        assert a.tobytes() == b.tobytes()


def test_of_equal_weights_the_first_pair_is_the_source() -> None:
    for order in (1, -1):
        merged = merge([layer(8, 0.1), layer(4, 0.2)][::order], TILE, PARAMS)
        assert (merged.source == 4).all()


def test_a_pair_late_in_a_long_sequence_is_the_source() -> None:
    assert (merge([layer(70_000, 0.1)], TILE, PARAMS).source == 70_000).all()


@given(st.integers(1, 6), st.integers(0, 20))
def test_the_mean_lies_among_the_models(count: int, seed: int) -> None:
    layers = noisy(count, seed)
    merged = merge(layers, TILE, PARAMS)
    stack = np.array([one.elevation for one in layers])
    seen = np.isfinite(stack).any(axis=0)
    assert np.array_equal(np.isfinite(merged.elevation), seen)
    assert (merged.count <= np.isfinite(stack).sum(axis=0)).all()
    low, high = np.nanmin(stack[:, seen], axis=0), np.nanmax(stack[:, seen], axis=0)
    assert ((merged.elevation[seen] >= low - 1e-6) & (merged.elevation[seen] <= high + 1e-6)).all()


@pytest.mark.parametrize("where", [0, 1, 2, 3])
def test_one_model_that_contradicts_does_not_pull(where: int) -> None:
    good = [0.00, 0.02, -0.02]
    values = [*good[:where], 5.0, *good[where:]]
    merged = merge([layer(k, z, 0.02) for k, z in enumerate(values)], TILE, PARAMS)
    # With the outlier in the mean it would be 1.25; the rest agrees to 0.02.
    assert np.abs(merged.elevation).max() < 0.02
    assert (merged.count == 3).all()
    assert (merged.source != where).all()


def test_of_three_models_the_third_has_less_weight_by_the_biweight() -> None:
    z, std = np.array([0.0, 0.1, 0.5]), 0.1
    merged = merge([layer(k, v, std) for k, v in enumerate(z)], TILE, PARAMS)
    off = np.abs(z - np.median(z))
    unit = 4.685 * max(1.4826 * np.median(off), std)
    weight = (1.0 - (off / unit) ** 2) ** 2
    np.testing.assert_allclose(merged.elevation, (weight * z).sum() / weight.sum(), rtol=1e-5)


def test_equal_models_have_no_spread() -> None:
    merged = merge([layer(k, -0.7, 0.02 * (k + 1)) for k in range(4)], TILE, PARAMS)
    np.testing.assert_allclose(merged.elevation, -0.7, rtol=1e-6)
    np.testing.assert_allclose(merged.spread, 0.0, atol=1e-7)
    assert (merged.source == 0).all()


def test_std_of_normal_models_is_calibrated() -> None:
    tile = Lattice.at(0, 0, 0.1, 100, 100)
    rng = np.random.default_rng(3)
    layers = []
    for k in range(5):
        std = rng.uniform(0.05, 0.2, tile.shape)
        layers.append(layer(k, rng.normal(0.0, std), std, lattice=tile))
    merged = merge(layers, tile, PARAMS)
    assert 0.9 < (merged.elevation / merged.relief_std).std() < 1.15
    independent = merge(layers, tile, MergeParams(alike=0.0))
    assert independent.elevation_std.tobytes() == merged.relief_std.tobytes()


def test_std_of_models_that_share_a_part_of_their_error_is_calibrated() -> None:
    """Errors with a correlation of one half from model to model, all of one standard deviation."""
    tile = Lattice.at(0, 0, 0.1, 100, 100)
    rng = np.random.default_rng(4)
    common = rng.normal(0.0, 0.1, tile.shape)
    layers = [layer(k, np.sqrt(0.5) * (common + rng.normal(0.0, 0.1, tile.shape)), lattice=tile) for k in range(2)]
    merged = merge(layers, tile, MergeParams(alike=0.5))
    assert 0.97 < (merged.elevation / merged.elevation_std).std() < 1.03
    assert (merged.elevation / merged.relief_std).std() > 1.15


def test_errors_of_poses_do_not_average_out() -> None:
    """Two models whose poses err together: simulated heights and tilts against the stated standard deviation."""
    rng = np.random.default_rng(5)
    root = np.array([[0.01, 0.0, 0.0], [0.004, 0.02, 0.0], [-0.003, 0.01, 0.03]])
    pose = Placed(np.array([0.1, -0.7, 0.0]), root @ root.T)
    layers = [replace(layer(k, 1.0, 1e-5), pose=pose) for k in range(2)]
    merged = merge(layers, TILE, PARAMS)
    xy = TILE.xy() - pose.centre[:2]
    errors = rng.normal(size=(20000, 3)) @ root.T
    found = errors[:, 0, None, None] + errors[:, 1, None, None] * xy[..., 1] - errors[:, 2, None, None] * xy[..., 0]
    np.testing.assert_allclose(merged.elevation_std, found.std(axis=0), rtol=0.03)
    np.testing.assert_allclose(merged.relief_std, 1e-5 / np.sqrt(2), rtol=1e-6)
    assert (
        merged.elevation.tobytes() == merge([layer(k, 1.0, 1e-5) for k in range(2)], TILE, PARAMS).elevation.tobytes()
    )


def test_a_rotation_moves_the_ground_as_its_covariance_says() -> None:
    """A rotation about x lifts what lies ahead (y), one about y lowers what lies to the right (x)."""
    meta = {"pose_covariance": np.diag([9, 9, 0, 1e-4, 0, 9]).ravel().tolist()}
    meta |= {"T_frame_left": np.hstack([np.eye(3), [[0.2], [-0.1], [0.5]]]).ravel().tolist()}
    ahead = merge([replace(layer(0, 0.0, 1e-6), pose=Placed.of(meta))], TILE, PARAMS).elevation_std
    np.testing.assert_allclose(ahead, np.abs(TILE.xy()[..., 1] + 0.1) * 1e-2, atol=1e-6)
    assert Placed.of({}) is EXACT


def test_a_repaired_rig_moves_the_ground_along_its_rays() -> None:
    """The same ground, intersected anew with inverse depths that are all off by as much."""
    left = RigidTransform(np.array([[1.0, 0.0, 0.0], [0.0, -0.6, 0.8], [0.0, -0.8, -0.6]]), np.array([0.0, -3.0, 1.5]))
    meta = {"T_frame_left": left.to_list()}
    models = [replace(layer(k, 0.25, 1e-7), pose=Placed.of(meta)) for k in range(2)]
    merged = merge(models, TILE, PARAMS, 1e-3)
    ground = np.dstack([TILE.xy(), np.full(TILE.shape, 0.25)])
    seen = left.inverse().apply(ground)
    moved = left.apply(seen / (1.0 + 1e-3 * seen[..., 2:]))
    np.testing.assert_allclose(merged.elevation_std, moved[..., 2] - ground[..., 2], rtol=0.01)
    np.testing.assert_allclose(merged.relief_std, 1e-7 / np.sqrt(2), rtol=1e-6)


def test_unsure_cells_are_left_undefined_on_request() -> None:
    one, other = layer(0, 1.0, 0.05), layer(4, 1.0, 0.05)
    one.elevation_std[0], other.elevation[:2] = 0.2, np.nan
    one.elevation_std[1] = 0.06
    merged = merge([one, other], TILE, MergeParams(max_std_cells=0.7))  # 0.07 m
    assert np.isnan(merged.elevation[0]).all()
    assert np.isnan(merged.elevation_std[0]).all()
    assert (merged.count[0] == 0).all()
    assert (merged.source[0] == -1).all()
    assert np.isfinite(merged.elevation[1:]).all()
    drifting = Placed(np.zeros(3), np.diag([1.0, 0.0, 0.0]))
    merged = merge([replace(one, pose=drifting)], TILE, MergeParams(max_std_cells=0.7))
    assert np.isfinite(merged.elevation[1:]).all(), "poses' part does not count"


def test_unusable_values_have_no_weight() -> None:
    bad = layer(1, 9.0)
    bad.elevation_std[0] = np.nan
    bad.elevation_std[1] = 0.0
    bad.elevation[2] = np.nan
    bad.elevation_std[3] = np.inf
    merged = merge([layer(0, 1.0, ortho=50.0), bad], TILE, PARAMS)
    np.testing.assert_allclose(merged.elevation, 1.0)
    assert (merged.count == 1).all()
    nothing = merge([layer(0, np.nan)], TILE, PARAMS)
    assert not np.isfinite(nothing.elevation).any()
    assert (nothing.source == -1).all()
    far = merge([layer(0, 1.0, lattice=Lattice.at(90, 90, 0.1, 2, 2))], TILE, PARAMS)
    assert not np.isfinite(far.ortho).any()
    assert (far.count == 0).all()


def test_what_is_refused() -> None:
    with pytest.raises(AssertionError):
        merge([layer(1, 0.0), layer(1, 1.0)], TILE, PARAMS)
    with raises("RIL-361"):
        merge([layer(1, 0.0, lattice=Lattice.at(0, 0, 0.2, 4, 5))], TILE, PARAMS)


def test_tiles_of_the_stage_equal_the_whole() -> None:
    rng = np.random.default_rng(1)
    dems, layers = [], []
    for k in range(4):
        lattice = Lattice.at(int(rng.integers(-20, 5)), int(rng.integers(5, 20)), 0.1, 25, 30)
        names = ("elevation", "elevation_std", "ortho")
        maps = {n: rng.uniform(0.05, 0.2, lattice.shape).astype(np.float32) for n in names}
        dems.append(Bundle(maps, {"lattice": lattice.to_dict(), "pair": 4 * k, "frame": "world"}))
        layers.append(ArrayLayer(4 * k, lattice, **maps))
    whole = Lattice.at(-20, 20, 0.1, 45, 55)
    at_once = merge(layers, whole, PARAMS)
    parts = []
    for tile in whole.tiles(16):
        bundle = merge_stage.merge_stage.run(PARAMS, {"lattice": tile.to_dict()}, {"dems": dems[::-1]})
        check_outputs(merge_stage.merge_stage, bundle)
        json.dumps(bundle.meta, allow_nan=False)
        parts.append((tile, bundle))
    for name, nodata in (("elevation", np.nan), ("spread", np.nan), ("ortho", np.nan), ("count", 0), ("source", -1)):
        got = mosaic([(tile, bundle[name]) for tile, bundle in parts], nodata, whole)
        assert got.tobytes() == getattr(at_once, name).tobytes(), name


@pytest.mark.parametrize("lines", [1, 7, 1000])
def test_strips_of_any_height_give_the_same_bits(monkeypatch: pytest.MonkeyPatch, lines: int) -> None:
    tile = Lattice.at(0, 0, 0.1, 40, 30)
    rng = np.random.default_rng(5)
    layers = [
        ArrayLayer(k, at, *(rng.uniform(0.05, 0.2, at.shape).astype(np.float32) for _ in range(3)))
        for k, at in enumerate(Lattice.at(3 * k - 9, 4 * k - 12, 0.1, 25, 20) for k in range(7))
    ]
    whole = merge(layers, tile, PARAMS)
    monkeypatch.setattr(merge_stage, "STRIP_BYTES", 16 * len(layers) * tile.cols * lines)
    for a, b in zip(arrays(whole), arrays(merge(layers, tile, PARAMS)), strict=True):
        assert a.tobytes() == b.tobytes()


def test_of_a_stored_model_the_tile_alone_is_read() -> None:
    class Windows:
        def __init__(self, values: np.ndarray) -> None:
            self.values = values

        def __getitem__(self, window: tuple[slice, slice]) -> np.ndarray:
            Watched.cells = max(Watched.cells, self.values[window].size)
            return self.values[window]

    class Watched(dict):
        """Arrays that are read part by part, as those of an artifact."""

        cells = 0

        def raster(self, name: str) -> Windows:
            return Windows(self[name])

    lattice = Lattice.at(-500, 500, 0.1, 1000, 1000)
    maps = {n: np.full(lattice.shape, 0.5, np.float32) for n in ("elevation", "elevation_std", "ortho")}
    dem = Bundle(Watched(maps), {"lattice": lattice.to_dict(), "pair": 4, "frame": "world"})
    merged = merge_stage.merge_stage.run(PARAMS, {"lattice": TILE.to_dict()}, {"dems": [dem]})
    assert Watched.cells == TILE.rows * TILE.cols
    assert (merged["elevation"] == 0.5).all()


def test_the_footprint_is_the_ground_between_two_rays_a_pixel_apart() -> None:
    height, angle, far = 0.2, 0.002, np.array([0.0, 0.1, 0.5, 1.0])
    found = footprint(np.zeros((1, 4), np.float32), far, np.zeros(1), np.array([0.0, 0.0, height]), angle)[0]
    down = np.arctan2(far, height)
    between = height * (np.tan(down + angle / 2) - np.tan(down - angle / 2))
    np.testing.assert_allclose(found, between, rtol=1e-3)
    assert footprint(np.float32([[0.3]]), np.zeros(1), np.zeros(1), np.array([0.0, 0.0, height]), angle)[0, 0] == np.inf


def test_cells_seen_from_afar_alone_are_left_out_on_request_and_what_is_vouched_for_stays() -> None:
    """A camera 1 m above the corner: at 0.01 rad a pixel covers 1.04 cm under 0.2 m of it, 1.17 cm at 0.41 m."""
    names = ("elevation", "elevation_std", "ortho")
    maps = {n: np.full(TILE.shape, 0.05, np.float32) for n in names}
    T = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.05]
    facts = {"lattice": TILE.to_dict(), "frame": "world"}
    seen = Bundle(maps, facts | {"pair": 4, "T_frame_left": T, "pixel_rad": 0.01})
    known = Bundle({n: v + np.float32(0.1) for n, v in maps.items()}, facts | {"pair": -1})
    near = np.hypot(*np.moveaxis(TILE.xy(), -1, 0)) < 0.31

    def merged(dems: list[Bundle], most: float | None) -> Bundle:
        params = MergeParams(max_footprint=most)
        return merge_stage.merge_stage.run(params, {"lattice": TILE.to_dict()}, {"dems": dems})

    assert (merged([seen], None)["count"] == 1).all()
    assert np.array_equal(merged([seen], 0.01 * (1 + 0.31**2))["count"], near)
    both = merged([seen, known], 0.01 * (1 + 0.31**2))
    assert np.array_equal(both["count"], 1 + near)
    np.testing.assert_allclose(both["elevation"][~near], 0.15, rtol=1e-6)


def test_exposures_are_levelled_and_stay_grey_values() -> None:
    layers = [layer(0, 1.0, ortho=100.0), layer(4, 1.0, ortho=100.0), layer(8, np.nan)]
    bundles = [
        Bundle({n: getattr(one, n) for n in ("elevation", "elevation_std", "ortho")},
               {"lattice": TILE.to_dict(), "pair": one.pair})
        for one in layers
    ]  # fmt: skip
    args = {"lattice": TILE.to_dict(), "exposure": {"4": 20}}
    merged = merge_stage.merge_stage.run(PARAMS, args, {"dems": bundles})
    np.testing.assert_allclose(merged["ortho"], 50 * (1 + np.exp(0.2)), rtol=1e-5)
    merged = merge_stage.merge_stage.run(PARAMS, args | {"exposure": {"0": 99, "4": 99}}, {"dems": bundles})
    np.testing.assert_allclose(merged["ortho"], 255.0)
