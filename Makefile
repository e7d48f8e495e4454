# make demo, make test: all that a fresh clone needs is Python 3.10 or newer, make and the package
# index. Both make their own environment in .venv/ the first time; PYTHON=... picks the interpreter.

VENV := .venv
KILTED := .venv-kilted
# Whole files of tests that run ROS come first, then the others one by one (see test/conftest.py).
# Three processes keep two cores busy, because those tests wait for a third of their time.
PYTEST_ARGS ?= -n 3
TEST_TAKES := 7 minutes on two cores
BIN := $(VENV)/bin

# The environment brings its own ROS packages. A sourced ROS (or the interpreter of another
# environment) has put paths into these variables, which would mix two installations.
unexport PYTHONHOME PYTHONPATH AMENT_PREFIX_PATH RMW_IMPLEMENTATION VIRTUAL_ENV
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
ifneq ($(AMENT_PREFIX_PATH)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport LD_LIBRARY_PATH
endif

.PHONY: help env demo test test-jazzy test-kilted test-public check-fresh nightly mutations soak \
	stress fuzz lint docs clean distclean
.NOTPARALLEL:

help:
	@echo 'make demo       run the Autoware workload under the executor, record and replay it'
	@echo 'make test       run all tests, about $(TEST_TAKES) (PYTEST_ARGS=... for some of them)'
	@echo 'make test-jazzy RCLPY=DIR  the tests of what runs ROS, with the rclpy in that folder'
	@echo 'make test-public PUBLIC=DIR  public programs under both executors, from sources in there'
	@echo 'make test-kilted  the tests of what runs ROS, with ROS 2 Kilted, in $(KILTED)/'
	@echo 'make check-fresh  make demo and make test in new installations of Debian (CHECK_FRESH=...)'
	@echo 'make nightly    make mutations, soak, stress and fuzz, and 20 times the random examples'
	@echo 'make mutations  break the executor on purpose; a test must notice each change'
	@echo 'make soak       the Autoware workload with random faults for SOAK_SECONDS (600)'
	@echo 'make stress     deadline misses reported to all kinds of handlers, STRESS_SECONDS (20) each'
	@echo 'make fuzz       read damaged recordings for FUZZ_SECONDS (600) each'
	@echo 'make lint       run the linters and mypy only'
	@echo 'make docs       build the documentation, build/docs/index.html'
	@echo 'make env        make or refresh the environment in $(VENV)/, as the others also do'
	@echo 'make clean      remove what builds and tests have written'
	@echo 'make distclean  the same, and the environment'

env:
	@PYTHON='$(PYTHON)' sh .ci/environment $(VENV)

demo: env
	@$(BIN)/mddag demo $(DEMO_ARGS)

test: env
	@sh .ci/tools install
	@echo 'make test: about $(TEST_TAKES)'
	@$(BIN)/python -m pytest $(PYTEST_ARGS)

# The tests that run ROS, in an environment with ROS 2 Kilted instead of Jazzy.
LIVE_TESTS := test/executor test/hosting test/synthetic test/rerun test/examples test/hardening/test_misuse.py \
	$(addprefix test/cli/test_,$(addsuffix .py,demo graph rerun run top))

# With another rclpy than the index has: RCLPY is a folder with its package rclpy/, the extension
# compiled against the headers of ros-jazzy-rclpy (in another environment: .ci/slim removes them).
test-jazzy: env
	@sh .ci/tools install
ifneq ($(wildcard $(RCLPY)/rclpy/__init__.py),)
	@PYTHONPATH='$(abspath $(RCLPY))' $(BIN)/python -m pytest $(PYTEST_ARGS) $(LIVE_TESTS)
else
	@echo 'test-jazzy: skipped: RCLPY=$(RCLPY): no rclpy/ there: set it to that of a compiled rclpy'
endif

# Public programs under rclpy's executor and under this one; PUBLIC is a folder with their sources,
# and install/ with what else they import (colcon build --merge-install, pip install --prefix).
# PUBLIC_ARGS: --only NAME, --interrupts N, …
test-public: env
ifneq ($(and $(PUBLIC),$(wildcard $(PUBLIC)/*/.)),)
	@at='$(abspath $(PUBLIC))/install' && \
		PYTHONPATH="$$(echo "$$at"/lib/python3*/site-packages)" LD_LIBRARY_PATH="$$at/lib" \
		$(BIN)/python test/endurance/public_programs.py '$(PUBLIC)' $(PUBLIC_ARGS)
else
	@echo 'test-public: skipped: PUBLIC=$(PUBLIC): no sources there: git clone -b jazzy https://github.com/ros2/demos (and examples, …) into it'
endif

test-kilted:
	@sh .ci/tools install
	@PYTHON='$(PYTHON)' sh .ci/environment $(KILTED) ros-kilted,test-kilted
	@$(KILTED)/bin/python -m pytest $(PYTEST_ARGS) $(LIVE_TESTS)

# Needs root, or sudo; debootstrap; a connection.
CHECK_FRESH ?= bookworm trixie

check-fresh:
	@bash .ci/check-fresh $(CHECK_FRESH)

nightly: mutations soak stress fuzz
	@MDDAG_THOROUGH=20 HARDENING_EXAMPLES=1000 $(BIN)/python -m pytest $(PYTEST_ARGS) -q \
		test/core test/msg_graph test/hardening test/laboratory test/sources test/analysis test/whatif test/simulate test/trace

mutations: env
	@$(BIN)/python -m pytest -q -m nightly test/executor/mutations

FUZZ_SECONDS ?= 600

fuzz: env
	@FUZZ_SECONDS=$(FUZZ_SECONDS) $(BIN)/python -m pytest -q -s test/sources/test_fuzz.py

SOAK_SECONDS ?= 600

soak: env
	@ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/python test/endurance/soak.py config/autoware.yaml \
		--seconds $(SOAK_SECONDS) $(SOAK_ARGS)

STRESS_SECONDS ?= 20

stress: env
	@MISS_STRESS_SECONDS=$(STRESS_SECONDS) $(BIN)/python -m pytest -q test/executor/test_misses.py

lint: env
	@$(BIN)/python -m pytest -q -m linter test/test_linters.py test/test_layers.py

docs: env
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo 'build/docs/index.html'

clean:
	rm -rf build install log dist *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name '.venv*' -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV) $(VENV).lock $(KILTED) $(KILTED).lock
