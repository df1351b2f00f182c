# What a contributor does, and what CI does. `make` alone lists it.
#   PYTHON=python3.12   the interpreter that `make setup` builds on
#   ARGS="-k limiter"      further arguments for demo, test and bench
#   WORKERS=1           how many tests run side by side (2)
#   UPGRADE=1           lets `make lock` take the newest versions allowed

PYTHON ?=
ARGS ?=
UPGRADE ?=
WORKERS ?= 2
# More than cores: these tests wait for processes most of the time.
SYSTEM_WORKERS ?= 3
PAYLOADS ?= 1000000
MINUTES ?= 30
TRIALS ?= 300
FOLDERS ?= tests/unit tests/contract

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
.PHONY: help setup demo compiled test test-unit test-contract test-system test-can coverage verify attack faults mutation fuzz soak kills check links bench bench-peers bench-paths golden schemas docs wheels release lock clean FORCE

help: ## List these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' Makefile

setup: $(stamp) ## Make .venv from the hashed lock (PYTHON=python3.12 to choose)

demo: $(stamp) ## Run the simulated snake along a row of pegs, into runs/demo, with a page to watch it
	$(bin)/snakesim run peg_row --controller obstacle_aided --console --clock-mode realtime --duration 10 --out runs/demo $(ARGS)
	@printf '%s\n' 'Next:' '  $(bin)/snakesim console runs/demo                          see it again, with a time slider' \
	  '  $(bin)/snakesim run triplet --console --clock-mode realtime      the paper'\''s case study: one joint at a time pushes' \
	  '  docs/tutorials/write-a-controller.md                          push it your way'

# All folders together, because the unit tests, which wait for nothing, use the time in which tests with processes wait.
test: compiled ## Run the tests of a contributor (6 minutes on two slow cores); CI also runs the heavy ones
	@mkdir -p build; \
	$(MAKE) --no-print-directory test-can > build/test-can.log 2>&1 & can=$$!; \
	trap 'kill $$can' INT TERM; \
	$(pytest) $(all_tests) -n $(SYSTEM_WORKERS) --dist worksteal $(ARGS); tests=$$?; \
	wait $$can; can=$$?; cat build/test-can.log; \
	[ $$tests = 0 ] && [ $$can = 0 ]

test-unit: compiled ## Run the pure tests: no process, no socket, no waiting (ARGS="-k limiter")
	$(pytest) tests/unit -n $(WORKERS) --dist worksteal $(ARGS)

test-contract: compiled ## Run the contracts of backends and drives
	$(pytest) tests/contract -m "not (slow or quiet)" -n $(SYSTEM_WORKERS) --dist worksteal $(ARGS)

test-system: compiled ## Run the tests with real processes, but those on a CAN bus
	$(pytest) tests/system --ignore tests/system/can -n $(SYSTEM_WORKERS) --dist worksteal $(ARGS)

test-can: compiled ## Run the CAN tests on real SocketCAN, on a second kernel if this one has no CAN
	SNAKESIM_NEED_VCAN=1 $(bin)/python deploy/vm/with_vcan.py -- $(pytest) tests/system/can --timeout 900 $(ARGS)

coverage: compiled ## Print the lines and branches that the tests miss (FOLDERS="tests/unit tests/contract")
	@mkdir -p build/coverage
	$(bin)/python -m coverage erase
	$(bin)/python -m coverage run -m pytest $(FOLDERS) -m "not slow and not quiet" -n $(WORKERS) $(ARGS)
	$(bin)/python -m coverage combine -q
	$(bin)/python -m coverage report

verify: compiled ## Run the campaign, nightly and before a release: what takes hours or a quiet machine (ARGS="--list")
	$(bin)/python -m verification $(ARGS)

# Once: each worker would compile all that it imports, and the emulated machine would take many times as long.
compiled: .venv/.compiled
	@$(bin)/python -m snakesim_native.compile
	-@$(bin)/python -m compileall -qq -j 0 $(packages) tests verification

.venv/.compiled: $(stamp)
	-@$(bin)/python -m compileall -qq -j 0 -x '/(OpenGL|fontTools|onnx|setuptools|sqlalchemy|tests?|testing)/' .venv/lib
	@touch $@

pytest = $(bin)/python -m pytest
all_tests = tests --ignore tests/system/can

faults: $(stamp) ## Measure the fault table and write docs/benchmarks/faults.md and its CSV (ARGS="--rows NAME --trials 3")
	$(bin)/python -m verification.faults --write $(ARGS)

mutation: $(stamp) ## Break the safety core one change at a time; every break must be noticed
	$(bin)/python -m verification.mutation --workers $(WORKERS) $(ARGS)

fuzz: $(stamp) ## Bad payloads into every decoder, then over the network of a robot that runs (PAYLOADS=1000000)
	$(bin)/python -m verification.fuzz --payloads $(PAYLOADS) $(ARGS)
	$(bin)/python -m verification.fuzz --payloads $(PAYLOADS) --network $(ARGS)

attack: $(stamp) ## Every attack of an unauthorized client on the network, in full (ARGS="-k a4")
	$(bin)/python -m verification.attack $(ARGS)

kills: $(stamp) ## Random kills and freezes of runs that start, arm, stop, reset and end (TRIALS=300, ARGS="--seed 2")
	$(bin)/python -m verification.soak.kills --trials $(TRIALS) $(ARGS)

soak: $(stamp) ## A long run with faults at random, and an operator who recovers (MINUTES=30, ARGS="--backend can --seed 2")
	$(bin)/python -m verification.soak --minutes $(MINUTES) $(ARGS)

check: $(stamp) ## Lint, format, types, import rules and English, without changing anything
	$(bin)/ruff check
	$(bin)/ruff format --check
	$(bin)/basedpyright
	@for package in $(packages); do \
	  grep -q "^root_packages = .*\"$$package\"" pyproject.toml || \
	    { echo "check: add $$package to root_packages under [tool.importlinter] in pyproject.toml"; exit 1; }; \
	done
	$(bin)/lint-imports
	$(bin)/python docs/style/check_prose.py
	$(bin)/zizmor --quiet --offline .github

bench: $(stamp) ## Measure the ratios in benchmarks/
	$(bin)/python -m benchmarks $(ARGS)

bench-peers: $(stamp) ## Measure the loop beside raw Zenoh, dora-rs and rospy (installs them: build/peers, Debian)
	$(bin)/python -m benchmarks.peers $(ARGS)

links: $(stamp) ## Measure bad links between a robot and its controller, and write docs/benchmarks/lab-links.md (root; ARGS="--trials 4")
	$(bin)/python -m verification.links --write $(ARGS)

bench-paths: $(stamp) ## Measure the loop over routers, mTLS and a slow link beside raw Zenoh (root)
	$(bin)/python -m benchmarks.paths $(ARGS)

golden: $(stamp) ## Write tests/golden.json again, after a change that is meant to change what robots do
	$(bin)/python -m verification.golden

schemas: $(stamp) ## Regenerate what is made from the code: JSON Schemas, key space, tables, Python API
	$(bin)/snakesim schema --out schemas
	$(bin)/python -m docs.site.kinds_table
	$(bin)/python -m docs.site.error_pages
	$(bin)/python -m docs.site.configuration_page
	$(bin)/python -m docs.site.commands_page
	$(bin)/python -m docs.site.api_pages

docs: $(stamp) ## Write the documentation as a site into build/docs, searchable, also without a network
	$(bin)/python docs/site/build.py

wheels: $(stamp) ## Build wheels with compiled C libraries for x86-64 and aarch64, into build/wheels
	$(bin)/python deploy/wheels.py

release: $(stamp) ## Build and check what a release publishes, into build/release
	$(bin)/python deploy/release.py $(ARGS)

lock: ## Resolve the lock files again (UPGRADE=1 for newer versions)
	$(bootstrap) lock $(if $(UPGRADE),--upgrade)

clean: ## Remove what setup, builds and caches left; recordings in runs/ stay
	rm -rf .venv .tools build dist *.egg-info snakesim_native/compiled .pytest_cache .ruff_cache .hypothesis .import_linter_cache
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
