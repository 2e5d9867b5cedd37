# Rille's commands. `make help` lists them.
SHELL  := /bin/bash
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
TOOLS  := $(VENV)/.tools
# Python compiles what is imported, when it is first imported, also where the variable forbids it: compiling all takes
# longer than the rest of the installation.
unexport PYTHONDONTWRITEBYTECODE
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
# Requirements of a dependency group, one a line: `pip install --group` needs a newer pip than venv brings.
GROUP  := $(BIN)/python -c 'import sys, tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["dependency-groups"][sys.argv[1]], sep="\n")'

SEQ    ?= mockup
FRAMES ?=
JOBS   ?=
SET    ?=
ONLY   ?=
ARGS   ?=

BENCHMARKS := $(filter-out record,$(sort $(basename $(notdir $(wildcard benchmarks/*.py)))))

.DEFAULT_GOAL := help
.PHONY: help install reconstruct test check torture bench lint pages docs docs-fast clean

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

install: $(VENV)/.compiled ## make .venv with rille and what a run needs, pinned, and compile the kernels

$(STAMP): pyproject.toml constraints.txt
	@# Of newer ones the pinned packages have no wheels.
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' \
	  || { echo "rille needs Python 3.11 to 3.14; say which with PYTHON=..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	@touch $@

$(TOOLS): $(STAMP)
	$(PIP) -e '.[robots]' -r <($(GROUP) dev)
	@touch $@

# Without it, the first run compiles them.
$(VENV)/.compiled: $(STAMP)
	@$(BIN)/rille compile && touch $@ || echo "the first run will compile the kernels" >&2

reconstruct: $(STAMP) ## a sequence to terrain, trajectory, risk map, path and report: SEQ= FRAMES= JOBS= SET="key=value ..."
	@$(BIN)/rille reconstruct "$(SEQ)" $(if $(FRAMES),--frames $(FRAMES)) $(if $(JOBS),--jobs $(JOBS)) \
	  $(foreach s,$(SET),--set '$(s)') $(ARGS)

test: $(TOOLS) ## add all extras and the tools of the tests to .venv; lint, types and the test suite (a few minutes on two cores)
	@# Kernels are compiled on one core while lint and types take the other.
	@$(BIN)/rille compile >/dev/null & $(MAKE) --no-print-directory lint && wait
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow" $(ARGS)

check: test torture ## everything, the slow checks too
	$(BIN)/python -m pytest -m slow --ignore=tests/torture $(ARGS)

torture: $(TOOLS) ## kills, damage, full disks, races: what the engine endures, as a table (also part of check)
	$(BIN)/python -m pytest tests/torture $(ARGS)

bench: $(TOOLS) ## side-by-side measurements: every figure of the README; ONLY=matching: one of them, ARGS=--help: its options
	@$(if $(filter-out $(BENCHMARKS),$(ONLY)),echo "no such benchmark: $(filter-out $(BENCHMARKS),$(ONLY)); ONLY= any of: $(BENCHMARKS)" >&2; exit 2)
	@for b in $(or $(ONLY),$(BENCHMARKS)); do echo "== $$b"; $(BIN)/python benchmarks/record.py $$b $(ARGS) || exit 1; done

lint: $(TOOLS) ## ruff and mypy, of the benchmarks too
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

pages: $(TOOLS) ## pages of docs/ that follow from the code: messages, parameters, keys of a manifest, outputs, blocks that are not run
	$(BIN)/rille params --markdown > docs/parameters.md
	cd tests && for page in test_messages.py test_docs.py datasets/test_manifest_page.py pipeline/export/test_output.py; do \
	  PYTHONPATH=.:stages:pipeline ../$(BIN)/python $$page || exit 1; done

docs: $(VENV)/.docs ## the site in docs/_build, offline; the gallery and the tour are executed (minutes)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

docs-fast: ## the same without executing anything
	@RILLE_DOCS_FAST=1 $(MAKE) --no-print-directory docs

$(VENV)/.docs: $(TOOLS)
	$(PIP) -r <($(GROUP) docs)
	@touch $@

clean: ## remove caches of tools and build leftovers; keeps .venv, runs and artifacts
	rm -rf build dist docs/_build docs/examples docs/gallery/runs .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
