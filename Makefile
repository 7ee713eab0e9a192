# Everything from nothing: each target makes its own environment in .venv first.
# Needs Python 3.10 to 3.13, make and a package registry; no GPU, no compiler, no model hub.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUTPUT ?= output/demo
# Two workers: more only fight over the cores that the kernels already use.
PYTEST_WORKERS ?= 2

.PHONY: demo test lint install clean help

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

demo: $(VENV)/.runtime  ## reconstruct, embed, query and evaluate the scene that ships with the package
	$(BIN)/lexsplat demo --output $(OUTPUT)

test: $(VENV)/.dev  ## run the tests
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) --dist loadgroup

lint: $(VENV)/.dev  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

install: $(VENV)/.runtime  ## only set up the environment

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || \
		{ echo "lexsplat needs Python 3.10 to 3.13, found $$($(PYTHON) --version 2>&1); run: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.runtime: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@ $(VENV)/.runtime

clean:  ## remove the environment and everything written
	rm -rf $(VENV) output build dist .pytest_cache .mypy_cache .ruff_cache
