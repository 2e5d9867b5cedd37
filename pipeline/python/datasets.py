"""Results of stages as datasets of xarray, and datasets given back as what the next step needs.

Attributes of a dataset carry the facts of its stage, the settings of all steps before, and checksums of the images.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from collections.abc import Sequence as Series
from typing import TYPE_CHECKING, Any

import numpy as np

from rille.pipeline.engine.store.arrays import DIMS, coordinates, lattice_of
from rille.pipeline.flow import config
from rille.pipeline.python.arguments import Settings
from rille.stages.core.declare import AnyArray, Array, Bundle, Stage
from rille.stages.core.errors import InputError

if TYPE_CHECKING:
    import xarray

ELSEWHERE: Mapping[str, str] = {
    "column_disparity": "; disparities of another program are read by [disparity] of a manifest",
    "elevation": "; rille.reconstruct(..., vehicle={...}) judges the terrain of a run anew",
}
"""Where data of another origin than the step before are taken, by the variable of that step."""


def carried(meta: Settings, settings: Settings, images: Series[int | None] = ()) -> dict[str, str]:
    """Attribute for the next step; ``images``: checksums of one image, or of the left and the right one."""
    return {"rille": json.dumps({"meta": dict(meta), "settings": dict(settings), "images": images})}


def noted(data: Any) -> dict[str, Any]:
    """What the step before has attached by :func:`carried`."""
    try:
        noted = json.loads(getattr(data, "attrs", {}).get("rille", "{}"))
    except (TypeError, ValueError):  # of the user's own
        noted = {}
    return noted if isinstance(noted, dict) else {}


def settings_of(data: Any) -> dict[str, Any]:
    """Settings of the steps before."""
    return dict(noted(data).get("settings", {}))


def merged(data: xarray.Dataset, *more: Settings) -> dict[str, Any]:
    """Settings of the step before, and what is given now over them."""
    settings: dict[str, Any] = {}
    # Later layers win: settings of the sequence, settings of the step before, settings of this call.
    for layer in (*more[:-1], settings_of(data), more[-1]):
        config.merge(settings, layer)
    return settings


def bundle_of(
    data: xarray.Dataset, stage: Stage, needs: Series[str], maker: str, nothing: Mapping[str, int] | None = None
) -> Bundle:
    """What a step before has made by ``stage``.

    ``needs``: variables without which the next step cannot be; the first tells the datasets of ``stage`` from those of
    others. ``nothing``: values of whole numbers where a mask hides them, 0 where none is named; None: the next step
    needs none of the facts that :func:`carried` attaches.
    """
    given = getattr(data, "data_vars", ())
    bands = [array for array in stage.outputs if array.name in given]
    lacking = [name for name in needs if name not in given]
    lacking += [f"{b.name} ({', '.join(b.dims)})" for b in bands if data[b.name].dims != b.dims]
    meta = noted(data).get("meta", {})
    if not (lacking or meta or nothing is None):
        lacking = ["attribute rille"]
        remedy = f"where xarray has dropped it, data.attrs = MADE.attrs, with MADE what {maker} returned, restores it"
    else:
        remedy = f"give what {maker} returns, whole"
    lattice = None if lacking else lattice_of(meta)
    # Cut, turned or thinned out, the values would be taken for those of other places.
    places = {} if lattice is None else coordinates(lattice, "")
    same = (name in data.coords and np.array_equal(data[name], values) for name, (values, _, _) in places.items())
    lacking += [] if all(same) else ["x and y of all its cells, as they were"]
    if lacking:
        elsewhere = ELSEWHERE.get(needs[0], "")
        raise InputError("RIL-864", f"the dataset has no {lacking[0]}", remedy=f"{remedy}{elsewhere}")
    hidden = nothing or {}
    return Bundle({b.name: _as_declared(b, np.asarray(data[b.name]), hidden.get(b.name, 0)) for b in bands}, meta)


def _as_declared(about: Array, values: AnyArray, nothing: int) -> AnyArray:
    """Values of the declared type, ``nothing`` where a mask over the whole dataset hides whole numbers by NaN."""
    dtype = np.dtype(about.dtype)
    if values.dtype.kind in "biuf":
        shown = np.where(np.isnan(values), nothing, values) if dtype.kind != "f" else values
        with np.errstate(invalid="ignore"):
            made = shown.astype(dtype)
        if dtype.kind == "f" or np.array_equal(made, shown):
            return made
    text = f"{about.name} is {values.dtype} with other values than {dtype} has"
    remedy = f"mask it by a whole number, e.g. data.assign({about.name}=data.{about.name}.where(mask, 0))"
    raise InputError("RIL-971", text, remedy=remedy)


def dataset_of(stage: Stage, result: Bundle, settings: Settings, images: Series[int | None] = ()) -> xarray.Dataset:
    """Arrays with the dimensions, units and words that the stage declares, and coordinates of their lattice."""
    import xarray

    variables, lattice = {}, lattice_of(result.meta)
    for name, values in result.arrays.items():
        about = next(array for array in stage.outputs if array.matches(name))
        attrs = {"units": about.unit, "long_name": about.long_name}
        variables[name] = (about.dims, np.asarray(values), attrs)
    on_it = lattice is not None and any(list(dims) == DIMS for dims, _, _ in variables.values())
    places = coordinates(lattice, str(result.meta.get("frame", "local"))) if lattice is not None and on_it else {}
    coords = {name: (dims, values, attrs) for name, (values, dims, attrs) in places.items()}
    plain = {k: v for k, v in result.meta.items() if isinstance(v, str | int | float) and not isinstance(v, bool)}
    return xarray.Dataset(variables, coords, {**plain, **carried(result.meta, settings, images)})
