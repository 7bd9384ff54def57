# make demo       install into .venv, run the quickstart, print its table
# make test       what everybody runs before a commit: lint, types, layers, tests without those marked slow
# make test-slow  the tests marked slow: long runs, choices of a structure on many records, everything in documentation
# make reproduce  all studies from their specifications, published with their claims; stop it and run it again at will, it
#                 goes on where it was; with RUNS=20 fewer data sets, which are checked and not published
# make reproduce-small
#                 the first data sets of every study, compared with the committed estimates: what CI does after make test
# make docs       the documentation site in build/docs; warnings are errors
# make scoreboard ctid beside numbers that others printed and exact bounds: docs/scoreboard.md
# make release-check
#                 wheel and sdist, built, installed in new environments and run without a clone; VERSIONS=newest or
#                 oldest: of the dependencies
# make bench      speed, measured against other tools
# make clean      remove what the other targets built (never results)

PYTHON ?= python3
RUNS ?=
JOBS ?= 2
OUT ?= results
VERSIONS ?= pinned

VENV := .venv
BIN := $(VENV)/bin
# Bytecode is compiled by both processors after the installation, instead of by pip with one. Where
# PYTHONDONTWRITEBYTECODE is set, as in many containers, every process would compile all that it imports again: a command
# takes half of its time for that.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
COMPILE := $(BIN)/python -m compileall -q -j 0
BYTECODE := $(COMPILE) -x '/tests?/' $(VENV)/lib ctid_cli
# One thread each: the threads of two workers wait for each other.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n logical --dist loadfile --no-loadscope-reorder --durations 5

.PHONY: demo test test-slow types kernels pytest reproduce reproduce-small docs scoreboard release-check bench clean
.DELETE_ON_ERROR:

demo: $(VENV)/.installed
	$(BIN)/ctid run configs/quickstart.yaml
	$(BIN)/ctid table quickstart

# mypy uses one processor, and so does the compilation of kernels: together they take less time.
test: $(VENV)/.test-installed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	@$(MAKE) --no-print-directory --jobs=2 types kernels
	@$(MAKE) --no-print-directory pytest

types: $(VENV)/.test-installed
	$(BIN)/mypy

# Otherwise every worker of the tests would compile most of them.
kernels: $(VENV)/.test-installed
	$(COMPILE) ctid_cli experiments tests
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.compile_kernels

pytest: $(VENV)/.test-installed
	$(PYTEST)

test-slow: kernels
	$(PYTEST) -m slow

reproduce: $(VENV)/.installed
	$(BIN)/ctid reproduce $(if $(RUNS),--runs $(RUNS)) --jobs $(JOBS) --out "$(OUT)"
	@if [ -n "$(RUNS)" ]; then $(BIN)/ctid reproduce --check --out "$(OUT)" || true; \
	else $(BIN)/ctid reproduce --check --out "$(OUT)" && $(BIN)/ctid reproduce --publish --out "$(OUT)"; fi

reproduce-small: $(VENV)/.installed
	$(BIN)/ctid reproduce --first --jobs $(JOBS)

docs: $(VENV)/.docs-installed
	$(BIN)/python -m sphinx -E -W --keep-going -q -b html docs build/docs

scoreboard: $(VENV)/.installed
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.scoreboard --write docs/scoreboard.md

release-check:
	PYTHON="$(PYTHON)" .ci/release-check $(VERSIONS)

bench: $(VENV)/.test-installed
	set -e; for file in benchmarks/bench_*.py; do echo "== $$file"; PYTHONPATH=. $(BIN)/python "$$file"; done

clean:
	rm -rf $(VENV) build dist docs/reference .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find benchmarks ctid_cli experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +

# The installation is editable: sources may change without a new one.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	-$(BYTECODE)
	@touch $@

$(VENV)/.test-installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[test]'
	-$(BYTECODE)
	@touch $@ $(VENV)/.installed

$(VENV)/.docs-installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[docs]'
	-$(BYTECODE)
	@touch $@ $(VENV)/.installed
