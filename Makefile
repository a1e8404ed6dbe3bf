# Every target makes .venv when it is missing: `make train` and `make test` are all one needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN ?= runs/shadow_layout4
export OMPI_ALLOW_RUN_AS_ROOT := 1
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM := 1

.PHONY: train test test-slow lint bench figures clean
.NOTPARALLEL:

# PyTorch first and alone: the plain dependency could pull gigabytes of CUDA packages.
$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt torch
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

# About ten minutes on two cores. The early hold verdict and two environments are for speed.
# Goes on with the run when it is there already.
train: $(VENV)/.installed
	if [ -e $(RUN)/config.json ]; then $(BIN)/tactilerl train --resume $(RUN); else \
		$(BIN)/tactilerl train --algo ppo --env shadow --layout 4 --total-timesteps 50000 \
			--num-envs 2 --hold-verdict settled --out $(RUN); fi
	$(BIN)/tactilerl evaluate $(RUN) --episodes 50

test: $(VENV)/.installed
	$(BIN)/python -m pytest -m "not slow"

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# About half an hour on two cores; `make bench-peers` and so on for a part. `make bench OUT=docs/data`
# is what the docs show of these. `make bench-exploration` is not among them: it is about the task.
OUT ?= bench
GRASPS ?= 5
BENCHMARKS := peers scaling footprint precision scene_parts speed_vs_error hard_cases
FLAGS_speed_vs_error := --grasps $(GRASPS) --jobs 2
FLAGS_hard_cases := --steps 100

bench: $(BENCHMARKS:%=bench-%)

bench-%: $(VENV)/.installed
	mkdir -p $(OUT)
	$(BIN)/python benchmarks/$*.py $(FLAGS_$*) --out $(OUT)/$*.json

figures: $(VENV)/.installed
	$(BIN)/python benchmarks/figures.py

clean:
	rm -rf $(VENV) build *.egg-info
