"""``rille params``: the reference of all parameters, from the models that validate them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal, get_args, get_origin

import tomli_w
from pydantic.fields import FieldInfo

from rille.datasets.images.misalign import MisalignParams
from rille.datasets.mockup.params import MockupParams
from rille.datasets.mockup.rover import RoverParams
from rille.pipeline.flow import config
from rille.pipeline.runs.lookup import refuse_unknown
from rille.pipeline.runs.options import FLAG
from rille.stages.core.declare import Params

SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def params(section: str = "", *, markdown: Annotated[bool, FLAG] = False) -> None:
    """Print all parameters, or those of one section: default, what is permitted, and meaning.

    Parameters
    ----------
    section
        Such as locus; all by default.
    markdown
        As tables of Markdown.
    """
    known = sections()
    if section:
        refuse_unknown("params", [section], known, "section")
    chosen = {section: known[section]} if section else known
    print("\n".join(page(chosen) if markdown else plain(chosen)))


def sections() -> dict[str, Params]:
    """Every section of the configuration with its defaults: stages in the order of the flow, then sequences."""
    known = config.build()
    of_sequences: dict[str, type[Params]] = {"mockup": MockupParams, "rover": RoverParams, "misalign": MisalignParams}
    of_stages = {name: getattr(known, name) for name in type(known).model_fields}
    return of_stages | {name: kind.model_validate({}) for name, kind in of_sequences.items()}


def plain(chosen: Mapping[str, Params]) -> Iterator[str]:
    """Lines for a terminal."""
    for name, values in chosen.items():
        for key, default, permitted, words in rows(values):
            yield f"{name}.{key} = {default}" + (f"    [{permitted}]" if permitted else "")
            yield from textwrap.wrap(words, 100, initial_indent="    ", subsequent_indent="    ")
        yield ""


def page(chosen: Mapping[str, Params]) -> Iterator[str]:
    """Lines of Markdown: one table for each section."""
    yield "# Parameters\n\nSet one by `--set section.key=value`, or in a TOML file given by `--config`.\n"
    for name, values in chosen.items():
        yield f"## {name}\n\n| key | default | permitted | meaning |\n|---|---|---|---|"
        for row in rows(values):
            key, default, permitted, words = (cell.replace("|", "\\|") for cell in row)
            yield f"| `{key}` | `{default}` | {permitted} | {words} |"
        yield ""


def rows(values: Params) -> Iterator[tuple[str, str, str, str]]:
    """Key, default as TOML, permitted values, and meaning of each parameter of a section."""
    meanings = values.meanings()
    for key, value in values.model_dump(mode="json").items():
        default = "not set" if value is None else tomli_w.dumps({key: value}, indent=0).partition("=")[2].strip()
        yield key, " ".join(default.split()), _permitted(type(values).model_fields[key]), meanings.get(key, "")


def _permitted(field: FieldInfo) -> str:
    """Choices or bounds in words."""
    # In the union of a choice with None the Literal is one level down.
    kinds = (field.annotation, *get_args(field.annotation))
    choices = [repr(c) for kind in kinds for c in get_args(kind) if get_origin(kind) is Literal]
    signs = [(sign, getattr(limit, name, None)) for limit in field.metadata for name, sign in SIGNS.items()]
    return ", ".join([*choices, *(f"{sign} {bound:g}" for sign, bound in signs if bound is not None)])
