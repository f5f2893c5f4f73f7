# Every target but help and clean first makes the environment, if there is none yet.
#
#   make demo PYTHON=python3.11          another Python for the environment
#   make test VENV=/path/to/environment  another environment, made there if need be
#   make demo DEMO="--scene blender"     options of data_scripts/demo.py
#   make bench BENCH="--quick --sample"  options of all benchmarks
#   make bench BEFORE=/path/to/worktree  beside an earlier version, too

PYTHON ?= python3
VENV ?= .venv
DEMO ?=
BENCH ?=
BEFORE ?=

BIN := $(abspath $(VENV))/bin
READY := $(VENV)/.sparsestyle-installed
# The workers use all cores already; more threads in each would only slow them down.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

.DEFAULT_GOAL := help
.PHONY: help demo test lint bench clean

help:
	@echo "make demo   sample photos and a painting -> stylised scene, video and page in demo/index.html"
	@echo "make test   lint, then the tests"
	@echo "make lint   ruff and import-linter; 'make lint FIX=1' repairs what it can"
	@echo "make bench  times it beside nerfstudio and plain code; takes hours, table in benchmarks/results/summary.md"
	@echo "make clean  removes the environment, caches and the demo"
	@echo
	@echo "Whichever runs first makes an environment in $(VENV): a few minutes, and about 7 GB with CUDA wheels."

demo: $(READY)
	$(BIN)/python data_scripts/demo.py $(DEMO)

test: lint
	$(PYTEST) -rs --durations=5

lint: $(READY)
ifdef FIX
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
else
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
endif

bench: $(READY)
	set -e; for name in hash_grid nnfm stage2_step render memory scaling effects profile torch_options viewer; do \
	    $(BIN)/python -m benchmarks.$$name $(BENCH); \
	done; for peer in dense even vanilla-nerf; do \
	    $(BIN)/python -m benchmarks.stage1 --peer $$peer $(BENCH); \
	done
	$(BIN)/python -m benchmarks.stability --method coarse-fewshot-draft $(BENCH)
	$(BIN)/python -m benchmarks.stability --method hier-style-draft $(BENCH)
	$(if $(BEFORE),$(BIN)/python -m benchmarks.before --before $(BEFORE) $(BENCH))
	$(BIN)/python -m benchmarks.summary $(BENCH)

$(READY): pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e .[dev,compare]
	@touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' || { \
	    echo "Error: '$(PYTHON)' is missing or not Python 3.10, 3.11 or 3.12; name one: make $(MAKECMDGOALS) PYTHON=python3.11" >&2; \
	    exit 1; }
	$(PYTHON) -m venv $(VENV)

clean:
	rm -rf .venv demo build dist *.egg-info .hypothesis .pytest_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
