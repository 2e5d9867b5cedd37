"""Canonical form and digest: equal exactly for the same value of the same type."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from toys.scale import ScaleParams

from rille.pipeline.engine.keys import digest, text
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.engine.task import Spec, key_of, recipe
from rille.stages.core.declare import Params

scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


class Inner(Params):
    step: float = 0.5


class Outer(Params):
    inner: Inner = Inner()
    count: int = 3


class Twin(Params):
    inner: Inner = Inner()
    count: int = 3


def same(a, b):
    """Independent oracle: equality that tells types and the sign of zero apart, and has one NaN."""
    if type(a) is not type(b):
        return False
    if isinstance(a, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    if isinstance(a, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    return a == b


@given(values, values)
def test_digests_agree_exactly_for_the_same_value(a, b):
    assert (digest(a) == digest(b)) == same(a, b)


@given(values)
def test_canonical_form_is_json_and_ignores_the_order_of_keys(value):
    json.loads(text(value), parse_constant=pytest.fail)
    turned = dict(reversed(list(value.items()))) if isinstance(value, dict) else value
    assert digest(turned) == digest(value)


@given(st.sets(st.integers() | st.text(max_size=3) | st.floats(allow_nan=False)))
def test_sets_do_not_count_their_order(items):
    assert digest(items) == digest(frozenset(sorted(items, key=repr, reverse=True)))


def test_neighbours_are_told_apart():
    near = [
        1,
        1.0,
        True,
        "1",
        None,
        0,
        0.0,
        -0.0,
        False,
        "",
        [],
        {},
        set(),
        math.nan,
        math.inf,
        [1],
        {1},
        0.1 + 0.2,
        0.3,
    ]
    near += [["float", "nan"], {"float": "nan"}, ["list"], [[]]]
    assert len({digest(v) for v in near}) == len(near)


def test_every_nan_is_one_and_a_tuple_is_a_list():
    assert digest(float("nan")) == digest(-math.nan) == digest(np.float64("nan"))
    assert digest((1, (2.0,))) == digest([1, [2.0]])


def test_digest_is_pinned_across_versions():
    """A change of this digest makes every artifact ever stored a miss: raise spec.FORMAT knowingly."""
    assert text({"b": 0.5, "a": [1, True]}) == '{"a":["list",1,true],"b":["float","0x1.0000000000000p-1"]}'
    assert text([None, False, -3, '\u00e9"', math.nan, -math.inf, {2, "1"}, Inner()]) == (
        '["list",null,false,-3,"\\u00e9\\"",["float","nan"],["float","-inf"],["set","1",2],'
        '["model","Inner",{"step":["float","0x1.0000000000000p-1"]}]]'
    )
    assert digest({"b": 0.5, "a": [1, True]}) == "adc117e4d5871ea47f2398ac791dd4484c3de8655d09053e8b2403a6807cdc74"


@pytest.mark.parametrize("value", [Path("x"), np.int64(1), np.zeros(2), b"x", object(), {1: 2}, 1j])
def test_what_has_no_canonical_form_is_refused_with_its_place(value):
    with pytest.raises(TypeError, match=r"args\.rig\[1\]"):
        digest({"rig": [0, value]}, "args")


def test_models_count_with_their_defaults_filled():
    assert digest(Outer()) == digest(Outer(count=3, inner=Inner(step=0.5)))
    assert digest(Outer()) != digest(Outer(inner=Inner(step=0.25)))
    assert digest(Outer()) != digest(Twin())


def test_a_task_s_key_is_the_digest_of_its_recipe_with_one_for_what_its_stage_s_tasks_share():
    spec = Spec(
        "toys.scale", 'scale/"0"', ScaleParams(offset=0.5), {"pair": 3, "at": [0.1, None], "a": {"z": 1, "b": 2}}
    )
    one, other = (Ref(k * 64, "numbers", k * 64, {}, 0, 0.0) for k in "ab")
    for refs in ({"values": one}, {"values": other}, {"values": [one, other]}, {}):
        made = recipe(spec, refs)
        shared = {name: made.pop(name) for name in ("code", "env", "format", "stage")}
        assert key_of(spec, refs) == digest({"stage": digest(shared), **made})
    assert key_of(spec, {"values": one}) != key_of(spec, {"values": other})
    assert key_of(spec, {}) != key_of(replace(spec, params=ScaleParams(offset=0.25)), {})
    with pytest.raises(TypeError, match=r"args\.b is a object"):
        key_of(replace(spec, args={"b": object()}), {})
