# Set-up and the four things one does here. `make demo` and `make test` work on a fresh machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PEER := tests/peers/async_labjack_peer
PEER_CACHE := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/huddle-tests/async_labjack
SOURCES := huddle.py daq estimator sim_devices tui tests benchmarks docs examples

.PHONY: demo test test-long peers check check-all bench studies docs session torture mutants clean

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	touch $@

demo: $(VENV)/.installed  ## the whole huddle test on a simulated bench, over its real protocols
	$(BIN)/huddle demo

# The workers share the cores: threads of linear algebra would wait for each other in loops.
test test-long: export OPENBLAS_NUM_THREADS := 1

# Three at a time on two cores: many tests wait for their devices; of the long ones, more do.
# With AGAIN=yes, what failed runs once more, alone: a busy computer makes devices late.
test: $(VENV)/.installed-dev  ## the tests but the long ones; with ALL=yes, these too, collected once
	$(BIN)/pytest -n $(if $(ALL),4 -m "not study",3)$(if $(AGAIN), || { [ $$? = 1 ] && $(BIN)/pytest --last-failed -m ""; })

test-long: $(VENV)/.installed-dev  ## the tests that are studies, endurance or whole sessions
	$(BIN)/pytest -n 3 -m "long and not study"

peers:  ## compile the program in Rust that the tests talk to; kept in the user's cache
	cargo build --quiet --manifest-path $(PEER)/Cargo.toml --target-dir $(PEER_CACHE)
	touch $(PEER_CACHE)/debug/async_labjack_peer

check: $(VENV)/.installed-dev  ## formatting, rules, types, who may import whom; lines by room
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.lines

check-all:  ## the same with every Python that is supported and present, in .venv-3.11, .venv-3.12, ...
	set -e; for version in 3.11 3.12 3.13; do if python$$version -c "" 2>/dev/null; then \
	    $(MAKE) check PYTHON=python$$version VENV=.venv-$$version; fi; done

bench: $(VENV)/.installed-dev  ## speed and memory, as ratios within one run
	$(BIN)/python -m benchmarks

studies: $(VENV)/.installed-dev  ## coverage of intervals and verdicts; hours
	$(BIN)/pytest -m study
	$(BIN)/python -m benchmarks.studies
	$(BIN)/python -m benchmarks.studies.levels
	$(BIN)/python -m benchmarks.studies.leaning

docs: $(VENV)/.installed-docs  ## the documentation as a site in build/site; its examples run
	$(BIN)/python -m sphinx -q -W --keep-going -b html -d build/doctrees docs build/site

session: $(VENV)/.installed-dev  ## drive a whole test on simulated devices; writes docs/session.md
	$(BIN)/python -m docs.images.session

torture: $(VENV)/.installed-dev  ## kills, power cuts, disk errors, flipped bits; writes docs/validation/torture.md
	$(BIN)/python -m tests.torture

mutants: $(VENV)/.installed-dev  ## change 200 lines one at a time, and run the tests of each; hours
	$(BIN)/python -m tests.mutants

clean:
	rm -rf $(VENV) build docs/_figures .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
