# Everything here sets itself up: `make demo` and `make test` work in a fresh clone.
SHELL = /bin/bash
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
CODE = sb3_kfcv zoo tests benchmarks setup.py

.PHONY: help demo test test-expensive benchmark benchmark-scale benchmark-training benchmark-peers benchmark-report \
	format check-format lint type commit-checks docs clean

help:  ## Show the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 20

# torch first: other packages name ranges of it that would pull another build.
$(VENV)/.installed: setup.py constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[tests,video]"
	touch $@

demo: $(VENV)/.installed  ## Train KFCVMADDPG on Grassland for three minutes, evaluate it, draw it
	$(BIN)/python zoo/demo.py

test: $(VENV)/.installed  ## Run the tests (a few minutes)
	$(BIN)/python -m pytest -n 2 -q

test-expensive: $(VENV)/.installed  ## Run the long tests: learning to a threshold
	$(BIN)/python -m pytest -q -m expensive

benchmark: $(VENV)/.installed  ## Measure how fast we are (some minutes; best on an idle machine)
	$(BIN)/python benchmarks/speed.py

benchmark-scale: $(VENV)/.installed  ## Measure how time and memory grow, and draw it (ten minutes)
	$(BIN)/python benchmarks/scale.py

benchmark-training: $(VENV)/.installed  ## Measure a tenth of the paper's trainings, and project the whole (half an hour)
	$(BIN)/python benchmarks/full_training.py
	$(BIN)/python benchmarks/full_training.py --worlds Grassland-v0 --params critic_input:state

benchmark-peers: $(VENV)/.installed  ## Measure ours beside the peers (under an hour, gigabytes; builds their environments)
	$(BIN)/python benchmarks/compare.py

benchmark-report: $(VENV)/.installed  ## Write what was measured into docs/performance.md
	$(BIN)/python benchmarks/report.py

format: $(VENV)/.installed  ## Sort imports, format the code
	$(BIN)/ruff check --select I --fix $(CODE)
	$(BIN)/ruff format $(CODE)

check-format: $(VENV)/.installed  ## Fail if the code is not formatted
	$(BIN)/ruff check --select I $(CODE)
	$(BIN)/ruff format --check $(CODE)

lint: $(VENV)/.installed  ## Look for mistakes
	$(BIN)/ruff check $(CODE)

type: $(VENV)/.installed  ## Check the types
	$(BIN)/mypy sb3_kfcv zoo

commit-checks: check-format type lint  ## What CI asks for beside the tests

docs: $(VENV)/.installed  ## Build the documentation into site/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[docs]"
	$(BIN)/mkdocs build --strict

clean:  ## Remove what was built, compiled caches included
	rm -rf $(VENV) build dist site *.egg-info .mypy_cache .ruff_cache .pytest_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
