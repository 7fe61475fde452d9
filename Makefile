# Each target does its own set-up on a fresh machine: Python 3.11 with its venv module is all that is asked for.
PYTHON ?= python3.11
BIN := .venv/bin

# Byte code is kept, also that of pytest's asserts: collecting is 10 s shorter in each process, each command in a test
# starts sooner. NumPy and torch use one thread in each of the two processes, else their threads wait for each other.
unexport PYTHONDONTWRITEBYTECODE
test test-all: export OMP_NUM_THREADS = 1
test test-all: export OPENBLAS_NUM_THREADS = 1

.PHONY: live test test-all format check wheel docs

# The base installation alone, without torch.
live: .venv/.live
	$(BIN)/nlos-cam demo

# The quick tests, in two processes: to be run before every commit.
test: .venv/.test
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not bench and not slow' tests/laws tests/unit tests/contract tests/field tests/hardware

# All tests: the quick ones first, then the slow ones, and alone those that draw in a browser.
test-all: test
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'slow and not bench' tests/laws tests/unit tests/contract tests/field
	$(BIN)/python -m pytest tests/browser

# Lay out the code as `make check` asks, and mend what the linter can mend.
format: .venv/.test
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

check: .venv/.test
	$(BIN)/python tools/checks/check.py

# The wheel and the sdist, installed and used from an empty folder without the extra "train".
wheel: .venv/.test
	$(BIN)/python tools/checks/wheel.py

# The docs as a site, in site/; a link that leads nowhere ends it.
docs: .venv/.docs
	$(BIN)/python tools/docs/build_site.py

$(BIN)/python:
	$(PYTHON) -m venv .venv

.venv/.live: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

.venv/.test: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

.venv/.docs: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@
