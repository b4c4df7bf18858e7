# Set-up and the four things one does here. `make demo` and `make test` work on a fresh machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := daq estimator sim_devices tui tests benchmarks docs

.PHONY: demo test check bench clean

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: $(VENV)/.installed  ## the whole huddle test on a simulated bench, over its real protocols
	$(BIN)/huddle demo

test: $(VENV)/.installed-dev  ## the tests; three at a time on two cores, for many wait for their devices
	$(BIN)/pytest -n 3

check: $(VENV)/.installed-dev  ## formatting, rules, types, who may import whom
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/mypy
	$(BIN)/mypy docs/images/make.py
	$(BIN)/lint-imports

bench: $(VENV)/.installed-dev  ## speed and memory, as ratios within one run
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
