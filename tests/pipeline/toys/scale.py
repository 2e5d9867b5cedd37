"""One in, one out, with a helper in another file."""

from rille.stages.core.declare import Array, Bundle, Params, Stage


class ScaleParams(Params):
    """Parameters: ``offset``, m."""

    offset: float = 0.0


def _run(params, args, inputs):
    from toys.helper import double

    values = inputs["values"]["values"]
    out = double(values) + values.dtype.type(params.offset)
    return Bundle({"level_0": out, "level_1": out[::2, ::2].copy()}, {"levels": 2})


STAGE = Stage(
    name="scale",
    summary="twice as much",
    params=ScaleParams,
    inputs=("values",),
    outputs=(Array("level_*", ("row", "col"), "float32", "m", "scaled values", nodata="nan"),),
    run=_run,
)
