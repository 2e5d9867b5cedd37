"""The reference of a manifest's keys: a page that follows from its models; ``make pages`` writes it anew."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import tomli_w

from rille.datasets.manifest.model import Cameras, Manifest, PinholeLens, Table
from rille.stages.core.declare import Params
from rille.stages.hazard.vehicle import Vehicle

PAGE = Path(__file__).resolve().parents[2] / "docs/reference/manifest.md"
HEAD = """# Keys of a manifest

A manifest is a TOML file; `rille init FOLDER` writes one ([your own data](../own-data.md)). Only `[images]`, the
cameras and the rig are needed. `[cameras.left]` and `[cameras.right]` have the keys `fx` to `distortion` of
`[cameras]`. Lengths are metres, and camera frames have x to the right, y down and z ahead, unless a key says
otherwise. A key that is unknown is refused, and the error names the nearest one.
"""


def tables() -> dict[str, type[Params]]:
    """The table of each name: that of the bare keys first, then in the order of the manifest."""
    found: dict[str, type[Params]] = {"": Manifest}
    for name, field in Manifest.model_fields.items():
        kinds = (field.annotation, *getattr(field.annotation, "__args__", ()))
        found.update((name, kind) for kind in kinds if isinstance(kind, type) and issubclass(kind, Table | Vehicle))
    return found


def lines(name: str, model: type[Params]) -> Iterator[str]:
    """A section of the page with its table."""
    first = (model.__doc__ or "").partition("\n")[0].partition("``: ")[2]
    yield f"## {f'[{name}]' if name else 'Above all tables'}\n"
    if first:
        yield f"{first[0].upper()}{first[1:]}\n"
    yield "| key | default | meaning |\n|---|---|---|"
    told = model.meanings()
    for key, field in model.model_fields.items():
        if model is Manifest and key not in told:
            continue
        default = "needed" if field.is_required() else ""
        if not field.is_required() and field.default not in (None, "", (), {}):
            default = f"`{' '.join(tomli_w.dumps({key: field.default}, indent=0).partition('=')[2].split())}`"
        cells = (f"`{key}`", default, told[key].replace("|", "\\|"))
        yield f"| {' | '.join(cells)} |"
    yield ""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *(line for name, model in tables().items() for line in lines(name, model))])


def test_the_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "make pages"


def test_every_key_has_a_meaning() -> None:
    untold = [(model, key) for model in tables().values() for key in model.model_fields if key not in model.meanings()]
    assert [key for model, key in untold if model is not Manifest] == []
    assert {key for model, key in untold} == set(tables()) - {""}
    assert set(Cameras.meanings()) > set(PinholeLens.meanings())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
