# make demo       install into .venv, run the quickstart, print its table
# make test       everything that CI runs
# make reproduce  the whole study, its tables and figures, compared with the committed ones; stop it and run it again at
#                 will, it goes on where it was
# make reproduce-additive
#                 the study of additive models in open and closed loop, with as many data sets as its specifications say;
#                 with RUNS=20 fewer, which publishes nothing
# make reproduce-frequency
#                 the same for the study of frequency estimation in finite time
# make bench      speed, measured against other tools
# make clean      remove what the other targets built (never results)

PYTHON ?= python3
RUNS ?= 100
JOBS ?= 2
OUT ?= results

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
STUDY := $(sort $(wildcard configs/useful_redundancy/*.yaml))
ADDITIVE := open_loop closed_loop closed_loop_coloured coverage_open_loop coverage_closed_loop flexible_beam
FREQUENCY := two_tones harmonic random step recovery recovery_in_noise efficiency
# The number of data sets, where it was asked for: not the default of above.
FEWER := $(if $(filter file,$(origin RUNS)),,--runs $(RUNS))

.PHONY: demo test reproduce reproduce-additive reproduce-frequency bench clean
.DELETE_ON_ERROR:

demo: $(VENV)/.installed
	$(BIN)/ctid run configs/quickstart.yaml
	$(BIN)/ctid table quickstart

test: $(VENV)/.test-installed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -q

reproduce: $(VENV)/.installed
	@test -n "$(STUDY)" || { echo "no configs in configs/useful_redundancy"; exit 1; }
	set -e; for config in $(STUDY); do $(BIN)/ctid run "$$config" --runs $(RUNS) --jobs $(JOBS) --out "$(OUT)"; done
	$(BIN)/ctid table --format md --out "$(OUT)" > "$(OUT)/useful_redundancy.md"
	$(BIN)/ctid table --format csv --out "$(OUT)" > "$(OUT)/useful_redundancy.csv"
	$(BIN)/ctid figure useful-redundancy --out "$(OUT)"
	$(BIN)/ctid table --out "$(OUT)"
	$(BIN)/ctid table --check --out "$(OUT)"
	@if [ "$(RUNS)" -ge 100 ]; then $(BIN)/python experiments/useful_redundancy/publish.py --results "$(OUT)"; fi

reproduce-additive: $(VENV)/.installed
	set -e; for name in $(ADDITIVE); do \
	  $(BIN)/ctid run configs/additive/$$name.yaml $(FEWER) --jobs $(JOBS) --out "$(OUT)"; done
	$(BIN)/ctid figure additive --out "$(OUT)"
	@if [ -z "$(FEWER)" ]; then set -e; $(BIN)/python -m experiments.additive.publish --results "$(OUT)"; \
	  $(BIN)/python -m experiments.additive.acceptance --results "$(OUT)"; fi

reproduce-frequency: $(VENV)/.installed
	set -e; for name in $(FREQUENCY); do \
	  $(BIN)/ctid run configs/finite_time_frequency/$$name.yaml $(FEWER) --jobs $(JOBS) --out "$(OUT)"; done
	$(BIN)/ctid figure finite-time-frequency --out "$(OUT)"
	@if [ -z "$(FEWER)" ]; then $(BIN)/python -m experiments.finite_time_frequency.publish --results "$(OUT)"; fi

bench: $(VENV)/.test-installed
	set -e; for benchmark in benchmarks/bench_*.py; do $(BIN)/python "$$benchmark"; done

clean:
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find benchmarks ctid_cli experiments tests -name __pycache__ -type d -prune -exec rm -rf {} +

# The installation is editable: sources may change without a new one.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	@touch $@

$(VENV)/.test-installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[test]'
	@touch $@ $(VENV)/.installed
