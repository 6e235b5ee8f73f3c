# Every target sets up what it needs: a virtual environment beside this file, and the system libraries for rendering.
VENV ?= .venv
PYTHON ?= python3
# The CPU build of PyTorch avoids gigabytes of CUDA libraries; `make TORCH=torch ...` installs your platform's default build.
TORCH ?= torch==2.13.0
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo demo-pixels states-table test test-slow test-sb3 fuzz test-chaos pytest lint type format check-codestyle commit-checks doc clean

demo: $(READY)  ## collect data, train CEBORL, evaluate, and report into demo/ (about 15 minutes)
	$(BIN)/sb3-offline demo --output demo

demo-pixels: $(READY)  ## the same from 64x64 images into demo-pixels/ (about half an hour)
	$(BIN)/sb3-offline demo --obs-type pixels --output demo-pixels

states-table: $(READY)  ## CEBORL, RCE and BC on all tasks from states with three seeds, into results/ceborl_states.csv (hours)
	$(BIN)/python benchmarks/scripted_data.py
	$(BIN)/sb3-offline benchmark ceborl_states --runs runs/states_table --output results/ceborl_states.csv

test: $(READY)  ## all fast tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

test-sb3: $(READY)  ## the test suite of Stable-Baselines3, with each algorithm in place of SAC
	OMP_NUM_THREADS=1 $(BIN)/python tests/sb3_suite

test-slow: $(READY)  ## the tests that train for minutes
	$(BIN)/python -m pytest -m slow

fuzz: $(READY)  ## 2,000 inputs drawn at random: each is right, or refused in one line (some minutes)
	FUZZ_INPUTS=2000 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -s tests/test_fuzz.py

test-chaos: $(READY)  ## kill, fill and collide everything that writes, into results/chaos.csv (half an hour)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/chaos.py --output results/chaos.csv

pytest: test

lint: $(READY)
	$(BIN)/ruff check .

type: $(READY)  ## type checks of the package as it is installed, with data_tools inside
	rm -rf $(VENV)/types && mkdir -p $(VENV)/types/sb3_offline
	ln -s "$(CURDIR)"/sb3_offline/* "$(CURDIR)/data_tools" $(VENV)/types/sb3_offline
	MYPYPATH=$(VENV)/types $(BIN)/mypy -p sb3_offline

format: $(READY)
	$(BIN)/ruff check --select I --fix .
	$(BIN)/black .

check-codestyle: $(READY)
	$(BIN)/ruff check --select I .
	$(BIN)/black --check .

commit-checks: format type lint

doc: $(READY)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

$(READY): setup.cfg setup.py pyproject.toml
	PYTHON="$(PYTHON)" TORCH="$(TORCH)" sh .ci/setup "$(VENV)"
	touch $@

clean:
	rm -rf build dist docs/_build .pytest_cache .mypy_cache .ruff_cache
