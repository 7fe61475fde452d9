# Each target does its own set-up on a fresh machine: Python 3.11 with its venv module is all that is asked for.
PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: live test check docs

live: .venv/.live
	$(BIN)/nlos-cam live --camera sim

# Laws and unit tests in two processes; what measures time, has processes of its own or draws in a browser, alone.
test: .venv/.test
	$(BIN)/python -m pytest tests/bench tests/browser tests/contract tests/hardware
	$(BIN)/python -m pytest -n 2 --dist loadfile tests/laws tests/unit

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
