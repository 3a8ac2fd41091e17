# Everything runs in an environment of its own, .venv; python3 is all that must be there.
PYTHON ?= python3
BIN := .venv/bin
LOCK := constraints.txt pyproject.toml
# What is imported is compiled then: all of it would take as long again as the rest.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt

.PHONY: run test lint test-long clean

run: .venv/.core
	$(BIN)/utn run --controller recommended

test: lint
	$(BIN)/python -m pytest -n logical --dist worksteal

# The tests that take ten seconds to minutes each: long runs, comparisons, the wheel.
test-long: .venv/.dev
	$(BIN)/python -m pytest -m long -n logical --dist worksteal

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

.venv/.core: $(LOCK)
	$(PYTHON) -m venv .venv
	$(INSTALL) --editable .
	touch $@

.venv/.dev: .venv/.core
	$(INSTALL) --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv results
