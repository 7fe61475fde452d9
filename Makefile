# Each target does its own set-up on a fresh machine: Python 3.11 with its venv module is all that is asked for.
PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: live test test-all check docs

live: .venv/.live
	$(BIN)/nlos-cam live --camera sim

# The quick tests, in two processes: to be run before every commit.
test: .venv/.test
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not bench and not slow' tests/laws tests/unit tests/contract tests/hardware

# All tests: the quick ones first, then the slow ones, and alone those that draw in a browser.
test-all: test
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'slow and not bench' tests/laws tests/unit tests/contract
	$(BIN)/python -m pytest tests/browser

check: .venv/.test
	$(BIN)/python tools/checks/check.py

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
