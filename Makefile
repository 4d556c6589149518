# Everything is set up inside the project (.venv/), from the locked versions in requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test check bench lock clean

install: $(VENV)/.installed

$(VENV)/.installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or later is needed; this is " + sys.version.split()[0] + ". Try: make $(MAKECMDGOALS) PYTHON=python3.11")'
	@echo "Setting up $(VENV) from requirements.lock ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --requirement requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

demo: install
	@$(BIN)/rotaline demo

test: install
	@$(BIN)/python -m pytest -n auto --max-worker-restart 1 tests

check: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# How fast and how exact: tables, JSON and pictures; for example make bench ARGS=--quick
bench: install
	@$(BIN)/python -m benchmarks $(ARGS)

# Resolve the newest versions that pyproject.toml allows and write them down.
lock:
	@rm -rf .venv-lock && $(PYTHON) -m venv .venv-lock
	@.venv-lock/bin/python -m pip install --quiet --disable-pip-version-check '.[dev]'
	@.venv-lock/bin/python -m pip freeze --exclude rotaline --all | grep -Ev '^(pip|rotaline)( |=)' > requirements.lock
	@rm -rf .venv-lock
	@wc -l requirements.lock

clean:
	rm -rf $(VENV) demo-session demo-session-results
