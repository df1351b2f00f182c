# What a contributor does, and what CI does. `make` alone lists it.
#   PYTHON=python3.12   the interpreter that `make setup` builds on
#   ARGS="-k limiter"      further arguments for demo, test and bench
#   QUICK=      takes the slow tests in
#   WORKERS=1           how many tests run side by side (3)
#   UPGRADE=1           lets `make lock` take the newest versions allowed

PYTHON ?=
ARGS ?=
UPGRADE ?=
# More than cores: half of the time of `make test` is robots in real time, and waiting for them.
WORKERS ?= 3
PAYLOADS ?= 1000000
MINUTES ?= 30
TRIALS ?= 300
QUICK ?= 1

# A sourced ROS workspace sets these; its packages and pytest plugins must not leak into ours.
unexport PYTHONPATH PYTHONHOME PYTHONSTARTUP PYTEST_ADDOPTS VIRTUAL_ENV
# Containers set this one; without bytecode on disk each of a run's six processes compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE

bin := .venv/bin
stamp := .venv/.setup
bootstrap := $(or $(PYTHON),python3) deploy/bootstrap.py
packages := snakesim $(wildcard snakesim_*)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo compiled test test-all test-here test-vcan attack faults mutation fuzz soak kills check links bench bench-peers bench-paths golden schemas docs lock clean FORCE

help: ## List these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' Makefile

setup: $(stamp) ## Make .venv from the hashed lock (PYTHON=python3.12 to choose)

demo: $(stamp) ## Run the simulated snake along a row of pegs, into runs/demo, with a page to watch it
	$(bin)/snakesim run peg_row --controller obstacle_aided --console --clock-mode realtime --duration 10 --out runs/demo $(ARGS)
	@printf '%s\n' 'Next:' '  $(bin)/snakesim console runs/demo                          see it again, with a time slider' \
	  '  $(bin)/snakesim run triplet --console --clock-mode realtime      the paper'\''s case study: one joint at a time pushes' \
	  '  docs/tutorial.md, 3: write a controller                       push it your way'

test: test-here test-vcan ## Run the tests, but for those that are slow

test-all: ## Run all tests, as before a release
	SNAKESIM_HYPOTHESIS=explore $(MAKE) test-here test-vcan QUICK=

test-here: compiled ## Run the tests that need no CAN bus (ARGS="-k limiter")
	$(here) -n $(WORKERS) --dist worksteal || $(here) $(again)

test-vcan: compiled ## Run the CAN tests on real SocketCAN, in a small VM where the kernel has none (ARGS="-m slow": kills, triplet, openings)
	SNAKESIM_NEED_VCAN=1 $(bin)/python deploy/vm/with_vcan.py -- sh -c '$(on_vcan) || exec $(on_vcan) $(again)'

# Once: each worker would compile all that it imports, and the emulated machine would take many times as long.
compiled: .venv/.compiled
	-@$(bin)/python -m compileall -qq -j 0 $(packages) tests

.venv/.compiled: $(stamp)
	-@$(bin)/python -m compileall -qq -j 0 -x '/(OpenGL|fontTools|onnx|setuptools|sqlalchemy|tests?|testing)/' .venv/lib
	@touch $@

# Robots in real time stumble on a busy machine, an emulated one most of all. What failed is tried once more: here, alone.
again = --last-failed --last-failed-no-failures none
here = $(bin)/python -m pytest --ignore tests/vcan $(if $(QUICK),-m "not slow") $(ARGS)
on_vcan = $(bin)/python -m pytest -o cache_dir=build/pytest-vcan tests/vcan tests/contract $(if $(QUICK),-m "not slow") --timeout 900 $(ARGS)

faults: $(stamp) ## Measure the fault table and write docs/faults.md (ARGS="--rows NAME --trials 3")
	$(bin)/python -m tests.faults --write $(ARGS)

mutation: $(stamp) ## Break the safety core one change at a time; every break must be noticed
	$(bin)/python -m tests.mutation --workers $(WORKERS) $(ARGS)

fuzz: $(stamp) ## Bad payloads into every decoder, then over the network of a robot that runs (PAYLOADS=1000000)
	$(bin)/python -m tests.fuzz --payloads $(PAYLOADS) $(ARGS)
	$(bin)/python -m tests.fuzz --payloads $(PAYLOADS) --network $(ARGS)

attack: $(stamp) ## Every attack of a stranger on the network, in full (ARGS="-k a4"); make test has the quick form
	SNAKESIM_ATTACK=full $(bin)/python -m pytest tests/attack --timeout 900 $(ARGS)

kills: $(stamp) ## Random kills and freezes of runs that start, arm, stop, reset and end (TRIALS=300, ARGS="--seed 2")
	$(bin)/python -m tests.soak.kills --trials $(TRIALS) $(ARGS)

soak: $(stamp) ## A long run with faults at random, and an operator who recovers (MINUTES=30, ARGS="--backend can --seed 2")
	$(bin)/python -m tests.soak --minutes $(MINUTES) $(ARGS)

check: $(stamp) ## Lint, format, types and import rules, without changing anything
	$(bin)/ruff check
	$(bin)/ruff format --check
	$(bin)/basedpyright
	@for package in $(packages); do \
	  grep -q "^root_packages = .*\"$$package\"" pyproject.toml || \
	    { echo "check: add $$package to root_packages under [tool.importlinter] in pyproject.toml"; exit 1; }; \
	done
	$(bin)/lint-imports

bench: $(stamp) ## Measure the ratios in benchmarks/
	$(bin)/python -m benchmarks $(ARGS)

bench-peers: $(stamp) ## Measure the loop beside raw Zenoh, dora-rs and rospy (installs them: build/peers, Debian)
	$(bin)/python -m benchmarks.peers $(ARGS)

links: $(stamp) ## Measure bad links between a robot and its controller, and write docs/lab-links.md (root; ARGS="--trials 4")
	$(bin)/python -m tests.links --write $(ARGS)

bench-paths: $(stamp) ## Measure the loop over routers, mTLS and a slow link beside raw Zenoh (root)
	$(bin)/python -m benchmarks.paths $(ARGS)

golden: $(stamp) ## Write tests/golden.json again, after a change that is meant to change what robots do
	$(bin)/python -m tests.golden

schemas: $(stamp) ## Regenerate what is made from the code: JSON Schemas, key space, table of faults, commands
	$(bin)/snakesim schema --out schemas
	$(bin)/python -m tests.kinds_table
	$(bin)/python -m tests.commands_page

docs: $(stamp) ## Write the documentation as a site into build/docs, searchable, also without a network
	$(bin)/python docs/site/build.py

lock: ## Resolve the lock files again (UPGRADE=1 for newer versions)
	$(bootstrap) lock $(if $(UPGRADE),--upgrade)

clean: ## Remove what setup, builds and caches left; recordings in runs/ stay
	rm -rf .venv .tools build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Setup runs again after a change of its inputs, in a folder that was moved, when the environment's Python is gone,
# or for another PYTHON.
$(stamp): requirements.lock pyproject.toml deploy/bootstrap.lock deploy/bootstrap.py
	@$(bootstrap) setup --python "$(PYTHON)"

made_in := $(shell sed -n 1p $(stamp) 2>/dev/null)
made_with := $(shell sed -n 2p $(stamp) 2>/dev/null)
ifneq ($(made_in),$(CURDIR))
$(stamp): FORCE
else ifeq ($(wildcard $(bin)/python),)
$(stamp): FORCE
else ifneq ($(made_with),$(or $(PYTHON),$(made_with)))
$(stamp): FORCE
endif
