# Two commands are all the set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= reports/demo

.PHONY: demo test slow ros2 lint install install-test system-packages clean

demo: install
	$(BIN)/uvgs demo --out $(OUT) --force

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable .
	$(BIN)/python -m uvgs_bench.cli.warm_up
	touch $@

install-test: $(VENV)/.installed-test

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group test
	touch $@

# The firmware is compiled for the Arduino and run in a simulator, machine-vision cameras are read through Aravis, which
# has a fake one, and the node runs beside a real ROS 1. Where packages may not be installed, their tests are skipped.
SYSTEM_PACKAGES := gcc-avr binutils-avr avr-libc libsimavr-dev g++ make python3-gi gir1.2-aravis-0.8 \
  ros-core python3-rospy python3-rosbag python3-sensor-msgs python3-geometry-msgs python3-tf2-msgs python3-diagnostic-msgs
system-packages:
	@if command -v avr-g++ >/dev/null && command -v g++ >/dev/null && test -e /usr/include/simavr/sim_avr.h \
	  && ls /usr/lib/*/girepository-1.0/Aravis-0.8.typelib >/dev/null 2>&1 && test -x /usr/bin/roscore; then exit 0; fi; \
	as_root=; test "$$(id -u)" = 0 || as_root="sudo -n"; \
	if command -v apt-get >/dev/null && $$as_root true 2>/dev/null && $$as_root apt-get update -qq \
	  && $$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $(SYSTEM_PACKAGES); then exit 0; fi; \
	echo "The tests need what could not be installed here: $(SYSTEM_PACKAGES)" >&2

test: install-test system-packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -n 2

slow: install-test
	$(BIN)/python -m pytest -m slow

# The node beside a real ROS 2, from unofficial wheels in an environment of its own.
ROS2_PACKAGES := ros-jazzy-rclpy ros-jazzy-rmw-fastrtps-cpp ros-jazzy-sensor-msgs ros-jazzy-geometry-msgs ros-jazzy-diagnostic-msgs
ros2: install-test
	test -x .venv-ros2/bin/python || $(PYTHON) -m venv .venv-ros2
	.venv-ros2/bin/python -m pip install --quiet --editable . $(ROS2_PACKAGES)
	$(BIN)/python -m pytest -m ros tests/sessions/test_node_ros2.py

lint: install-test
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy && $(BIN)/lint-imports

clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
