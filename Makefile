# Each target does its own set-up on a fresh machine: Python 3.11 with its venv module is all that is asked for.
PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: live test check

live: .venv/.live
	$(BIN)/nlos-cam live --camera sim

test: .venv/.test
	$(BIN)/python -m pytest

check: .venv/.test
	$(BIN)/python tools/check.py

$(BIN)/python:
	$(PYTHON) -m venv .venv

.venv/.live: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

.venv/.test: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@
