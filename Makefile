# Every target makes .venv when it is missing: `make train` and `make test` are all one needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# pip would compile for half a minute, mostly what nobody imports: Python does it at the first import.
unexport PYTHONDONTWRITEBYTECODE
INSTALL := $(BIN)/pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt
# Where the CPU build of PyTorch is. `make CUDA=1` takes what pip finds by itself, on Linux with CUDA.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
CUDA ?=
RUNS ?= runs
JOBS ?= 3
export OMPI_ALLOW_RUN_AS_ROOT := 1
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM := 1

.PHONY: train policies test test-slow package lint bench film figures docs clean
.NOTPARALLEL:

# What training and films need (EXTRAS=render: no PyBullet, no MPI), and what tests need.
TRAINING := $(VENV)/.installed-train
DEVELOPMENT := $(VENV)/.installed-dev
$(TRAINING): EXTRAS := render
$(DEVELOPMENT): EXTRAS := dev
$(TRAINING) $(DEVELOPMENT): setup.cfg pyproject.toml constraints.txt tools/install_torch.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON): needs Python 3.11 or newer (make PYTHON=python3.12)" >&2; exit 1; }
	@echo "setting up $(VENV) with PyTorch and MuJoCo: a few minutes"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python tools/install_torch.py --constraint constraints.txt --index $(TORCH_INDEX) $(CUDA:%=--cuda)
	$(INSTALL) --editable ".[$(EXTRAS)]"
	@# PyBullet only where it has a wheel: without it, the tests that need it are skipped and say so.
	@test $(EXTRAS) = render || $(INSTALL) -qq --only-binary pybullet pybullet || \
		echo "PyBullet: found no wheel for this Python; going on without it"
	@touch $(TRAINING) $@
	@echo "ready: . $(BIN)/activate"

# Two hands, the same but for touch, side by side on a core each. Goes on with runs that are there already.
# xargs and not `&`: Ctrl-C reaches both, and either's failure is xargs'.
TRAIN ?= --scene handover --n-test-episodes 100
train: export OMP_NUM_THREADS := 1
train: $(TRAINING)
	@printf '%s\n' "on touch" "off no_touch" | xargs -P 2 -L 1 bash -c 'set -o pipefail; \
		$(BIN)/tactilerl train $(TRAIN) --touch $$0 --workers 1 --out "$(RUNS)/$$1" | \
		while IFS= read -r line; do printf "%-8s  %s\n" "$$1" "$$line"; done'
	@echo "This films the two hands:"
	@echo "  $(BIN)/tactilerl render $(RUNS)/touch $(RUNS)/no_touch --video film.mp4"

# Several files of tests at a time, each with one thread; some wait, so three keep two cores busy.
# `make test JOBS=12` on eight.
test test-slow: export OMP_NUM_THREADS := 1
test test-slow: export OPENBLAS_NUM_THREADS := 1
test test-slow: export MKL_NUM_THREADS := 1
test: $(DEVELOPMENT)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder -m "not slow"

test-slow: $(DEVELOPMENT)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder -m slow

# The package as users get it, in one folder: for tools that read code and do not import it.
package: $(DEVELOPMENT)
	rm -rf build/package
	$(INSTALL) --no-deps --no-build-isolation --target build/package .

lint: package
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=build/package $(BIN)/mypy examples

# The trained policies that ship with the repository, from nothing; about ten core-minutes.
# The lift's early hold verdict is for speed. Of its seeds 0 to 3, 1 learns best.
define POLICY
$(BIN)/tactilerl train $(2) --workers 1 --out build/policies/$(1)
$(BIN)/python tools/ship_policy.py build/policies/$(1) examples/policies/$(1)
endef

policies: $(TRAINING)
	$(call POLICY,handover_touch,--scene handover --touch on)
	$(call POLICY,handover_no_touch,--scene handover --touch off)
	$(call POLICY,shadow_lift,--layout 4 --seed 1 --total-timesteps 36000 --hold-verdict settled)

# 15 to 30 minutes on two cores; `make bench-peers` and so on for a part. `make bench OUT=docs/data`
# is what the docs show of these.
OUT ?= bench
GRASPS ?= 5
BENCHMARKS := peers speed_vs_error hard_cases
FLAGS_speed_vs_error := --grasps $(GRASPS) --jobs 2
FLAGS_hard_cases := --steps 100

bench: $(BENCHMARKS:%=bench-%)

bench-%: $(DEVELOPMENT)
	$(BIN)/python -m benchmarks $* $(FLAGS_$*) --out $(OUT)/$*.json

# README's film; needs ffmpeg.
TO_GIF := fps=25/3,scale=iw*2/3:-1:flags=area,split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none
film: $(DEVELOPMENT)
	mkdir -p build
	$(BIN)/tactilerl render examples/policies/handover_touch examples/policies/handover_no_touch \
		--azimuth 160 --elevation -10 --video build/film.mp4 --overwrite
	ffmpeg -v error -y -i build/film.mp4 -vf "$(TO_GIF)" docs/images/handover.gif

figures: $(DEVELOPMENT)
	$(BIN)/python -m benchmarks figures

# The site, from docs/*.md and the code. A warning or a broken link fails.
DOCS := $(VENV)/.installed-docs
$(DOCS): $(TRAINING)
	$(INSTALL) --editable ".[docs]"
	touch $@

docs: export NO_MKDOCS_2_WARNING := 1
docs: package $(DOCS)
	$(BIN)/mkdocs build --strict
	@echo "The site is in build/site: open build/site/index.html"

clean:
	rm -rf $(VENV) build *.egg-info
