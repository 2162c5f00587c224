# Every target makes what it needs: the first one run creates .venv and installs the locked packages.
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

# One thread per process: parallelism is over runs and tests, and results do not depend on the machine's cores.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export NUMBA_NUM_THREADS := 1

# The first interpreter found that is new enough; override with `make PYTHON=/path/to/python3 ...`.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo $$p; break; }; done)
TEST_PROCESSES ?= 2

BIN := .venv/bin
INSTALLED := .venv/.installed
FILES := .venv/.files
DEVELOP := .venv/.develop

.PHONY: help install reproduce results tables test test-all fuzz docs bench lint format dashboard screenshot slurm-check lock clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

UV := $(BIN)/uv pip install --quiet --compile-bytecode --python .venv

$(INSTALLED): requirements.lock pyproject.toml
	@if [ -z "$(PYTHON)" ]; then echo "mvest needs Python 3.11 or newer; name one with make PYTHON=..." >&2; exit 1; fi
	@echo "installing what mvest needs into .venv, versions and hashes of requirements.lock ..."
	@$(PYTHON) -m venv .venv
	@awk '/^uv==/ {p = 1} p {print} p && !/\\$$/ {exit}' requirements.lock > .venv/uv.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r .venv/uv.lock
	@$(UV) --require-hashes --constraint requirements.lock -r pyproject.toml
	@$(UV) --no-deps --build-constraint requirements.lock -e .
	@touch $@

# What Table 1 does not need comes when a target asks for it.
$(FILES): $(INSTALLED)
	@echo "installing what reads surfaces, label maps and volumes ..."
	@$(UV) --require-hashes --constraint requirements.lock -r pyproject.toml --extra files
	@touch $@

$(DEVELOP): $(FILES)
	@echo "installing what tests, documentation and 3D pictures need ..."
	@$(UV) --require-hashes --constraint requirements.lock -r pyproject.toml \
		--extra files --extra dev --extra docs --extra viz --extra cluster
	@touch $@

install: $(DEVELOP) ## create .venv with all locked packages (every other target installs what it needs)

reproduce: $(INSTALLED) ## Table 1 and its figure, in outputs/results, and whether they are as published
	$(BIN)/python -m experiments.run experiment=table1
	$(BIN)/python -m experiments.run experiment=table1_independent
	$(BIN)/python -m experiments.results.reproduced table1

results: $(FILES) ## which published results are stale and their CPU hours (RUN="--run [STUDY ...] --shard 1/2": make them)
	$(BIN)/python -m experiments.cli results $(RUN)

tables: $(INSTALLED) ## everything in results/
	$(BIN)/python -m experiments.cli tables

test: $(DEVELOP) ## the tests that finish in minutes
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadfile -m "not slow"

test-all: $(DEVELOP) ## every test
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadfile

fuzz: $(DEVELOP) ## damaged files at every importer, and a table of how they ended (FUZZ_SECONDS=3600)
	$(BIN)/python -m tests.fuzz --seconds $(or $(FUZZ_SECONDS),3600)

docs: $(DEVELOP) ## the documentation site, in docs/_build/html; warnings are errors
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

BENCH := $(BIN)/python -m pytest tests/benchmark -p no:xdist -o python_files='bench_*.py'
BENCH_OF ?= not tet4-25k
bench: $(DEVELOP) ## how fast: kernels, closures, Table 1, other libraries (BENCH_OF=tet4-25k: the largest of tetrahedra, an hour)
	@mkdir -p outputs
	$(BENCH) --benchmark-timer=time.process_time -k "not batch and ($(BENCH_OF))" \
		--benchmark-json=outputs/benchmark.json
	$(BENCH) -k "batch" --benchmark-json=outputs/benchmark_batch.json
	MKL_NUM_THREADS=2 OMP_NUM_THREADS=2 $(BENCH) -k "25k and factorisation" \
		--benchmark-json=outputs/benchmark_2_threads.json
	$(BIN)/python -m tests.benchmark.peers outputs/peers.json
	$(BIN)/python -m tests.benchmark.report outputs/benchmark.json outputs/benchmark_batch.json \
		outputs/benchmark_2_threads.json outputs/peers.json

lint: $(DEVELOP) ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(DEVELOP) ## rewrite the code in the house format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

dashboard: $(INSTALLED) ## MLflow's pages, on the comparison of the last sweep (PORT=5000)
	$(BIN)/mvest dashboard $(if $(PORT),--port $(PORT))

screenshot: $(INSTALLED) ## the picture of the dashboard in results/ (needs Chromium)
	$(BIN)/python -m tests.experiments.runner.screenshot

slurm-check: $(DEVELOP) ## a sweep through a real Slurm, with jobs that die (tests/slurm/setup.sh starts one, as root)
	$(BIN)/python -m pytest tests/slurm -p no:xdist -o python_files='check_*.py'

lock: $(DEVELOP) ## renew requirements.lock after a change of dependencies (add UPGRADE=--upgrade for the newest)
	$(BIN)/uv pip compile pyproject.toml --universal --python-version 3.11 --extra files --extra dev --extra docs --extra viz --extra cluster \
		--generate-hashes --no-annotate --custom-compile-command "make lock" $(UPGRADE) \
		--quiet --output-file requirements.lock

clean: ## remove caches and the virtual environment; results and outputs stay
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache build dist *.egg-info
	rm -rf docs/_build docs/api docs/gallery docs/pictures docs/studies
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
