# Every target makes .venv when it is missing: `make train` and `make test` are all one needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN ?= runs/shadow_layout4
export OMPI_ALLOW_RUN_AS_ROOT := 1
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM := 1

.PHONY: train test test-slow lint bench figures clean

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

bench: $(VENV)/.installed
	$(BIN)/python benchmarks/peers.py
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/footprint.py
	$(BIN)/python benchmarks/exploration.py
	$(BIN)/python benchmarks/precision.py
	$(BIN)/python benchmarks/scene_parts.py
	$(BIN)/python benchmarks/hard_cases.py --steps 200
	$(BIN)/python benchmarks/speed_vs_error.py --grasps 2

figures: $(VENV)/.installed
	$(BIN)/python benchmarks/figures.py

clean:
	rm -rf $(VENV) build *.egg-info
