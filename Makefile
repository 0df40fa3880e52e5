# `make bench` and `make test` do all the set-up on a fresh machine: Python 3.10 to 3.13 and make are enough.
PYTHON ?= python3
VENV := .venv
# Windows keeps its programs elsewhere.
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
READY := $(VENV)/.ready

export OMP_NUM_THREADS = 1

.PHONY: bench test test-slow attacks mutants speed lint types wheel docs clean

bench: $(READY)
	$(BIN)/latticebench run default --results runs/default

test: $(READY)
	$(BIN)/python -m pytest -m "not slow" --benchmark-disable -n 2 --dist loadfile

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow --benchmark-disable -n 2 --dist worksteal

# Every attack of the tests with seeds that no run before had: make attacks FRESH=7.
FRESH ?= $(shell date +%s)
attacks: $(READY)
	$(BIN)/python -m pytest tests/systems/test_damaged_files.py tests/systems/test_parser.py tests/systems/test_terms.py \
		tests/systems/test_readers.py tests/systems/test_folders.py tests/bench/test_attacks.py \
		tests/bench/test_commands.py tests/bench/test_escape.py tests/bench/test_full.py \
		tests/bench/test_hostile.py tests/bench/test_killed.py tests/bench/test_odd_cells.py \
		tests/bench/test_odd_recordings.py tests/bench/test_outputs.py tests/bench/test_streams.py \
		--fresh $(FRESH) --hypothesis-seed $(FRESH) --benchmark-disable -n 2 --dist worksteal

# Changes the code in one place at a time and sees whether the tests notice; some minutes a module.
mutants: $(VENV)/.mutants
	nice $(BIN)/python results/mutants/mutants.py

$(VENV)/.mutants: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.txt --no-build-isolation -e ".[mutants]"
	@touch $(VENV)/.mutants

speed: $(READY)
	$(BIN)/python -m pytest tests/speed --benchmark-only

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy
	$(BIN)/mypy results/*/*.py

wheel: $(READY)
	rm -rf dist build
	$(BIN)/python -m build --wheel --no-isolation --outdir dist .

# The pages of docs/, under build/docs; their commands and examples are run, and a warning is an error.
docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going -q -E -b html docs build/docs

$(VENV)/.docs: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.txt --no-build-isolation -e ".[docs]"
	@touch $(VENV)/.docs

$(READY): requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	rm -rf $(VENV)/typed && mkdir -p $(VENV)/typed/latticebench
	for part in latticebench/*.py latticebench/py.typed systems methods diagnosis bench; do \
		ln -s "$(CURDIR)/$$part" $(VENV)/typed/latticebench/; done
	@touch $(READY)

clean:
	rm -rf $(VENV) dist build runs .mypy_cache .ruff_cache .pytest_cache
