# Everything from nothing: each target makes its own environment in .venv first.
# Needs Python 3.10 to 3.13, make and a package registry; no GPU, no compiler, no model hub.

# The first of these that is new enough makes the environment; `make PYTHON=...` names another.
PYTHON ?= python3 python3.13 python3.12 python3.11 python3.10 python
VENV := .venv
BIN := $(VENV)/bin
OUTPUT ?= output/demo
# Two workers: more only fight over the cores that the kernels already use.
PYTEST_WORKERS ?= 2
# What installs packages into the environment.
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: demo test test-fast lint site install clean help

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

demo: $(VENV)/.runtime  ## build, query and evaluate the scene that ships with the package
	$(BIN)/lexsplat demo --output "$(OUTPUT)"

test: $(VENV)/.dev  ## run all tests
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) --dist loadfile --no-loadscope-reorder

test-fast: $(VENV)/.dev  ## run the tests that are not marked slow, in a minute
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) --dist loadfile --no-loadscope-reorder -m "not slow"

lint: $(VENV)/.dev  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

site: $(VENV)/.runtime  ## write the documentation and the published demo as a static site to output/site
	$(BIN)/python tools/write_site.py output/site

install: $(VENV)/.runtime  ## only set up the environment

# An environment that was cut off before it had pip, or whose Python is gone, is mended first.
ifneq ($(shell test -x $(BIN)/python && test -x $(BIN)/pip && echo whole),whole)
.PHONY: $(BIN)/pip
endif

$(BIN)/pip:
	@if test -x $(BIN)/python; then exec $(BIN)/python -m ensurepip --default-pip; fi; \
	for python in $(PYTHON); do \
		version=$$("$$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null); \
		case "$$version" in \
			3.10|3.11|3.12|3.13) \
				echo "$$python -m venv --clear $(VENV)"; exec "$$python" -m venv --clear $(VENV) ;; \
			?*) found="$$found $$python is $$version;" ;; \
		esac; \
	done; \
	echo "lexsplat needs Python 3.10 to 3.13, found:$${found:- none;} run: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; exit 1

$(VENV)/.runtime: pyproject.toml constraints.txt $(BIN)/pip
	$(INSTALL) -c constraints.txt -e .
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt $(BIN)/pip
	$(INSTALL) -c constraints.txt -e '.[dev]'
	@touch $@ $(VENV)/.runtime

clean:  ## remove the environment and everything written
	rm -rf $(VENV) output build dist .pytest_cache .mypy_cache .ruff_cache
