# Each target sets itself up: a virtual environment with pinned packages, made anew only when the pins change.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: setup demo test test-all test-fast test-slurm coverage mutants golden check docs dist pre-commit clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "memmlp needs Python 3.11 or newer; try make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv .venv
	@echo "1 of 2: torch; without a GPU, PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu avoids 3 GB of CUDA libraries"
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt torch==2.13.0
	@echo "2 of 2: memmlp, its extras and development tools"
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $(STAMP)

demo: $(STAMP)
	$(BIN)/memmlp demo

# A process for each core; one more costs as much in imports as it gains. They share compiled code.
CORES := $(BIN)/python -c 'from memmlp.common.processes import count_usable_cores; print(count_usable_cores())'
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder -n $$($(CORES))

test: $(STAMP)
	$(PYTEST)

test-all: $(STAMP)
	$(PYTEST) -m "long or not long"

test-fast: $(STAMP)
	$(PYTEST) -m "not slow and not long"

# A real Slurm of one node in a temporary folder, where Debian's slurm-wlm and munge are installed; 25 minutes.
test-slurm: $(STAMP)
	MEMMLP_SLURM=1 $(BIN)/python -m pytest -rs -s tests/sweep/executors/test_real_slurm.py

coverage: $(STAMP)
	$(PYTEST) -m "long or not long" --cov --cov-report=term:skip-covered

mutants: $(STAMP)
	$(BIN)/python benchmarks/mutants.py $(MUTANTS)

golden: $(STAMP)
	$(BIN)/python tests/golden.py

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: .venv/.docs
	$(BIN)/python -m docs.results.make_pages --check
	$(BIN)/python -m sphinx --jobs auto --write-all --fresh-env --fail-on-warning --keep-going --quiet docs site
	@echo "open site/index.html"

dist: .venv/.publish
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	MEMMLP_DIST=dist $(BIN)/python -m pytest -m slow tests/test_dist.py

pre-commit: .venv/.publish
	$(BIN)/pre-commit install

.venv/.docs .venv/.publish: .venv/.%: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	@touch $@

clean:
	rm -rf .venv
