# Two commands do everything: `make run` and `make test`. Set-up happens by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
WARM := $(VENV)/.warm
# Folders whose tests answer in seconds: what a change breaks at once
QUICK := tests/house tests/model tests/physics tests/signals tests/runs tests/report

# Files go to one of some processes whole: what a file's tests share is made once. Where no time is
# judged there is one more than there are processors, since some tests wait.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
BY_FILE := --dist loadfile --no-loadscope-reorder
PAIRS := --numprocesses 2 $(BY_FILE)
SHARED := --numprocesses 3 $(BY_FILE) -m "not alone and not slow"
WITH_ALONE := $(sort $(shell grep --recursive --files-with-matches --include '*.py' mark.alone tests))
REAL_TIME := -m "alone and not slow" $(WITH_ALONE)

# Where this is set every one of the tests' processes translates all it imports anew, for seconds
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test quick experiment setup lint shared quick-tests docs trials soak bench licences clean

run: $(WARM)
	$(BIN)/adapter run --scenario as_built --seed 5 --duration 40 --feedforward learned --out runs/panda --overwrite
	$(BIN)/adapter gap runs/panda/recording.mcap --robot panda --out runs/panda/gap

experiment: $(WARM)
	$(BIN)/adapter experiment atlas panda --out runs/experiment --json runs/experiment.json

# The lint beside the tests that judge no time: mypy alone would leave a processor idle.
# Of tests in real time only their files are collected, for which all that others import is idle
# work. One that fails is run once more, with the machine to itself: a shared machine stands still now
# and then. One that fails twice fails.
test: $(STAMP)
	$(MAKE) --jobs 2 lint shared
	$(PYTEST) $(PAIRS) $(REAL_TIME) || $(PYTEST) --last-failed --last-failed-no-failures none $(REAL_TIME)

quick: $(STAMP)
	$(MAKE) --jobs 2 lint quick-tests

shared: $(WARM)
	$(PYTEST) $(SHARED)

quick-tests: $(WARM)
	$(PYTEST) $(SHARED) $(QUICK)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

setup: $(WARM)

# Notebooks are executed first, so that their pages have pictures
docs: $(WARM)
	PYTHONPATH=. $(BIN)/python docs/site/notebooks.py
	$(BIN)/mkdocs build --strict --config-file docs/site/mkdocs.yml

# Python translates what is imported when it is; pip would translate all of torch, for a minute
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + sys.version.split()[0])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --constraint constraints.txt --editable '.[test]'
	touch $@

# Kernels are compiled once, beside the lint where there is one
$(WARM): $(STAMP)
	$(BIN)/python -m adapter.cli.warm_up > /dev/null 2>&1
	touch $@

trials: $(WARM)
	mkdir -p runs
	$(PYTEST) --numprocesses 2 --dist loadfile -m slow
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/trials.py --json runs/trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/lambda_trials.py trees arms --json runs/lambda_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/imu_trials.py --json runs/imu_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/gap_trials.py --judge --json runs/gap_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/simulate_trials.py --json runs/simulate_trials.json
	PYTHONPATH=. $(BIN)/python tests/benchmarks/live_trials.py
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/twin_trials.py --json runs/twin_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/door_trials.py --json runs/door_trials.json
	PYTHONPATH=. $(BIN)/python tests/benchmarks/law_trials.py --json runs/law_trials.json
	test ! -d ../shared || PYTHONPATH=. $(BIN)/python tests/benchmarks/odd_trials.py hidden --first 31000 --json runs/odd_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/contact_trials.py --json runs/contact_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/rate_trials.py --json runs/rate_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/rate_trials.py --unchanged --trials 20 --first 300 --seconds 17 --json runs/rate_trials_unchanged.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/excite_trials.py --json runs/excite_trials.json
	PYTHONPATH=. $(BIN)/python tests/benchmarks/client_trials.py --json runs/client_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/mutated_inputs.py --json runs/mutated_inputs.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/discover_trials.py --hard --json runs/discover_trials.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/fault_trials.py --driver sim --trials 10000 --json runs/fault_trials_sim.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/fault_trials.py --driver fci --trials 10000 --json runs/fault_trials_fci.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/fault_trials.py --driver can --trials 10000 --json runs/fault_trials_can.json
	PYTHONPATH=. $(BIN)/python tests/benchmarks/mutations.py --json runs/mutations.json

soak: $(WARM)
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/soak.py --minutes 10
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/soak.py --driver fci --faults 0.01 --minutes 30
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/soak.py --driver can --faults 0.01 --minutes 30

bench: $(WARM)
	$(BIN)/adapter bench
	$(BIN)/python tests/benchmarks/wires.py
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/tree_rate.py --json runs/tree_rate.json
	PYTHONPATH=. OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/fleet.py --json runs/bench_fleet.json

licences: $(STAMP)
	PYTHONPATH=. $(BIN)/python tests/benchmarks/licences.py

clean:
	rm -rf $(VENV) build *.egg-info
