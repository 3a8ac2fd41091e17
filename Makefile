# Everything runs in an environment of its own, .venv; python3 is all that must be there.
PYTHON ?= python3
BIN := .venv/bin
LOCK := constraints.txt pyproject.toml

.PHONY: run test lint test-long clean

run: .venv/.core
	$(BIN)/utn run --controller recommended

test: lint
	$(BIN)/python -m pytest -n logical --dist worksteal

# The tests that take minutes each: 4 h runs, 2 h comparisons, the wheel.
test-long: .venv/.dev
	$(BIN)/python -m pytest -m long -n logical --dist worksteal

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

.venv/.core: $(LOCK)
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	touch $@

.venv/.dev: .venv/.core
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv results
