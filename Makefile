# Every target sets itself up: a machine with Python 3.11 or newer and make needs nothing else.
VENV ?= .venv
BIN := $(VENV)/bin
# Sought when it is first needed, and only once.
PYTHON ?= $(eval PYTHON := $(shell for python in python3.11 python3; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$python && break; done))$(PYTHON)

# Idle torch threads otherwise spin and take the cores from each other.
export OMP_WAIT_POLICY := passive

CORE := $(VENV)/.core
DEV := $(VENV)/.dev
CONSTRAINTS ?= constraints.txt
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS)
# All of them, so that no test is skipped for lack of one.
EXTRAS := dev,docs,argoverse2,ray,sumo,gym,video
SPELLED := src tests recipes examples benchmarks docs README.md CONTRIBUTING.md CHANGELOG.md SECURITY.md

.DEFAULT_GOAL := help
.PHONY: help setup demo picture table test test-lowest fuzz kills coverage audit bench lint format docs clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-12s %s\n", $$1, $$2}'

setup: $(DEV)  ## create .venv with everything for development

demo: $(CORE)  ## an included agent, then one trained on the built-in data: pictures and numbers in out/demo
	$(BIN)/symphony demo --out out/demo

PICTURE := sumo-town-001000-f0-w11-v5 sumo-town-001000-f2-w03-v10 sumo-town-001005-f0-w05-v13

picture: $(CORE)  ## the picture of the README: a planner among seven learned agents each, in docs/rollouts.gif
	$(BIN)/symphony simulate pretrained:bc_ts_h --planner examples/planner.py:Careful --interactive 8 --rollouts 1 \
		--data src/symphony/data/builtin/test --segments $(PICTURE) --out out/picture
	$(BIN)/symphony view out/picture --out docs/rollouts.gif

table: $(CORE)  ## train, evaluate and compare all eight methods, tiny, in out/table
	$(BIN)/python benchmarks/make_table.py --out out/table

PYTEST_ARGS ?= -n auto --maxprocesses 4 --dist loadfile

test: $(DEV)  ## run the tests, in a process per core
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest $(PYTEST_ARGS)

FUZZ_ARGS ?= --inputs 2000

fuzz: $(DEV)  ## feed damaged files to everything that reads files; continue where it stopped
	OMP_NUM_THREADS=1 nice $(BIN)/python tests/tools/fuzz.py $(FUZZ_ARGS)

KILLS_ARGS ?= --kills 30

kills: $(DEV)  ## kill everything that writes at random moments, resume, and compare with undisturbed work
	OMP_NUM_THREADS=1 nice $(BIN)/python tests/tools/kills.py $(KILLS_ARGS)

# Not among the development packages, as nothing else needs it; processes of their own are not counted.
coverage: $(DEV)  ## run the tests in one process and report which branches of src they take; slow
	$(INSTALL) 'coverage>=7.6'
	OMP_NUM_THREADS=1 $(BIN)/python -m coverage run --branch --source=src/symphony -m pytest -q
	$(BIN)/python -m coverage report --skip-covered --sort=cover

audit: $(DEV)  ## ask a public database for known vulnerabilities of the pinned packages
	$(INSTALL) 'pip-audit>=2.7'
	$(BIN)/python -m pip_audit --strict --no-deps --disable-pip -r $(CONSTRAINTS)

# Python itself is tested in one version, and torch too: any other build of it is gigabytes.
test-lowest:  ## run the tests with the lowest versions that pyproject.toml promises, in a .venv of their own
	$(MAKE) test VENV=$(VENV)-lowest CONSTRAINTS=constraints-lowest.txt

lint: $(DEV)  ## style, docstrings, spelling, types, imports between packages, lengths of files and rooms
	$(BIN)/ruff check
	$(BIN)/ruff check --preview --select DOC102 src  # arguments that are described but not there
	$(BIN)/ruff format --check
	$(BIN)/codespell $(SPELLED)
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/tools/lint_length.py

BENCH_ARGS ?=

bench: $(DEV)  ## speed of everything, by part and as it grows, in CPU time of one thread; a few minutes
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/measure.py --out out/bench.json $(BENCH_ARGS)
	$(BIN)/python benchmarks/tables.py out/bench.json

docs: $(DEV)  ## build the pages of docs/ into out/site; broken links are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

format: $(DEV)  ## rewrite the files in the style that lint asks for
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

clean:  ## remove .venv, caches and everything written by the targets above
	rm -rf $(VENV) $(VENV)-lowest out build dist src/*.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find src tests recipes benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

$(CORE): pyproject.toml $(CONSTRAINTS)
	@test -n "$(PYTHON)" || { echo "error: needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: $(PYTHON) is missing or older than Python 3.11; choose another with: make PYTHON=/path/to/python" >&2; exit 1; }
	@test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV) || \
		{ echo "error: $(PYTHON) cannot create $(VENV) (on Debian: apt install python3-venv)" >&2; rm -rf $(VENV); exit 1; }
	@echo "installing into $(VENV) (some minutes, once)"
	$(INSTALL) -e .
	@touch $@

$(DEV): $(CORE)
	$(INSTALL) -e '.[$(EXTRAS)]'
	@touch $@
