# The main job is `make run`; `make test` runs every test. All targets share one virtual environment, ./.venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# One test process a core and one more, because some wait for browsers, kernels and servers; at most eight. Each holds up to
# 1.5 GiB; a process that is done takes tests from another. Of pytest's installed plugins only xdist is loaded: importing the
# others takes each process seconds. Compiled modules are kept, whatever the environment says: a third of a second a process.
WORKERS := $(shell $(PYTHON) -c 'import os; print(min(8, 1 + (os.cpu_count() or 1)))')
PYTEST := PYTHONDONTWRITEBYTECODE= PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(BIN)/python -m pytest -p xdist -q -n $(WORKERS) --dist worksteal

.PHONY: run test check fast results results-check neighbours
.DEFAULT_GOAL := run

$(VENV)/.installed: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test,notebooks]'
	touch $@

run: $(VENV)/.installed
	$(BIN)/bayespbrl run gridworld

test: $(VENV)/.installed
	$(PYTEST)

fast: $(VENV)/.installed
	$(PYTEST) -m "not slow"

check: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

results: $(VENV)/.installed
	$(BIN)/python benchmarks/results_page.py

results-check: $(VENV)/.installed
	$(BIN)/python benchmarks/results_page.py --check

# Beside imitation's preference comparisons. Each library has an environment of its own, because imitation needs an older
# gymnasium and a NumPy that there is for Python 3.11 and 3.12. PyTorch without CUDA suffices: TORCH= takes another
# requirement, or a path to a wheel.
NEIGHBOURS := .venv-neighbours
TORCH ?= torch>=2.8,<3

$(NEIGHBOURS)/.installed: pyproject.toml Makefile
	for name in bayespbrl imitation; do \
	  test -x $(NEIGHBOURS)/$$name/bin/python || $(PYTHON) -m venv $(NEIGHBOURS)/$$name || exit 1; \
	  $(NEIGHBOURS)/$$name/bin/python -m pip install --quiet --disable-pip-version-check '$(TORCH)' || exit 1; \
	done
	$(NEIGHBOURS)/bayespbrl/bin/python -m pip install --quiet --disable-pip-version-check 'stable-baselines3>=2.6,<3' -e .
	$(NEIGHBOURS)/imitation/bin/python -m pip install --quiet --disable-pip-version-check 'imitation>=1.0.1,<1.1' 'numpy<2'
	touch $@

neighbours: $(NEIGHBOURS)/.installed
	$(NEIGHBOURS)/bayespbrl/bin/python benchmarks/neighbours.py run $(OPTIONS)
