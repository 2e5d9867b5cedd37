"""A changed parameter or source file makes stale exactly the tasks that have it, and all downstream of them.

The expectation follows from declarations and from the graph; the driver must come to the same by its keys.
"""

from __future__ import annotations

import ast
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from dry_chain import Chain, candidates, downstream, group, laid_out, short, stale

from rille.datasets.images.misalign import MisalignParams
from rille.datasets.mockup.params import SHORT, MockupParams
from rille.pipeline.engine import keys, task
from rille.pipeline.engine.graph import Handle
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow import unread
from rille.stages.core.declare import Params
from rille.stages.core.errors import RilleError

ROOT = Path(__file__).resolve().parent.parent
SECTIONS: dict[str, type[Params]] = {name: type(s) for name, s in configuration.build()}
PARAMETERS = [f"{section}.{name}" for section, kind in SECTIONS.items() for name in kind.model_fields]
VEHICLE = {p for p in PARAMETERS if p.startswith("vehicle.")} - {"vehicle.name"}  # a name changes no risk

ARGUMENTS: dict[str, set[str]] = {
    "risk": VEHICLE,
}
"""Stages that get parameters of another section as arguments."""

REWIRING = {"rig.mode", "locus.both", "resect.joint", "crosscheck.enabled", "moving.enabled"}
REWIRING |= {"tiling.tile", "loops.enabled", "loops.apart"}
"""Parameters by which there are other tasks, or the same ones read others."""


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with laid_out(tmp_path_factory.mktemp("store")) as chain:
        yield chain


def values(config: Params) -> dict[str, Any]:
    return {f"{section}.{name}": value for section, params in config for name, value in params}


def changed(chain: Chain, parameter: str) -> tuple[dict[str, Any], set[str]]:
    """Settings with another value of a parameter, and all parameters that are others by them: a preset sets several."""
    section, name = parameter.split(".")
    now = values(chain.config)
    for value in candidates(SECTIONS[section].model_fields[name].annotation, now[parameter]):
        settings = {section: {name: value}}
        with suppress(RilleError):
            after = values(chain.configured(settings))
            if after[parameter] != now[parameter]:
                return settings, {p for p in PARAMETERS if after[p] != now[p]}
    raise AssertionError(f"{parameter}: find another value than {now[parameter]}")


def test_the_chain_has_all_sections_but_those_of_a_drive(chain: Chain) -> None:
    kinds = {h.spec.stage.params for h in chain.base.nodes}
    lost = {section for section, kind in SECTIONS.items() if kind not in kinds}
    assert lost == (unread.foreign(driven=False) & SECTIONS.keys()) | {"terrain", "tiling", "vehicle"}


@pytest.mark.parametrize("parameter", PARAMETERS)
def test_a_parameter_makes_stale_exactly_what_has_it(chain: Chain, parameter: str) -> None:
    settings, others = changed(chain, parameter)
    graph = chain.plan(settings)
    kinds = {SECTIONS[p.partition(".")[0]] for p in others}

    def first(h: Handle) -> bool:
        return h.spec.stage.params in kinds or bool(ARGUMENTS.get(h.stage, set()) & others) or chain.rewired(h)

    assert not stale(graph) ^ downstream(graph, first), settings
    assert others & REWIRING or not any(chain.rewired(h) for h in graph.nodes), "add it to REWIRING"


# -- the sequence: its sources have its parameters ---------------------------------------------------------------------

DATASETS = {"mockup": MockupParams, "misalign": MisalignParams}
SOURCES = [f"{section}.{name}" for section, kind in DATASETS.items() for name in kind.model_fields]
READ_BY = {
    "mockup.inclinometer": {"ground_frame"},
    "mockup.up_noise_deg": {"ground_frame"},
    "mockup.attitude_noise_deg": {"ground_frame"},
    **{parameter: {"image/right"} for parameter in SOURCES if parameter.startswith("misalign.")},
}
"""Parameters of a sequence that few tasks get, directly or as an argument."""
BESIDE = {"misalign.since": {"yaw_deg": 1.0}}
"""Others of the same section without which a parameter changes nothing."""


@pytest.mark.parametrize("parameter", SOURCES)
def test_a_parameter_of_the_sequence_makes_stale_exactly_what_gets_it(chain: Chain, parameter: str) -> None:
    section, name = parameter.split(".")
    field = DATASETS[section].model_fields[name]
    usual = SHORT.get(name, field.default) if section == "mockup" else field.default
    for value in (v for v in candidates(field.annotation, usual) if v != usual):
        with suppress(RilleError):
            sequence = short({section: {name: value} | BESIDE.get(parameter, {})})
            break
    graph = chain.plan({}, sequence)
    before = [described(h) for h in chain.base.nodes]
    others = {h.label for h in graph.nodes if described(h) not in before}
    assert others
    assert not stale(graph) ^ downstream(graph, lambda h: h.label in others)
    if parameter in READ_BY:
        assert {group(label) for label in others} == READ_BY[parameter]


def described(h: Handle) -> tuple[Any, ...]:
    return h.spec.module, [up.label for up in h.upstream()], h.spec.args, h.spec.params


# -- edits of the sources: a stage is the modules that it reaches by imports -------------------------------------------

MODULES = {
    ".".join(("rille", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for package in ("stages", "datasets", "pipeline")
    for path in sorted((ROOT / package).rglob("*.py"))
}


@cache
def imports(module: str) -> list[str]:
    """Names that a module imports when it runs, with the package that it is in."""
    tree = ast.parse(MODULES[module].read_text())
    unseen = [n for n in ast.walk(tree) if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]
    never = {id(inner) for n in unseen for inner in ast.walk(n)}
    lines = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and id(n) not in never]
    names = [f"{line.module}{end}" for line in lines for end in ("", *(f".{alias.name}" for alias in line.names))]
    return [module.rpartition(".")[0], *names]


@cache
def reached(module: str) -> set[str]:
    """Own modules that a module reaches by imports, itself among them."""
    ahead, names = [module], set[str]()
    while ahead:
        name = ahead.pop()
        if name in MODULES and name not in names:
            names.add(name)
            ahead += imports(name)
    return names


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """``edited(module, change)``: the sources as a new process would find them with that module changed."""
    folder = tmp_path_factory.mktemp("sources")
    for package in ("stages", "datasets", "pipeline"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    caches = (keys._read, keys._file, keys.module_digests, task._shared, task._shared_digest)

    @contextmanager
    def edit(module: str, change: Callable[[str], str]) -> Iterator[None]:
        path = folder / MODULES[module].relative_to(ROOT)
        text = path.read_text()
        path.write_text(change(text))
        for cached in caches:
            cached.cache_clear()
        yield
        path.write_text(text)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keys, "_roots", lambda package: (folder / package.removeprefix("rille."),))
        yield edit
    for cached in caches:
        cached.cache_clear()


EDITED = sorted(
    set().union(*(reached(stage.module) for stage in configuration.stages(*configuration.RECONSTRUCTION).values()))
)


@pytest.mark.parametrize("module", EDITED[::16])
def test_an_edit_makes_stale_exactly_the_stages_that_reach_the_module(chain: Chain, edited: Any, module: str) -> None:
    with edited(module, lambda text: f"{text}\nMORE = 1\n"):
        graph = chain.plan({})
    assert not stale(graph) ^ downstream(graph, lambda h: module in reached(h.spec.module))


EDITS_THAT_CHANGE_NOTHING: dict[str, tuple[str, Callable[[str], str]]] = {
    "a comment": ("rille.stages.geometry.geometry", lambda text: f"{text}\n# only words\n"),
    "a docstring": ("rille.stages.hfvm.level", lambda text: text.replace('"""', '"""Said otherwise. ', 1)),
    "the engine": ("rille.pipeline.engine.run", lambda text: f"{text}\nMORE = 1\n"),
}


@pytest.mark.parametrize("edit", EDITS_THAT_CHANGE_NOTHING.values(), ids=EDITS_THAT_CHANGE_NOTHING)
def test_an_edit_of_words_or_of_the_engine_makes_nothing_stale(chain: Chain, edited: Any, edit: Any) -> None:
    with edited(*edit):
        assert stale(chain.plan({})) == set()
