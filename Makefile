PYTHON ?= python3
EXPERIMENT ?= drift
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.setup

.DEFAULT_GOAL := help
.PHONY: help setup train test lint docs bench figures clean

help: ## Print this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))

setup: $(READY) ## Create .venv with the pinned dependencies (PYTHON=python3.12 picks the interpreter)

train: $(READY) ## Train EXPERIMENT=drift; ARGS="seed=3 device=cpu" overrides its settings
	$(BIN)/python -m pirl_rl.train +experiment=$(EXPERIMENT) $(ARGS)

test: $(READY) ## Run the tests that are neither slow nor gpu; ARGS go to pytest
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

lint: $(READY) ## Check style, format, types and the floors of the package
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/lint-imports --no-logo

docs: $(READY) ## Build the documentation site from nothing; open docs/_build/html/index.html
	rm -rf docs/_build docs/_generated
	$(BIN)/sphinx-build -W --keep-going docs docs/_build/html

bench: $(READY) ## Run all benchmarks of speed; ARGS=--short takes a minute and a half
	$(BIN)/python -m benchmarks $(ARGS)

figures: $(READY) ## Compare all runs below runs/: a table and a figure in runs/comparison
	$(BIN)/python -m pirl_rl.compare runs --out runs/comparison

clean: ## Remove .venv, caches and build output; runs stay
	rm -rf $(VENV) build dist docs/_build docs/_generated *.egg-info .pytest_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# pip comes last into a new environment and .setup last of all, so what was interrupted starts again.
$(BIN)/pip:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: name a Python 3.11 or newer with PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, $(PYTHON) is " + sys.version.split()[0] + ": name another with PYTHON=...")'
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "$(PYTHON) cannot create virtual environments: install its venv module (on Debian and Ubuntu the package python3-venv)" >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)

$(READY): pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/python -m pip install -c constraints.txt -e '.[dev]'
	@touch $@
