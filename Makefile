# make demo       bakes a small data set on the processor and draws a contact sheet of it
# make test       checks, and all tests but the slow ones
# make test-slow  the slow tests: killed and resumed bakes, soak, several devices, the lines of the README
# make clean      removes what these made
#
# All that is needed is Python 3.11 or 3.12. PYTHON=... chooses the interpreter.

SHELL := /bin/bash

FITS := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 13))
PYTHON ?= $(shell for python in python3 python3.12 python3.11; do \
	$$python -c '$(FITS)' 2>/dev/null && echo $$python && break; done)

VENV := .venv
BIN := $(VENV)/bin
DEMO := demo
# One more than the cores: tests also wait, for processes that they start.
WORKERS := 3
# Slow tests wait more than others.
SLOW_WORKERS := 4
# Neighbours in one process, which makes what they share once.
PYTEST = $(BIN)/python -m pytest --dist worksteal

.PHONY: demo test test-slow checks pytest clean
.DELETE_ON_ERROR:

demo: $(VENV)/installed
	rm -rf $(DEMO)
	$(BIN)/synpick-warp bake --config smoke --episodes 1 --device cpu --out $(DEMO)
	$(BIN)/synpick-warp preview $(DEMO) --out $(DEMO)/contact-sheet.png

# Checks take one core for half a minute, in which tests can have the other.
test: $(VENV)/installed-dev
	$(MAKE) --no-print-directory -j2 checks pytest

pytest: $(VENV)/installed-dev
	$(PYTEST) -n $(WORKERS) -m 'not slow'

test-slow: $(VENV)/installed-dev
	$(PYTEST) -n $(SLOW_WORKERS) -m slow

checks: $(VENV)/installed-dev
	$(BIN)/ruff check --quiet --output-format concise .
	$(BIN)/ruff format --quiet --check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/basedpyright & types=$$!; \
	$(BIN)/python -m tools.checks.kernels; others=$$?; wait $$types && exit $$others

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info .pytest_cache .hypothesis .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@'$(PYTHON)' -c '$(FITS)' 2>/dev/null || { echo 'make: this needs Python 3.11 or 3.12 with its venv module' \
		'(Debian and Ubuntu: the package python3-venv); name one with PYTHON=/path/to/python3.12' >&2; exit 2; }
	'$(PYTHON)' -m venv $(VENV)

$(VENV)/installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $(VENV)/installed $@
